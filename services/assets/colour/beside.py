"""Photographs of a capture beside renders of its asset, in colour: the picture with which a report begins.

Light is additive, so the photographs under several lights make that under all of them, with less noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from services.assets.asset import medium_of, mouth_of, tissue_of
from services.assets.colour.develop import CapturedColours, developed, diffuser_radiance
from services.assets.colour.seen import Surfaces, seen
from services.assets.colour.smoothing import smoothed_colours, smoothed_halves
from services.assets.colour.spaces import LINEAR_SRGB
from services.assets.content import RGB
from services.core.geometry import Camera, Light, Mesh, Tooth, Vector3
from services.core.records import JobSpec
from services.core.results import FitReport, PreparedManifest
from services.core.store import StoredArray
from services.transport.optics.parameters import Mouth, Tissue

Floats = NDArray[np.float64]
PATHS = 850_000
"""Paths of a render in each channel at the default of ``samples_per_pixel``; three channels take some 25 s of one
core."""
USUAL_SAMPLES = 64
"""The default of ``samples_per_pixel``; jobs of fewer get fewer paths."""
FILM_PX = 512
"""Least size of a render's larger side, as far as the paths suffice."""
MIN_SAMPLES = 4
"""Paths per pixel, of all pairs together, below which the film becomes smaller."""
MARGIN_PX = 2
"""Pixels of the photograph around what it shows of the surface."""
SMOOTHED_SHARE = 1 / 25
"""Radius of the filter's squares, as a share of the picture's larger side: some 0.6 mm of a tooth."""
FILLED = 0.99
"""Least share of a pixel that teeth, or the object, cover where photograph and render are compared."""


@dataclass(frozen=True)
class Pair:
    """A photograph and the render in the same view and lights, linear sRGB, with 1 for a perfect diffuser that faces
    each light.
    """

    lights: tuple[str, ...]
    """The lights, each taken as bright as the others; the pictures show their mean."""
    held_out: bool
    """Whether the fit has seen none of these photographs."""
    photo: Floats
    """Photograph (h, w, 3)."""
    render: Floats
    """Render (H, W, 3), larger by a whole number."""
    render_noise: Floats
    """Covariance (3, 3) of the render's noise in red, green and blue, relative to itself."""
    compared: NDArray[np.bool_]
    """Pixels (h, w) of the photograph that teeth, or the object, fill."""

    @property
    def lit(self) -> str:
        """The lights in words."""
        return self.lights[0] if len(self.lights) == 1 else f"{len(self.lights)} lights together"


@dataclass(frozen=True)
class Beside:
    """Pairs of one camera."""

    camera: str
    pairs: tuple[Pair, ...]
    is_calibrated: bool
    """Whether a calibration tells the camera's colours; else its channels are taken for linear sRGB."""
    samples: int
    """Paths per pixel of the renders."""
    has_surroundings: bool = False
    """Whether the renders show gums and teeth around a single one, which its asset does not have."""


@dataclass(frozen=True)
class Shown:
    """What is rendered: an asset's surfaces in its views and lights."""

    teeth: tuple[Tooth, ...]
    """With the fitted dentin."""
    cameras: tuple[Camera, ...]
    lights: tuple[Light, ...]
    """``intensity`` in the order of the fitted channels."""
    middle_mm: Vector3
    """Where the white diffuser is."""
    gums: Mesh | None = None
    cavity: Mesh | None = None
    neighbours: tuple[Tooth, ...] = ()
    """Teeth around a single one, which the fit took to have its media."""

    @property
    def surfaces(self) -> Surfaces:
        """What a camera may see."""
        return Surfaces(self.teeth, self.gums, self.cavity, self.neighbours)


def beside(
    spec: JobSpec, report: FitReport, prepared: PreparedManifest, radiance: StoredArray, shown: Shown
) -> Beside | None:
    """Render an asset by the fit's path tracing, in the view of the camera whose pixels show most of it: under all
    lights together, and under those together that the fit has not seen.

    Args:
        radiance: photographs (K, L, H, W, C) in the order of the preparation.

    Returns:
        None where red, green and blue were not all fitted.
    """
    channels = tuple(report.parameters)
    if not set(RGB) <= set(channels):
        return None
    covers = [seen(camera, shown.surfaces).teeth for camera in shown.cameras]
    number = int(np.argmax([float(cover.sum()) for cover in covers]))
    camera, paths = shown.cameras[number], PATHS * min(1.0, spec.samples_per_pixel / USUAL_SAMPLES)
    crop = _crop(covers[number])
    larger, smaller = _scale(covers[number][crop], paths)
    film = _resized(camera, crop, larger, smaller)
    used = [k for k, light in enumerate(shown.lights) if light.name not in spec.left_out_lights]
    lights = [shown.lights[k] for k in used]
    unseen = np.array([(camera.name, light.name) in prepared.held_out for light in lights])
    choices = [np.arange(len(used))]
    if 0 < unseen.sum() < len(used):
        choices.append(np.flatnonzero(unseen))
    own = [channels.index(channel) for channel in RGB]
    white = np.array([np.broadcast_to(diffuser_radiance(one, shown.middle_mm), len(channels))[own] for one in lights])
    order = [prepared.channels.index(channel) for channel in RGB]
    photos = [_photo(radiance, number, k, crop, smaller)[..., order] / white[n] for n, k in enumerate(used)]
    view = seen(film, shown.surfaces)
    renders, samples = _renders(spec, report, shown, film, lights, choices, view.covered, paths)
    colours = CapturedColours(RGB, prepared.colour or {}).cameras.get(camera.name)
    radius, times = max(2, round(SMOOTHED_SHARE * max(film.size))), film.size[1] // photos[0].shape[0]
    filled = square_means(view.teeth, times) > FILLED

    def pair(choice: NDArray[np.intp], render: Floats) -> Pair:
        halves = view.by_part(lambda own, cover: np.stack(smoothed_halves(own, view.normals, cover, radius)), render)
        one, two = (developed(square_means(half, times)[filled], colours, LINEAR_SRGB) for half in halves)
        deviation = (one - two) / np.maximum(one + two, 1e-12)
        return Pair(
            tuple(lights[k].name for k in choice),
            bool(unseen[choice].all()),
            developed(np.mean([photos[k] for k in choice], axis=0), colours, LINEAR_SRGB),
            developed(
                view.by_part(lambda own, cover: smoothed_colours(own, view.normals, cover, radius), render),
                colours,
                LINEAR_SRGB,
            ),
            deviation.T @ deviation / max(1, len(deviation)),
            filled,
        )

    pairs = tuple(pair(choice, render) for choice, render in zip(choices, renders, strict=True))
    around = bool(shown.neighbours) or (shown.gums is not None and not report.teeth)
    return Beside(camera.name, pairs, colours is not None, samples, around)


