"""Finds the shadows in a camera's stored images and flags them, once all of its images are there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.core.geometry import Camera, Light
from services.core.records import MaskBit
from services.core.stage import StageContext
from services.preprocess.masking.shadows import expected_irradiance, reached_by, shadow_confidence
from services.preprocess.projection import Footprint
from services.preprocess.quality import assess, write_picture
from services.preprocess.source import Image, Source, View
from services.preprocess.subject import Subject
from services.preprocess.tasks.attempt_files import AttemptFiles

PIXEL_MM = 0.25
"""Shadows are looked for in images averaged to about this pixel: finer than their edges, which light inside a tooth
makes soft."""
MIN_LIGHTS = 6
"""With fewer lights most of a pixel's images may lie in shadow, and nothing says how bright it would be."""
SHADOWED = 0.5
"""A pixel is left out above this confidence: it is then more likely shadowed than not."""
NO_VALUE = np.uint16(MaskBit.HIGHLIGHT | MaskBit.SATURATED | MaskBit.NOT_FINITE | MaskBit.MOTION | MaskBit.UNLIT)
"""Pixels whose brightness is not the tooth's."""


@dataclass(frozen=True)
class _Coarse:
    """A view averaged over squares of ``step`` pixels; arrays are (h, w)."""

    step: int
    points_mm: Image
    normal: Image
    seen: NDArray[np.bool_]

    def mean(self, values: NDArray[Any], weight: NDArray[np.float32]) -> tuple[Image, Image]:
        """Weighted mean (h, w, …) of an image and the weights' sums (h, w)."""
        sums = _squares(weight, self.step)
        weighted = _squares(values * (weight if values.ndim == weight.ndim else weight[..., None]), self.step)
        divisor = np.maximum(sums, 1e-6)
        return (weighted / (divisor if weighted.ndim == 2 else divisor[..., None])).astype(np.float32), sums


def shade(files: AttemptFiles, source: Source, subject: Subject, view: View, context: StageContext) -> None:
    """Flag SHADOW in all images of a camera and store how sure that is, in per cent.

    Surfaces that the fit renders throw their shadows there; gums and teeth that it does not render shade here by their
    geometry, and what no scan shows by comparing the camera's lights.

    Raises:
        JobCancelledError. FencedError: another attempt has begun.
    """
    camera, lights = view.number, source.lights_of(view.number)
    coarse = _averaged(view)
    stacks = [np.zeros((len(lights), *coarse.seen.shape), dtype=np.float32) for _ in range(4)]
    radiance, variance, irradiance, facing = stacks
    by_geometry = np.zeros(radiance.shape, dtype=bool)
    rendered = subject.fitted_meshes()
    for place, j in enumerate(lights):
        context.raise_if_cancelled()
        lamp = source.description.lights[j]
        radiance[place], variance[place] = _brightness(files, view, j, coarse)
        irradiance[place], facing[place] = _light_on(coarse, lamp, rendered)
        if subject.in_the_way:
            free = reached_by(coarse.points_mm, coarse.normal, lamp.position_mm, list(subject.in_the_way))
            by_geometry[place] = coarse.seen & (irradiance[place] > 0) & ~free
            irradiance[place][by_geometry[place]] = 0
    confidence = by_geometry.astype(np.float32)
    if len(lights) >= MIN_LIGHTS:
        pixel_mm = coarse.step * _pixel_mm(view.camera, view.footprint)
        found = shadow_confidence(radiance, variance, irradiance, facing, coarse.seen, pixel_mm)
        confidence = np.maximum(confidence, found)
    for place, j in enumerate(lights):
        context.raise_if_cancelled()
        _flag(files, subject, view, camera, j, _finer(confidence[place], coarse.step, view.footprint.covered))


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
    """Size of a pixel on the teeth, median over the covered ones."""
    depth = footprint.depth_mm[footprint.covered]
    return float(np.median(depth)) / camera.K[0][0] if len(depth) else PIXEL_MM


