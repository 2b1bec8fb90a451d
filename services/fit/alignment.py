"""Whether photographs show the teeth where the meshes are: if not, how far apart they are as a camera sees it.

The fitted render is slid over the photograph. Where that explains most of what the fit left unexplained, no medium, light or noise is to blame but a pose.
Offsets along the line of sight, and turns, are not looked for.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.core.records import MaskBit
from services.core.store import StoredArray
from services.fit.evaluate import Evaluation
from services.fit.observations import Observations, ViewStack

Array = NDArray[np.float64]

LOOKED_AT = 0.05
"""Relative image error above which a fit asks for its offset: what is explained better shows no shift that matters."""
REACH_MM = 4.0
"""Farthest offset that is looked for, half of a small tooth."""
LEAST_MM = 0.5
"""Least offset that is told, if it is more than a pixel; a registration of scan and photographs is good to about 0.1 mm."""
LEAST_GAIN = 0.55
"""Share of the unexplained squared difference that an offset has to take away. Rendered teeth off by 2 mm gave 0.63 to 0.83, by 1 mm 0.57 to 0.64; in place 0,
with stains, gums or absorption that the render lacks too, and at most 0.5 with a third of the scattering."""
LEAST_PIXELS = 16
GRID = 8
"""Offsets tried to each side before the best is refined."""


@dataclass(frozen=True)
class Offset:
    """By how much the photographs of a camera lie beside the mesh."""

    camera: str
    right_mm: float
    down_mm: float
    gain: float
    """Share of the unexplained squared difference that goes away."""

    @property
    def length_mm(self) -> float:
        """How far."""
        return float(np.hypot(self.right_mm, self.down_mm))

    def sentence(self, what: str) -> str:
        """What is wrong and what to do."""
        steps = [(self.right_mm, "right", "left"), (self.down_mm, "down", "up")]
        parts = [f"{abs(size):.1f} mm {name if size > 0 else other}" for size, name, other in steps if abs(size) >= 0.3 * self.length_mm]
        return (
            f"In camera {self.camera} images and {what} are about {self.length_mm:.1f} mm apart (the images lie {' and '.join(parts)}); "
            "recalibrate the camera or register the mesh again."
        )


def clearest_offset(evaluation: Evaluation, observations: Observations, views: tuple[ViewStack, ...], channel: str, tooth: int | None = None) -> Offset | None:
    """The offset of the camera that shows one most clearly, or None where none does.

    Args:
        evaluation: of the final answer, with the images to compare.
        tooth: position of the one tooth of a jaw to look at; None for all that was fitted.
    """
    found = [_offset(view, images, tooth) for view, images in _compared(evaluation, observations, views, channel)]
    return max((offset for offset in found if offset is not None), key=lambda offset: offset.gain, default=None)


@dataclass(frozen=True)
class _Compared:
    # One photograph (H, W) as taken, NaN where it is unusable, beside its render, NaN where nothing was fitted.
    photo: Array
    variance: Array
    render: Array
    pixel_mm: float


def _compared(
    evaluation: Evaluation, observations: Observations, views: tuple[ViewStack, ...], channel: str
) -> list[tuple[ViewStack, list[_Compared]]]:  # fmt: skip
    seen = np.flatnonzero(np.any([view.valid.any(axis=1) for view in views], axis=0))
    store, index = observations.folder / "prepared.zarr", observations.manifest.channels.index(channel)
    names = [camera.name for camera in observations.manifest.cameras]
    centre_mm = np.concatenate([tooth.outer.vertices_mm for tooth in observations.teeth]).mean(axis=0)
    pairs = []
    radiance, variance, bits = (StoredArray(store / name) for name in ("radiance", "variance", "valid"))
    for view in views:
        (width, height), number, images = view.camera.size, names.index(view.camera.name), []
        for (camera, shown), (pixels, values) in evaluation.renders.items():
            if camera != view.camera.name:
                continue
            light = int(seen[shown])
            # What lies beside the teeth is compared too: a mask that was drawn from a wrong pose hides the very pixels that tell.
            usable = bits[number, light][:height, :width] & ~np.uint16(MaskBit.OUTSIDE) == 0
            photo = np.where(usable, radiance[number, light][:height, :width, index].astype(np.float64), np.nan)
            noise = np.nan_to_num(variance[number, light][:height, :width, index].astype(np.float64))
            render = np.full((height, width), np.nan)
            render[pixels[:, 1], pixels[:, 0]] = values
            images.append(_Compared(photo, noise, render, view.camera.pixel_mm(centre_mm)))
        pairs.append((view, images))
    return pairs


def _offset(view: ViewStack, images: list[_Compared], tooth: int | None) -> Offset | None:
    chosen = view.pixels if tooth is None or view.parts is None else view.pixels[view.parts.shown == tooth]
    if len(chosen) < LEAST_PIXELS or not images:
        return None
    pixel_mm, x, y = images[0].pixel_mm, chosen[:, 0].astype(np.int64), chosen[:, 1].astype(np.int64)

    def unexplained(shift: tuple[int, int]) -> float:
        return sum(_difference(image, x, y, shift) for image in images) / len(images)

    # A grid over all offsets, then ever smaller steps around the best one, down to a pixel.
    step = max(round(REACH_MM / pixel_mm / GRID), 1)
    reach = round(REACH_MM / pixel_mm / step)
    tried = {(i * step, j * step): unexplained((i * step, j * step)) for i in range(-reach, reach + 1) for j in range(-reach, reach + 1)}
    best = min(tried, key=tried.__getitem__)
    while step > 1:
        step = max(step // 2, 1)
        around = [(best[0] + i * step, best[1] + j * step) for i in (-1, 0, 1) for j in (-1, 0, 1)]
        tried |= {shift: unexplained(shift) for shift in around if shift not in tried}
        best = min(tried, key=tried.__getitem__)
    if not np.isfinite(tried[best]) or tried[0, 0] <= 0:
        return None
    right, down = (_vertex([unexplained((best[0] + k * dx, best[1] + k * dy)) for k in (-1, 0, 1)]) for dx, dy in ((1, 0), (0, 1)))
    offset = Offset(view.camera.name, (best[0] + right) * pixel_mm, (best[1] + down) * pixel_mm, 1 - tried[best] / tried[0, 0])
    return offset if offset.gain >= LEAST_GAIN and offset.length_mm > max(LEAST_MM, pixel_mm) else None


def _vertex(values: list[float]) -> float:
    # Where a parabola through values at -1, 0 and 1 is least; 0 where it has no vertex between them.
    before, middle, after = values
    curvature = before - 2 * middle + after
    if not np.isfinite(curvature) or curvature <= 0:
        return 0.0
    return float(np.clip(0.5 * (before - after) / curvature, -0.5, 0.5))


def _difference(image: _Compared, x: NDArray[np.int64], y: NDArray[np.int64], shift: tuple[int, int]) -> float:
    # 1 - cos^2 between render and photograph seen as vectors, less the photograph's noise: their relative squared difference at the best brightness.
    height, width = image.photo.shape
    inside = (x + shift[0] >= 0) & (x + shift[0] < width) & (y + shift[1] >= 0) & (y + shift[1] < height)
    there = y[inside] + shift[1], x[inside] + shift[0]
    render, photo = image.render[y[inside], x[inside]], image.photo[there]
    known = np.isfinite(render) & np.isfinite(photo)
    if known.sum() < 0.7 * len(x):
        return np.inf
    a, b = render[known], photo[known]
    both = float((a @ a) * (b @ b))
    return max(1.0 - float(a @ b) ** 2 / both - float(image.variance[there][known].sum() / (b @ b)), 0.0) if both > 0 else np.inf


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
    found = {c: clearest_offset(evaluations[c], observations, views[c], c, tooth) for c, error in errors.items() if error > LOOKED_AT}
    return [f"{channel}: {offset.sentence(what)}" for channel, offset in found.items() if offset is not None]
