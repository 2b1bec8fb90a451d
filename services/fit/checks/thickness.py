"""Enamel thickness: shortest distance from the enamel's outer surface to dentin."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.anatomy.dentin_shape import DentinShape
from services.anatomy.distance import SurfaceDistance
from services.core.geometry import Camera, Mesh
from services.core.results import Estimate
from services.fit.transport.rays import RayScene, pixel_rays

MIN_STEP = 0.01
"""Least half step of a difference by a blend weight: some micrometres of dentin, far above rounding."""


def enamel_thickness_mm(points_mm: NDArray[np.float64], dentin: Mesh) -> NDArray[np.float64]:
    """Distance (N,) from points on the enamel's outer surface (N, 3) to the dentin surface, mm."""
    return SurfaceDistance(dentin).closest(points_mm)[1]


@dataclass(frozen=True)
class UncertainThickness:
    """Enamel thickness with one standard error, mm."""

    values_mm: NDArray[np.float64]
    """(N,)"""
    errors_mm: NDArray[np.float64]
    """(N,)"""
    mean_mm: float
    mean_error_mm: float
    """Of the mean over all points; errors of points go together, so it is hardly smaller than theirs."""


def uncertain_thickness(
    points_mm: NDArray[np.float64], shape: DentinShape, weights: NDArray[np.float64], covariance: NDArray[np.float64]
) -> UncertainThickness:
    """Thickness at points (N, 3) of the outer surface for fitted blend weights c (M,) of covariance (M, M), to first
    order.

    The slope of the distance is a central difference over one standard error of each weight, cut at 0 and 1, so that it
    is that of the range that counts.
    """

    def thickness(at: NDArray[np.float64]) -> NDArray[np.float64]:
        return enamel_thickness_mm(points_mm, Mesh(shape.vertices_mm(tuple(at.tolist())), shape.base.faces))

    slopes = np.zeros((len(points_mm), len(weights)))
    for k, step in enumerate(np.clip(np.sqrt(np.diag(covariance)), MIN_STEP, None)):
        low, high = weights.copy(), weights.copy()
        low[k], high[k] = max(weights[k] - step, 0.0), min(weights[k] + step, 1.0)
        slopes[:, k] = (thickness(high) - thickness(low)) / (high[k] - low[k])
    values, of_mean = thickness(weights), slopes.mean(axis=0)
    errors = np.sqrt(np.maximum(np.einsum("nk,kl,nl->n", slopes, covariance, slopes), 0.0))
    return UncertainThickness(
        values, errors, float(values.mean()), float(np.sqrt(max(of_mean @ covariance @ of_mean, 0.0)))
    )


@dataclass(frozen=True)
class ThicknessMap:
    """Enamel thickness where a camera sees the tooth, mm."""

    image_mm: NDArray[np.float64]
    """(H, W), NaN off the tooth."""
    errors_mm: NDArray[np.float64] | None
    """One standard error (H, W); None where the dentin is known."""
    mean: Estimate
    """Over what is seen, mm."""


def thickness_map(
    outer: Mesh, shape: DentinShape, weights: tuple[float, ...], covariance: NDArray[np.float64] | None, camera: Camera
) -> ThicknessMap | None:
    """What a camera sees of a fitted dentin; None where it does not see the tooth.

    Args:
        covariance: of the weights (M, M); None where none were fitted: the dentin is known, or its weights are only
            assumed, which determines nothing.
    """
    if covariance is None:
        image = thickness_image(outer, Mesh(shape.vertices_mm(weights), shape.base.faces), camera)
        mean = float(image[np.isfinite(image)].mean()) if np.isfinite(image).any() else None
        return (
            None
            if mean is None
            else ThicknessMap(
                image, None, Estimate(value=mean, se=None, unit="mm", determined=len(shape.modes_mm) == 0)
            )
        )
    seen, points_mm = _seen(outer, camera)
    if not seen.any():
        return None
    found = uncertain_thickness(points_mm, shape, np.asarray(weights), covariance)
    return ThicknessMap(
        _image(seen, found.values_mm, camera),
        _image(seen, found.errors_mm, camera),
        Estimate(
            value=found.mean_mm, se=found.mean_error_mm, unit="mm", determined=found.mean_error_mm < found.mean_mm / 2
        ),
    )


def thickness_image(outer: Mesh, dentin: Mesh, camera: Camera) -> NDArray[np.float64]:
    """Enamel thickness in mm at the surface point that each pixel sees, (H, W); NaN off the tooth."""
    seen, points_mm = _seen(outer, camera)
    return _image(seen, enamel_thickness_mm(points_mm, dentin) if seen.any() else np.zeros(0), camera)


def _seen(outer: Mesh, camera: Camera) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    # Which pixels (H W,) see the tooth, and where.
    hits = RayScene(outer).first_hits(*pixel_rays(camera))
    return hits.hit, hits.points_mm[hits.hit]


def _image(seen: NDArray[np.bool_], values: NDArray[np.float64], camera: Camera) -> NDArray[np.float64]:
    image = np.full(len(seen), np.nan)
    image[seen] = values
    return image.reshape(camera.size[1], camera.size[0])