def _brightness(files: AttemptFiles, view: View, light: int, coarse: _Coarse) -> tuple[Image, Image]:
    """Mean over channels of an image and its variance; infinite where a square holds no pixel with a value."""
    radiance, variance, valid = (_read(files, view, name, light) for name in ("radiance", "variance", "valid"))
    weight = (view.footprint.covered & (valid & NO_VALUE == 0)).astype(np.float32)
    value, sums = coarse.mean(radiance.mean(axis=-1), weight)
    spread, _ = coarse.mean(variance.mean(axis=-1) / variance.shape[-1], weight)
    return value, np.where(sums > 0, spread / np.maximum(sums, 1), np.inf).astype(np.float32)


def _light_on(coarse: _Coarse, lamp: Light, rendered: Sequence[Any]) -> tuple[Image, Image]:
    """Irradiance of a light on what it reaches past known surfaces, and the cosine of its angle."""
    way = np.asarray(lamp.position_mm, dtype=np.float32) - coarse.points_mm
    facing = (way * coarse.normal).sum(axis=-1) / np.maximum(np.linalg.norm(way, axis=-1), 1e-6)
    reached = reached_by(coarse.points_mm, coarse.normal, lamp.position_mm, rendered)
    irradiance = expected_irradiance(coarse.points_mm, coarse.normal, lamp.position_mm, reached & coarse.seen)
    return irradiance * np.float32(np.mean(lamp.intensity)), facing.astype(np.float32)


def _flag(files: AttemptFiles, subject: Subject, view: View, camera: int, light: int, confidence: Image) -> None:
    """Write one image's flags, confidence and picture, and say that it is done."""
    # Where a worker died between the flags and the record, the files no longer have the record's sizes; all but flags
    # is as it was
    done = files.record(camera, light)
    assert done is not None, "images are stored before shadows are looked for"
    bits = _read(files, view, "valid", light)
    bits = bits & ~np.uint16(MaskBit.SHADOW) | np.where(confidence > SHADOWED, MaskBit.SHADOW, 0).astype(np.uint16)
    for name, values in (("valid", bits), ("shadow", np.rint(100 * confidence).astype(np.uint8))):
        files.array(name)[camera, light, view.window.rows, view.window.columns] = values
    quality = done.quality
    picture = files.folder / "quality" / f"{quality.camera}_{quality.light}.png"
    write_picture(picture, _read(files, view, "radiance", light), bits)
    covered, error_px = view.footprint.covered, quality.motion_error_px
    changed = {
        "quality": assess(
            quality.camera,
            quality.light,
            bits,
            covered,
            quality.motion_px,
            error_px,
            (quality.levels, quality.noise),
        ),
        "tooth_pixels": tuple(subject.pixels_of_teeth(view.footprint, bits).tolist()),
        "files": files.files_of(camera, light, picture),
        "objects": files.objects_of(camera, light),
        "shaded": True,
    }
    files.put_image(camera, light, done.model_copy(update=changed))


def _squares(values: NDArray[Any], step: int) -> NDArray[np.float32]:
    """Sums (h, w, …) over squares of ``step`` pixels; those at the far edges are smaller."""
    rows = np.add.reduceat(values, np.arange(0, values.shape[0], step), axis=0)
    return np.asarray(np.add.reduceat(rows, np.arange(0, values.shape[1], step), axis=1), dtype=np.float32)


def _finer(confidence: Image, step: int, covered: NDArray[np.bool_]) -> Image:
    """A coarse image at every pixel that shows a tooth."""
    fine = confidence.repeat(step, axis=0).repeat(step, axis=1)[: covered.shape[0], : covered.shape[1]]
    return np.where(covered, fine, np.float32(0))


def _read(files: AttemptFiles, view: View, name: str, light: int) -> NDArray[Any]:
    return np.asarray(files.array(name)[view.number, light, view.window.rows, view.window.columns])
