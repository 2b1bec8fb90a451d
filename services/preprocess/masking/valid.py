"""Mask bits of an image: the pixels that the fit may use, and the reasons against the others."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.core.errors import CaptureInputError
from services.core.geometry import Camera, Light, Tooth
from services.core.records import MaskBit
from services.preprocess.masking.highlights import half_cosines, highlight_mask
from services.preprocess.views.projection import Footprint
from services.preprocess.views.source import LightImage


def valid_bits(
    image: LightImage,
    footprint: Footprint,
    camera: Camera,
    light: Light,
    glossy: tuple[NDArray[np.bool_], ...] | None = None,
) -> NDArray[np.uint16]:
    """Mask bits (H, W) of an image; 0 is a pixel to fit.

    Surfaces that face away from the light are not masked, because light from inside a tooth leaves there too. OUTSIDE
    flags all pixels whose footprint is not wholly on the fitted surfaces. In a resampled image it also flags one more
    pixel along the outline, because interpolation mixes that pixel with its surroundings.

    Args:
        glossy: masks (H, W) of glossy surfaces, each of its own colour; None for a single one, all covered pixels.
    """
    import cv2

    inside = footprint.covered
    if image.warped:
        inside = (
            cv2.erode(inside.astype(np.uint8), np.ones((3, 3), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0)
            > 0
        )
    bits = image.bits.copy()
    bits[~inside] |= np.uint16(MaskBit.OUTSIDE)
    saturated = footprint.covered & (image.bits & np.uint16(MaskBit.SATURATED) > 0)
    usable = footprint.covered & (image.bits & np.uint16(MaskBit.SATURATED | MaskBit.NOT_FINITE) == 0)
    cosines = half_cosines(camera, light, footprint)
    for part in (footprint.covered,) if glossy is None else glossy:
        # Work on the rows that show this surface only
        rows = _span(np.asarray(part.any(axis=1)))
        own = part[rows]
        highlight = highlight_mask(
            image.radiance[rows],
            image.variance[rows],
            usable[rows] & own,
            saturated[rows] & own,
            cosines[rows],
            footprint.normal[rows],
            light.intensity,
        )
        bits[rows][highlight] |= np.uint16(MaskBit.HIGHLIGHT)
    return bits


def _span(used: NDArray[np.bool_]) -> slice:
    """Slice from the first to the last true element; empty if there is none."""
    found = np.flatnonzero(used)
    return slice(int(found[0]), int(found[-1]) + 1) if len(found) else slice(0, 0)


def require_plausible_scale(cameras: tuple[Camera, ...], lights: tuple[Light, ...], teeth: tuple[Tooth, ...]) -> None:
    """Refuse poses in another unit than the meshes' millimetres.

    Such a pose is found by a camera or light inside the teeth, or by teeth that are smaller than 4 pixels.

    Raises:
        CaptureInputError: a pose is implausible; the message names the camera or light.
    """
    vertices = np.concatenate([tooth.outer.vertices_mm for tooth in teeth])
    centre = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    radius = float(np.linalg.norm(vertices - centre, axis=1).max())
    for camera in cameras:
        pose = np.asarray(camera.camera_from_world)
        distance = float(np.linalg.norm(pose[:3, :3] @ centre + pose[:3, 3]))
        if distance <= radius:
            raise CaptureInputError(
                f"Camera {camera.name} stands {distance:.3g} mm from the teeth's centre, inside their {radius:.3g} mm"
                " radius; its pose must be in millimetres like the meshes."
            )
        size_px = 2 * radius / distance * camera.K[0][0]
        if size_px < 4:
            raise CaptureInputError(
                f"The teeth span {size_px:.2g} px in camera {camera.name}, {distance:.3g} mm away; its pose must be in"
                " millimetres like the meshes."
            )
    for light in lights:
        distance = float(np.linalg.norm(np.asarray(light.position_mm) - centre))
        if distance <= radius:
            raise CaptureInputError(
                f"Light {light.name} stands {distance:.3g} mm from the teeth's centre, inside their {radius:.3g} mm"
                " radius; its position must be in millimetres like the meshes."
            )


def require_visible_teeth(footprint: Footprint, teeth: int, camera: Camera) -> None:
    """Refuse a camera that sees no tooth.

    Raises:
        CaptureInputError: no tooth projects into the image; the message names the camera.
    """
    if not (footprint.covered & (footprint.mesh < teeth)).any():
        raise CaptureInputError(
            f"No tooth projects into the image of camera {camera.name}; check its pose, its K and that all lengths are"
            " in millimetres."
        )
