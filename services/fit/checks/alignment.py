"""Check that photographs show the teeth where the meshes are, and by how much they are apart in each camera's image.

The fitted render is shifted over the photograph (``offset``). Where a shift explains most of the remaining difference,
and more than noise could, the cause is a pose and not a medium, a light or noise. Offsets along the line of sight are
not visible in this way, and rotations are not tested.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.core.records import MaskBit
from services.fit.checks.offset import Comparison, FoundOffset, ShiftedRender, best_offset
from services.fit.measurements.levels import LevelReader, whole_squares
from services.fit.measurements.observations import Observations
from services.fit.measurements.view_stack import ViewStack
from services.fit.passes.evaluate import Evaluation

TESTED_ERROR = 0.05
"""Relative image error above which a fit is tested for an offset: below it, a shift does not matter."""
MIN_MM = 0.5
"""Least offset that is reported, in mm; a registration of scan and photographs is accurate to about 0.1 mm."""
MIN_PX = 0.75
"""Least offset that is reported, in pixels of the fit, which may be a millimetre wide: nearer to the next pixel than to
its own place. A limit of a whole pixel was too large: with it, three rendered teeth 1 mm aside in pixels of 1 mm were
reported in 96 of 144 cameras, with this limit in all 144, and teeth in place in none of 72."""
MIN_GAIN = 0.55
"""Least share of the unexplained squared difference that an offset has to remove. Rendered teeth that were off by 1 mm
gave 0.53 to 1; teeth in place gave 0, also with stains, gums or absorption that the render lacks, and at most 0.5 with
a third of the scattering."""
MIN_Z = 3.0
"""Least removed difference, in its own standard errors. By chance noise passes this limit at one shift with a
probability of 1e-3, and some 300 shifts are tried that are far from independent: of 720 draws in place, 480 of them of
a dim image alone, none reached 2."""
MIN_SE_MM = 0.01
"""Least standard error that is reported, in mm: other errors of an offset than noise, such as that of its pixels, are
larger."""
MIN_PIXELS = 16
"""Least number of pixels for which an offset is sought."""


@dataclass(frozen=True)
class Offset:
    """Offset of a camera's photographs from the mesh, across the line of sight."""

    camera: str
    right_mm: float
    down_mm: float
    length_se_mm: float
    """Standard error of ``length_mm`` by the photographs' noise."""
    gain: float
    """Share of the unexplained squared difference that the offset removes."""

    @property
    def length_mm(self) -> float:
        """Length of the offset."""
        return float(np.hypot(self.right_mm, self.down_mm))

    def sentence(self, what: str) -> str:
        """Sentence on the fault and its remedy."""
        steps = [(self.right_mm, "right", "left"), (self.down_mm, "down", "up")]
        parts = [
            f"{abs(size):.1f} mm {name if size > 0 else other}"
            for size, name, other in steps
            if abs(size) >= 0.3 * self.length_mm
        ]
        apart = (
            f"about {self.length_mm:.1f} mm apart, ± {max(self.length_se_mm, MIN_SE_MM):.1g} mm by the noise of both"
        )
        return (
            f"In camera {self.camera} images and {what} are {apart} (the images lie {' and '.join(parts)}); how far"
            " along the line of sight cannot be seen in this way; recalibrate the camera or register the mesh again."
        )


def clearest_offset(
    evaluation: Evaluation,
    observations: Observations,
    views: tuple[ViewStack, ...],
    channel: str,
    tooth: int | None = None,
) -> Offset | None:
    """Offset of the camera that shows one most clearly, or None where none does.

    Args:
        evaluation: evaluation of the final solution, with the images to compare.
        observations: the fit's observations.
        views: the observed views.
        channel: name of the channel.
        tooth: position of the one tooth of a jaw to compare; None for all fitted pixels.
    """
    found = [
        _offset(view, pixel_mm, images, tooth)
        for view, pixel_mm, images in _compared(evaluation, observations, views, channel)
    ]
    return max((offset for offset in found if offset is not None), key=lambda offset: offset.gain, default=None)


