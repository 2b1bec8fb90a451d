"""Optics of random subjects, within the spread of the literature on enamel and dentin (Zijp 1995, Fried 1995, Zoller
2018).

The quantities that images determine, reduced scattering and absorption, are drawn first and log-uniformly. The phase
function's lobes, which share that reduced scattering, are drawn independently.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from services.transport.optics.parameters import Medium, Tissue

Range = tuple[float, float]


@dataclass(frozen=True)
class MediumSpread:
    """Smallest and largest values of a tissue's medium."""

    sigma_s_reduced: Range
    """Reduced scattering in green, per mm."""
    sigma_a: Range
    """Absorption in green, per mm."""
    beta: Range
    """Weight of the first lobe of the phase function."""
    g1: Range
    """Mean cosine of the first lobe."""
    g2: Range = (-0.3, 0.1)
    """Mean cosine of the second lobe."""


ENAMEL = MediumSpread((0.5, 2.1), (0.008, 0.04), (0.85, 0.97), (0.70, 0.86))
DENTIN = MediumSpread((1.6, 3.8), (0.03, 0.2), (0.92, 1.0), (0.68, 0.82))
ABSORPTION = {"red": 0.6, "green": 1.0, "blue": 1.8}
"""Absorption relative to green, which gives the yellow colour of teeth."""
SCATTERING = {"red": 0.93, "green": 1.0, "blue": 1.1}
"""Scattering relative to green."""


def subject_tissues(seed: int, channels: tuple[str, ...]) -> dict[str, Tissue]:
    """Tissue of one subject by channel; the same seed gives the same subject.

    Args:
        seed: seed of the subject.
        channels: any of red, green and blue.
    """
    random = np.random.default_rng([seed, 0x70017])
    enamel, dentin = (_draw(spread, random) for spread in (ENAMEL, DENTIN))
    return {channel: Tissue(_medium(enamel, channel), _medium(dentin, channel)) for channel in channels}


def _draw(spread: MediumSpread, random: np.random.Generator) -> dict[str, float]:
    logarithmic = {
        name: float(np.exp(random.uniform(*np.log(getattr(spread, name))))) for name in ("sigma_s_reduced", "sigma_a")
    }
    return logarithmic | {name: float(random.uniform(*getattr(spread, name))) for name in ("beta", "g1", "g2")}


def _medium(drawn: dict[str, float], channel: str) -> Medium:
    beta, g1, g2 = drawn["beta"], drawn["g1"], drawn["g2"]
    scattering = SCATTERING[channel] * drawn["sigma_s_reduced"] / (1 - beta * g1 - (1 - beta) * g2)
    sigma = scattering + ABSORPTION[channel] * drawn["sigma_a"]
    return Medium(sigma, scattering / sigma, beta, g1, g2)
