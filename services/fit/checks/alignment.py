"""Whether photographs show the teeth where the meshes are: if not, how far apart they are as a camera sees it.

The fitted render is slid over the photograph (``offset``). Where that explains most of what the fit left unexplained,
and more than noise could, no medium, light or noise is to blame but a pose. Offsets along the line of sight cannot be
seen in this way, and turns are not looked for.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.core.records import MaskBit
from services.fit.checks.evaluate import Evaluation
from services.fit.checks.offset import Comparison, FoundOffset, Slide, best_offset
from services.fit.inputs.levels import LevelReader, whole_squares
from services.fit.inputs.observations import Observations, ViewStack

LOOKED_AT = 0.05
"""Relative image error above which a fit asks for its offset: what is explained better shows no shift that matters."""
MIN_MM = 0.5
"""Least offset that is told; a registration of scan and photographs is good to about 0.1 mm."""
MIN_PX = 0.75
"""And in pixels of the fit, which may be a millimetre wide: nearer to the next pixel than to its own place. A whole
pixel was too much: three rendered teeth 1 mm aside in pixels of 1 mm were told in 96 of 144 cameras with it, in 144
without, and in place in none of 72."""
MIN_GAIN = 0.55
"""Share of the unexplained squared difference that an offset has to take away. Rendered teeth off by 1 mm gave 0.53 to
1; in place 0, with stains, gums or absorption that the render lacks too, and at most 0.5 with a third of the
scattering."""
MIN_Z = 3.0
"""Standard errors that what goes away has to reach. Noise passes at one shift with a chance of 1e-3, and is tried at
some 300 that are far from independent: of 720 draws in place, 480 of them of a dim image alone, none reached 2."""
MIN_SE_MM = 0.01
"""Least ± that is told: what an offset is off by besides noise, such as by its pixels, is more."""
MIN_PIXELS = 16


@dataclass(frozen=True)
class Offset:
    """By how much the photographs of a camera lie beside the mesh, across the line of sight."""

    camera: str
    right_mm: float
    down_mm: float
    length_se_mm: float
    """One standard error of ``length_mm`` by the photographs' noise."""
    gain: float
    """Share of the unexplained squared difference that goes away."""

    @property
    def length_mm(self) -> float:
        """How far."""
        return float(np.hypot(self.right_mm, self.down_mm))

    def sentence(self, what: str) -> str:
        """What is wrong and what to do."""
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
    """The offset of the camera that shows one most clearly, or None where none does.

    Args:
        evaluation: of the final answer, with the images to compare.
        tooth: position of the one tooth of a jaw to look at; None for all that was fitted.
    """
    found = [
        _offset(view, pixel_mm, images, tooth)
        for view, pixel_mm, images in _compared(evaluation, observations, views, channel)
    ]
    return max((offset for offset in found if offset is not None), key=lambda offset: offset.gain, default=None)


def _compared(
    evaluation: Evaluation, observations: Observations, views: tuple[ViewStack, ...], channel: str
) -> list[tuple[ViewStack, float, list[Comparison]]]:  # fmt: skip
    seen = np.flatnonzero(np.any([view.valid.any(axis=1) for view in views], axis=0))
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
            light = int(seen[shown])
            # What lies beside the teeth is compared too: a mask that was drawn from a wrong pose hides the very pixels
            # that tell.
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
    return told_offset(view.camera.name, images, chosen.astype(np.int64), pixel_mm)


def told_offset(camera: str, images: list[Comparison], pixels: NDArray[np.int64], pixel_mm: float) -> Offset | None:
    """The offset of a camera's photographs beside their renders, if it is clear and large enough to be told.

    Args:
        pixels: (N, 2) of the render that are compared.
        pixel_mm: edge of a pixel at the tooth.
    """
    if len(pixels) < MIN_PIXELS or not images:
        return None
    found = best_offset(Slide(images, pixels), pixel_mm)
    return None if found is None or not _is_clear(found, pixel_mm) else _in_mm(camera, found, pixel_mm)


def _is_clear(found: FoundOffset, pixel_mm: float) -> bool:
    is_large = found.length_px * pixel_mm > MIN_MM and found.length_px > MIN_PX
    return is_large and found.gain >= MIN_GAIN and found.z >= MIN_Z and np.isfinite(found.length_se_px)


def _in_mm(camera: str, found: FoundOffset, pixel_mm: float) -> Offset:
    return Offset(
        camera, found.right_px * pixel_mm, found.down_px * pixel_mm, found.length_se_px * pixel_mm, found.gain
    )


def offsets_told(
    evaluations: Mapping[str, Evaluation],
    errors: Mapping[str, float],
    observations: Observations,
    views: Mapping[str, tuple[ViewStack, ...]],
    what: str,
    tooth: int | None = None,
) -> list[str]:
    """A sentence for each channel whose images lie beside the mesh.

    Args:
        errors: relative image error by channel.
        what: whose mesh, such as "the mesh of tooth 11".
        tooth: position of the one tooth of a jaw to look at; None for all that was fitted.
    """
    found = {
        c: clearest_offset(evaluations[c], observations, views[c], c, tooth)
        for c, error in errors.items()
        if error > LOOKED_AT
    }
    return [f"{channel}: {offset.sentence(what)}" for channel, offset in found.items() if offset is not None]
