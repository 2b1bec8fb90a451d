"""Find the shadows in a camera's stored images and flag them, once all of its images are stored."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.anatomy.shadow_map import is_unoccluded
from services.core.geometry import Camera, Light
from services.core.records import MaskBit
from services.core.stage import StageContext
from services.preprocess.masking.shadows import shadow_confidence
from services.preprocess.quality.images import assess, write_picture
from services.preprocess.tasks.attempt_files import AttemptFiles
from services.preprocess.views.direct_light import expected_irradiance
from services.preprocess.views.projection import Footprint
from services.preprocess.views.source import Image, Source, View
from services.preprocess.views.subject import Subject

PIXEL_MM = 0.25
"""Approximate pixel size, mm on the tooth, to which images are averaged before shadows are searched. It is finer than a
shadow's edge, which light inside a tooth makes soft."""
MIN_LIGHTS = 6
"""Smallest number of lights that are compared. With fewer lights most of a pixel's images may lie in shadow, so its
unshadowed brightness is unknown."""
SHADOWED = 0.5
"""Confidence above which a pixel is flagged: it is then more likely shadowed than not."""
NO_VALUE = np.uint16(MaskBit.SATURATED | MaskBit.NOT_FINITE | MaskBit.MOTION | MaskBit.UNLIT)
"""Mask bits of pixels whose value is not the brightness of the tooth."""


@dataclass(frozen=True)
class _Coarse:
    """A view averaged over squares of ``step`` pixels.

    Attributes:
        step: side of a square, pixels.
        points_mm: (h, w, 3) mean world position of the surface.
        normal: (h, w, 3) mean unit normal.
        visible: (h, w) squares that hold a covered pixel.
    """

    step: int
    points_mm: Image
    normal: Image
    visible: NDArray[np.bool_]

    def mean(self, values: NDArray[Any], weight: NDArray[np.float32]) -> tuple[Image, Image]:
        """Weighted mean (h, w, …) of an image (H, W, …) over the squares, and the sums (h, w) of the weights."""
        sums = _block_sums(weight, self.step)
        weighted = _block_sums(values * (weight if values.ndim == weight.ndim else weight[..., None]), self.step)
        divisor = np.maximum(sums, 1e-6)
        return (weighted / (divisor if weighted.ndim == 2 else divisor[..., None])).astype(np.float32), sums


def shade(files: AttemptFiles, source: Source, subject: Subject, view: View, context: StageContext) -> None:
    """Flag SHADOW in all images of a camera and store the confidence in per cent.

    The fit itself renders the shadows of surfaces in its scene. Here, shadows of gums and teeth that it leaves out are
    found from their geometry, and shadows of objects without a scan by comparing the camera's lights.

    Raises:
        JobCancelledError: the job was cancelled. FencedError: another attempt has begun.
    """
    camera, lights = view.number, source.lights_of(view.number)
    coarse = _averaged(view)
    stacks = [np.zeros((len(lights), *coarse.visible.shape), dtype=np.float32) for _ in range(4)]
    radiance, variance, irradiance, facing = stacks
    by_geometry = np.zeros(radiance.shape, dtype=bool)
    rendered, left_out = subject.rendered_meshes(), [] if subject.surroundings else list(subject.occluders)
    for index, j in enumerate(lights):
        context.raise_if_cancelled()
        lamp = source.description.lights[j]
        radiance[index], variance[index] = _brightness(files, view, j, coarse)
        irradiance[index], facing[index] = _light_on(coarse, lamp, rendered)
        if left_out:
            unoccluded = is_unoccluded(coarse.points_mm, coarse.normal, lamp.position_mm, left_out)
            by_geometry[index] = coarse.visible & (irradiance[index] > 0) & ~unoccluded
            irradiance[index][by_geometry[index]] = 0
    confidence = by_geometry.astype(np.float32)
    if len(lights) >= MIN_LIGHTS:
        pixel_mm = coarse.step * _pixel_mm(view.camera, view.footprint)
        found = shadow_confidence(radiance, variance, irradiance, facing, coarse.visible, pixel_mm)
        confidence = np.maximum(confidence, found)
    for index, j in enumerate(lights):
        context.raise_if_cancelled()
        _flag(files, subject, view, camera, j, _upsampled(confidence[index], coarse.step, view.footprint.covered))


def _averaged(view: View) -> _Coarse:
    footprint = view.footprint
    step = max(1, int(PIXEL_MM / max(_pixel_mm(view.camera, footprint), 1e-6)))
    weight = np.asarray(footprint.covered, dtype=np.float32)
    points = np.nan_to_num(footprint.points_mm(view.camera, slice(None)))
    coarse = _Coarse(step, points, footprint.normal, weight > 0)
    points_mm, sums = coarse.mean(points, weight)
    normal, _ = coarse.mean(footprint.normal, weight)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6)
    return _Coarse(step, points_mm, normal, sums > 0)