def _compared(
    evaluation: Evaluation, observations: Observations, views: tuple[ViewStack, ...], channel: str
) -> list[tuple[ViewStack, float, list[Comparison]]]:  # fmt: skip
    valid_lights = np.flatnonzero(np.any([view.valid.any(axis=1) for view in views], axis=0))
    store, index = observations.folder / "prepared.zarr", observations.manifest.channels.index(channel)
    cameras = {camera.name: camera for camera in observations.manifest.cameras}
    names = [camera.name for camera in observations.manifest.cameras]
    centre_mm = np.concatenate([tooth.outer.vertices_mm for tooth in observations.teeth]).mean(axis=0)
    pairs = []
    for view in views:
        (width, height), number, images = view.camera.size, names.index(view.camera.name), []
        whole_camera = cameras[view.camera.name]
        level = LevelReader(store, index, round(whole_camera.K[0][0] / view.camera.K[0][0]))
        for (camera, shown), (pixels, values) in evaluation.renders.items():
            if camera != view.camera.name:
                continue
            light = int(valid_lights[shown])
            # Compare pixels beside the teeth, too: a mask that was drawn from a wrong pose hides exactly those pixels
            # that show the offset.
            usable = whole_squares(
                level.bits(number, light, whole_camera) & ~np.uint16(MaskBit.OUTSIDE) == 0, level.step
            )
            measured, noise = level.image(number, light, whole_camera)
            photo, noise = np.where(usable, measured, np.nan), np.nan_to_num(noise)
            render, spread = np.full((height, width), np.nan), np.zeros((height, width))
            render[pixels[:, 1], pixels[:, 0]] = values
            spread[pixels[:, 1], pixels[:, 0]] = evaluation.spreads.get((camera, shown), 0.0)
            images.append(Comparison(photo, noise, render, spread))
        pairs.append((view, view.camera.pixel_mm(centre_mm), images))
    return pairs


def _offset(view: ViewStack, pixel_mm: float, images: list[Comparison], tooth: int | None) -> Offset | None:
    chosen = view.pixels if tooth is None or view.parts is None else view.pixels[view.parts.shown == tooth]
    return reported_offset(view.camera.name, images, chosen.astype(np.int64), pixel_mm)


def reported_offset(camera: str, images: list[Comparison], pixels: NDArray[np.int64], pixel_mm: float) -> Offset | None:
    """Offset of a camera's photographs from their renders, if it is clear and large enough to be reported.

    Args:
        camera: name of the camera.
        images: photographs beside their renders.
        pixels: pixels (N, 2) of the render that are compared.
        pixel_mm: edge of a pixel at the tooth.
    """
    if len(pixels) < MIN_PIXELS or not images:
        return None
    found = best_offset(ShiftedRender(images, pixels), pixel_mm)
    return None if found is None or not _is_clear(found, pixel_mm) else _in_mm(camera, found, pixel_mm)


def _is_clear(found: FoundOffset, pixel_mm: float) -> bool:
    is_large = found.length_px * pixel_mm > MIN_MM and found.length_px > MIN_PX
    return is_large and found.gain >= MIN_GAIN and found.z >= MIN_Z and np.isfinite(found.length_se_px)


def _in_mm(camera: str, found: FoundOffset, pixel_mm: float) -> Offset:
    return Offset(
        camera, found.right_px * pixel_mm, found.down_px * pixel_mm, found.length_se_px * pixel_mm, found.gain
    )


def offset_sentences(
    evaluations: Mapping[str, Evaluation],
    errors: Mapping[str, float],
    observations: Observations,
    views: Mapping[str, tuple[ViewStack, ...]],
    what: str,
    tooth: int | None = None,
) -> list[str]:
    """One sentence for each channel whose images lie beside the mesh.

    Args:
        evaluations: evaluations of the final solution by channel.
        errors: relative image error by channel.
        observations: the fit's observations.
        views: observed views by channel.
        what: name of the mesh in the sentence, such as "the mesh of tooth 11".
        tooth: position of the one tooth of a jaw to compare; None for all fitted pixels.
    """
    found = {
        c: clearest_offset(evaluations[c], observations, views[c], c, tooth)
        for c, error in errors.items()
        if error > TESTED_ERROR
    }
    return [f"{channel}: {offset.sentence(what)}" for channel, offset in found.items() if offset is not None]
