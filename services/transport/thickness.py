"""Enamel thickness: shortest distance from the enamel's outer surface to the dentin."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.anatomy.dentin_shape import DentinShape
from services.anatomy.distance import SurfaceDistance
from services.core.geometry import Camera, Mesh
from services.core.results import Estimate
from services.transport.rays import RayScene, pixel_rays

MIN_STEP = 0.01
"""Least half width of the central difference by a blend weight: some micrometres of dentin, far above rounding."""


def enamel_thickness_mm(points_mm: NDArray[np.float64], dentin: Mesh) -> NDArray[np.float64]:
    """Distance (N,) in mm from points (N, 3) on the enamel's outer surface to the dentin's surface."""
    return SurfaceDistance(dentin).closest(points_mm)[1]


@dataclass(frozen=True)
class UncertainThickness:
    """Enamel thickness at N points with its standard error, mm."""

    values_mm: NDArray[np.float64]
    """Thickness (N,)."""
    errors_mm: NDArray[np.float64]
    """Standard error (N,)."""
    mean_mm: float
    mean_error_mm: float
    """Standard error of the mean over all points. The points' errors are correlated, so it is hardly smaller than
    theirs."""


def uncertain_thickness(
    points_mm: NDArray[np.float64], shape: DentinShape, weights: NDArray[np.float64], covariance: NDArray[np.float64]
) -> UncertainThickness:
    """Thickness at points (N, 3) of the outer surface for fitted blend weights c (M,) of covariance (M, M), by
    first-order error propagation.

    The derivative of the distance is a central difference over one standard error of each weight, limited to weights
    from 0 to 1, so that it is the mean derivative over the likely range.
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
    """Enamel thickness in the view of a camera, mm."""

    image_mm: NDArray[np.float64]
    """Thickness (H, W), NaN off the tooth."""
    errors_mm: NDArray[np.float64] | None
    """Standard error (H, W); None where the dentin is known."""
    mean: Estimate
    """Mean over the visible surface, mm."""


def thickness_map(
    outer: Mesh, shape: DentinShape, weights: tuple[float, ...], covariance: NDArray[np.float64] | None, camera: Camera
) -> ThicknessMap | None:
    """Map of the enamel's thickness over a fitted dentin in a camera's view; None where the camera does not see the
    tooth.

    Args:
        outer: the enamel's outer surface.
        shape: the dentin's blend shape.
        weights: blend weights (M,).
        covariance: covariance of the weights (M, M); None where they were not fitted, because the dentin is known or
            the weights are assumed. An assumed weight determines nothing.
        camera: the camera.
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
    visible, points_mm = _visible_points(outer, camera)
    if not visible.any():
        return None
    found = uncertain_thickness(points_mm, shape, np.asarray(weights), covariance)
    return ThicknessMap(
        _image(visible, found.values_mm, camera),
        _image(visible, found.errors_mm, camera),
        Estimate(
            value=found.mean_mm, se=found.mean_error_mm, unit="mm", determined=found.mean_error_mm < found.mean_mm / 2
        ),
    )


def thickness_image(outer: Mesh, dentin: Mesh, camera: Camera) -> NDArray[np.float64]:
    """Enamel thickness in mm at the surface point that each pixel shows, (H, W); NaN off the tooth."""
    visible, points_mm = _visible_points(outer, camera)
    return _image(visible, enamel_thickness_mm(points_mm, dentin) if visible.any() else np.zeros(0), camera)


def _visible_points(outer: Mesh, camera: Camera) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    # Mask (H W,) of the pixels that show the tooth, and the surface points (N, 3) that they show.
    hits = RayScene(outer).first_hits(*pixel_rays(camera))
    return hits.hit, hits.points_mm[hits.hit]


def _image(visible: NDArray[np.bool_], values: NDArray[np.float64], camera: Camera) -> NDArray[np.float64]:
    image = np.full(len(visible), np.nan)
    image[visible] = values
    return image.reshape(camera.size[1], camera.size[0])


def fitted_thickness(
    outer: Mesh,
    dentin: DentinShape | None,
    shape: tuple[float, ...],
    covariance: tuple[tuple[float, ...], ...],
    camera: Camera,
) -> ThicknessMap | None:
    """Map of the enamel's thickness over the fitted dentin, as a camera sees it; None without dentin, or where the
    camera does not see the tooth.

    Args:
        outer: the tooth's outer surface.
        dentin: the dentin, given or as a blend shape.
        shape: blend weights.
        covariance: covariance of the blend weights; empty where they were not fitted.
        camera: the camera that sees the map.
    """
    return (
        None
        if dentin is None
        else thickness_map(outer, dentin, shape, np.array(covariance) if covariance else None, camera)
    )