def square_means(values: Floats, edge: int) -> Floats:
    """Means of an image (H, W, ...) over squares of pixels."""
    height, width = (size // edge for size in values.shape[:2])
    return np.asarray(values.reshape(height, edge, width, edge, *values.shape[2:]).mean(axis=(1, 3)))


def _crop(covered: Floats) -> tuple[slice, slice]:
    """Rows and columns around all that is covered; everything where nothing is."""
    found = []
    for axis, size in enumerate(covered.shape):
        places = np.flatnonzero(covered.any(axis=1 - axis))
        first, last = (places[0], places[-1] + 1) if len(places) else (0, size)
        found.append(slice(max(0, int(first) - MARGIN_PX), min(size, int(last) + MARGIN_PX)))
    return found[0], found[1]


def _scale(covered: Floats, paths: float) -> tuple[int, int]:
    """By which whole numbers the film is larger and smaller than the photograph; one of them is 1."""
    affordable = np.sqrt(paths / MIN_SAMPLES / max(1, int((covered > 0).sum())))
    larger = max(1, min(-(-FILM_PX // max(covered.shape)), int(affordable)))
    return larger, max(1, int(np.ceil(1 / affordable))) if larger == 1 else 1


def _resized(camera: Camera, crop: tuple[slice, slice], larger: int, smaller: int) -> Camera:
    rows, columns = crop
    k = np.array(camera.K)
    k[:2, 2] -= columns.start, rows.start
    k[:2] *= larger / smaller
    size = [(part.stop - part.start) * larger // smaller for part in (columns, rows)]
    return camera.model_copy(update={"K": tuple(tuple(row) for row in k.tolist()), "size": tuple(size)})


def _photo(radiance: StoredArray, camera: int, light: int, crop: tuple[slice, slice], smaller: int) -> Floats:
    photo = np.nan_to_num(radiance[camera, light, crop[0], crop[1]].astype(np.float64))
    height, width = (size // smaller for size in photo.shape[:2])
    return square_means(photo[: height * smaller, : width * smaller], smaller)


def _media(report: FitReport, channel: str, shown: Shown) -> Mouth | Tissue:
    if report.teeth:
        return mouth_of(report, channel)
    table = report.parameters[channel]
    return replace(tissue_of(table), gums=None if shown.gums is None else medium_of(table, "gums"))


def _renders(
    spec: JobSpec,
    report: FitReport,
    shown: Shown,
    film: Camera,
    lights: Sequence[Light],
    choices: Sequence[NDArray[np.intp]],
    covered: Floats,
    paths: float,
) -> tuple[list[Floats], int]:
    """Noisy render (H, W, 3) under the mean of each choice of lights, relative to a perfect diffuser; and paths per
    pixel.
    """
    from services.anatomy.dentin_shape import DentinShape
    from services.transport.engine import Engine
    from services.transport.scene.recipe import SceneRecipe, ToothSurfaces, View

    order = [int(fdi) for fdi in report.teeth] or [tooth.fdi for tooth in shown.teeth]
    teeth, neighbours = (
        tuple(
            ToothSurfaces(tooth.outer, None if tooth.dentin is None else DentinShape.known(tooth.dentin))
            for tooth in group
        )
        for group in (sorted(shown.teeth, key=lambda tooth: order.index(tooth.fdi)), shown.neighbours)
    )
    pixels = np.argwhere(covered > 0)[:, ::-1].astype(np.int32)
    samples = max(1, round(paths / len(choices) / max(1, len(pixels))))
    images = [np.zeros((*covered.shape, 3)) for _ in choices]
    positions = np.array([light.position_mm for light in lights])
    # A perfect diffuser that faces a light of this intensity has the radiance 1.
    intensities = np.pi * np.sum((positions - np.array(shown.middle_mm)) ** 2, axis=1)
    for k, channel in enumerate(RGB):
        recipe = SceneRecipe(
            teeth, positions, intensities, spec.boundary, spec.ior, spec.device, gums=shown.gums, cavity=shown.cavity,
            neighbours=neighbours,
        )  # fmt: skip
        tissue = _media(report, channel, shown)
        engine = Engine(recipe.with_surface(report.surface))
        for image, choice in zip(images, choices, strict=True):
            view = View(film, pixels, tuple(choice.tolist()))
            found = engine.images(tissue, view, seed=spec.seed, samples=samples, batches=1).mean
            image[pixels[:, 1], pixels[:, 0], k] = found[choice].mean(axis=0)
    return images, samples