def _pixel_mm(camera: Camera, footprint: Footprint) -> float:
    """Size of a pixel on the teeth in mm, median over the covered pixels."""
    depth = footprint.depth_mm[footprint.covered]
    return float(np.median(depth)) / camera.K[0][0] if len(depth) else PIXEL_MM


def _brightness(files: AttemptFiles, view: View, light: int, coarse: _Coarse) -> tuple[Image, Image]:
    """Mean of an image over channels (h, w) and its variance (h, w), infinite in squares without a usable pixel.

    Highlights are used only in squares without another pixel. They add light, so a square that is dark nevertheless
    lies in a shadow.
    """
    radiance, variance, valid = (_read(files, view, name, light) for name in ("radiance", "variance", "valid"))
    usable = view.footprint.covered & (valid & NO_VALUE == 0)
    plain = (usable & (valid & np.uint16(MaskBit.HIGHLIGHT) == 0)).astype(np.float32)
    has_plain = _upsampled(np.sign(_block_sums(plain, coarse.step)), coarse.step, usable) > 0
    weight = np.where(has_plain, plain, usable.astype(np.float32))
    value, sums = coarse.mean(radiance.mean(axis=-1), weight)
    spread, _ = coarse.mean(variance.mean(axis=-1) / variance.shape[-1], weight)
    return value, np.where(sums > 0, spread / np.maximum(sums, 1), np.inf).astype(np.float32)


def _light_on(coarse: _Coarse, lamp: Light, rendered: Sequence[Any]) -> tuple[Image, Image]:
    """Irradiance (h, w) of a light where rendered surfaces do not shade it, and cosine of incidence (h, w)."""
    to_light = np.asarray(lamp.position_mm, dtype=np.float32) - coarse.points_mm
    facing = (to_light * coarse.normal).sum(axis=-1) / np.maximum(np.linalg.norm(to_light, axis=-1), 1e-6)
    unoccluded = is_unoccluded(coarse.points_mm, coarse.normal, lamp.position_mm, rendered)
    irradiance = expected_irradiance(coarse.points_mm, coarse.normal, lamp.position_mm, unoccluded & coarse.visible)
    return irradiance * np.float32(np.mean(lamp.intensity)), facing.astype(np.float32)


def _flag(files: AttemptFiles, subject: Subject, view: View, camera: int, light: int, confidence: Image) -> None:
    """Write one image's flags, confidence and picture, and record that its shadows are flagged."""
    # Read the record without a check of file sizes: if a worker died after writing flags and before the record, the
    # flags' files differ from the record and everything else still matches it
    done = files.record(camera, light)
    assert done is not None, "images are stored before shadows are looked for"
    bits = _read(files, view, "valid", light)
    bits = bits & ~np.uint16(MaskBit.SHADOW) | np.where(confidence > SHADOWED, MaskBit.SHADOW, 0).astype(np.uint16)
    for name, values in (("valid", bits), ("shadow", np.rint(100 * confidence).astype(np.uint8))):
        files.array(name)[camera, light, view.window.rows, view.window.columns] = values
    quality = done.quality
    picture = files.folder / "quality" / f"{quality.camera}_{quality.light}.png"
    write_picture(picture, _read(files, view, "radiance", light), bits)
    covered, moved = view.footprint.covered, (quality.motion_px, quality.motion_error_px, quality.motion_source)
    changed = {
        "quality": assess(
            quality.camera,
            quality.light,
            bits,
            covered,
            moved,
            (quality.levels, quality.noise),
        ),
        "tooth_pixels": tuple(subject.pixels_of_teeth(view.footprint, bits).tolist()),
        "files": files.files_of(camera, light, picture),
        "objects": files.objects_of(camera, light),
        "shaded": True,
    }
    files.put_image(camera, light, done.model_copy(update=changed))


def _block_sums(values: NDArray[Any], step: int) -> NDArray[np.float32]:
    """Sums (h, w, …) over squares of ``step`` pixels; squares at the right and lower edges may be smaller."""
    rows = np.add.reduceat(values, np.arange(0, values.shape[0], step), axis=0)
    return np.asarray(np.add.reduceat(rows, np.arange(0, values.shape[1], step), axis=1), dtype=np.float32)


def _upsampled(confidence: Image, step: int, covered: NDArray[np.bool_]) -> Image:
    """Repeat a coarse image (h, w) at full resolution (H, W); 0 at pixels that are not covered."""
    fine = confidence.repeat(step, axis=0).repeat(step, axis=1)[: covered.shape[0], : covered.shape[1]]
    return np.where(covered, fine, np.float32(0))


def _read(files: AttemptFiles, view: View, name: str, light: int) -> NDArray[Any]:
    return np.asarray(files.array(name)[view.number, light, view.window.rows, view.window.columns])
