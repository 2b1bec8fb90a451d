"""First guess of the roughness, and the photographs that tell most of it: each of some roughnesses is tried, with the
normals as they are scanned.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.fit.measurements.roughness.background import free_terms
from services.fit.measurements.roughness.patches import Patch

Array = NDArray[np.float64]

TRIED = np.geomspace(0.02, 0.8, 16)
"""Roughnesses that are tried, in steps of 28 %."""
SCAN_ERROR = 0.05
"""Relative error of a pixel by the scan's normals, which are not yet corrected."""


@dataclass(frozen=True)
class Start:
    """The best of the tried roughnesses.

    Attributes:
        roughness: it.
        brightness: of all highlights, over the one that index and calibration predict.
        told: (P,) squared ratio of each patch's highlight to its noise.
    """

    roughness: float
    brightness: float
    told: Array


def first_guess(patches: Iterable[Patch], ior: float) -> Start:
    """Try roughnesses on patches, one after the other."""
    measured, predicted = list[Array](), list[Array]()
    for patch in patches:
        deviation = np.sqrt(patch.variance + (SCAN_ERROR * patch.value) ** 2)
        basis, triangle = np.linalg.qr(free_terms(patch) / deviation[:, None])
        size = np.abs(np.diag(triangle))
        basis = basis[:, size > 1e-8 * size.max()]
        lobes = np.stack([patch.lobe(float(roughness), ior) for roughness in TRIED], axis=1) / deviation[:, None]
        lobes = lobes - basis @ (basis.T @ lobes)
        value = patch.value / deviation
        measured.append(lobes.T @ value)
        predicted.append((lobes**2).sum(axis=0))
    along, norm = np.sum(measured, axis=0), np.maximum(np.sum(predicted, axis=0), 1e-300)
    # The gain in squares by a highlight; one of negative brightness gains nothing
    best = int(np.argmax(np.maximum(along, 0) ** 2 / norm))
    brightness = float(along[best] / norm[best])
    told = np.array([own[best] for own in predicted]) * brightness**2
    return Start(float(TRIED[best]), brightness, told)
