"""Known optics of a phantom jaw: each tooth's media, drawn about those of the phantom tooth, the gums, and the
reflectance of the mouth's wall.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from services.phantom.reflection import GUM_REFLECTANCE
from services.phantom.tooth import TRUE_TISSUE
from services.transport.optics.parameters import Medium, Mouth, Tissue

GUMS_IOR = 1.33
"""Refractive index of the gums."""
GUMS_MEAN_COSINE = 0.8
"""Mean cosine of scattering in the gums. That of generic soft tissue is nearer to 0.9, but images determine only the
reduced scattering, and fewer scattering events are cheaper."""
GUMS_PER_MM = {"red": (1.39, 0.05), "green": (1.71, 1.2), "blue": (1.99, 0.6)}
"""Reduced scattering and absorption of gums, 1/mm, at 635, 540 and 480 nm: generic soft tissue (Jacques 2013) with an
assumed content of blood."""

SIGMA_SPREAD, ABSORPTION_SPREAD, COSINE_SPREAD = 0.15, 0.30, 0.02
"""Half widths of uniform draws about the phantom tooth's media: extinction (relative), 1 − albedo (relative), mean
cosine (absolute). Reduced scattering stays within the literature's spread."""
REFLECTANCE_SPREAD = 0.2
"""Relative half width of the uniform draw of the wall's reflectance."""
_GUMS, _CAVITY = 1, 2
"""Streams of random numbers for gums and wall; a tooth's stream is its FDI number."""


def jaw_mouth(fdi: Sequence[int], channel: str, subject: int | None) -> Mouth:
    """Media of a subject's teeth, gums and wall in one channel; the random deviations are the same in all channels.

    Args:
        fdi: FDI numbers of the teeth.
        channel: name of the channel.
        subject: seed of the subject; None for the average in every tooth.
    """
    reflectance = GUM_REFLECTANCE[channel] * (1 + REFLECTANCE_SPREAD * _draws(subject, _CAVITY, 1)[0][0])
    return Mouth(_teeth_about(TRUE_TISSUE[channel], fdi, subject), _gums_of(channel, subject), reflectance)


def mouth_around(tissue: Tissue, fdi: Sequence[int], channel: str, subject: int | None) -> Mouth:
    """Media of teeth that vary about those of the first, and of gums, without a wall.

    Args:
        tissue: media of the first tooth in this channel.
        fdi: FDI numbers of the teeth, the first one's first.
        channel: name of the channel.
        subject: seed of the deviations, which are the same in all channels; None for none.
    """
    return Mouth((tissue, *_teeth_about(tissue, fdi[1:], subject)), _gums_of(channel, subject))


def gums_medium(channel: str) -> Medium:
    """Medium of average gums in one channel."""
    reduced, absorption = GUMS_PER_MM[channel]
    scattering = reduced / (1 - GUMS_MEAN_COSINE)
    return Medium(scattering + absorption, scattering / (scattering + absorption), g1=GUMS_MEAN_COSINE)


def _teeth_about(tissue: Tissue, fdi: Sequence[int], subject: int | None) -> tuple[Tissue, ...]:
    teeth = []
    for number in fdi:
        enamel, dentin = _draws(subject, number, 2)
        teeth.append(Tissue(_varied(tissue.enamel, enamel), _varied(tissue.dentin, dentin)))
    return tuple(teeth)


def _gums_of(channel: str, subject: int | None) -> Medium:
    return _varied(gums_medium(channel), _draws(subject, _GUMS, 1)[0])


def _draws(subject: int | None, stream: int, media: int) -> list[list[float]]:
    if subject is None:
        return [[0.0, 0.0, 0.0]] * media
    draws: list[list[float]] = np.random.default_rng((subject, stream)).uniform(-1, 1, (media, 3)).tolist()
    return draws


def _varied(medium: Medium, draws: list[float]) -> Medium:
    sigma, absorption, cosine = draws
    return replace(
        medium,
        sigma=medium.sigma * (1 + SIGMA_SPREAD * sigma),
        alpha=1 - (1 - medium.alpha) * (1 + ABSORPTION_SPREAD * absorption),
        g1=medium.g1 + COSINE_SPREAD * cosine,
    )
