"""Advice on the further light or view that would help most, from Jacobians of planned images on a few hundred pixels
and the fit's covariance.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.core.files.content_files import StoredFile
from services.core.geometry import Camera
from services.core.results import Estimate
from services.fit.checks.identifiability import QUANTITIES, quantity_in_words
from services.fit.coordinates.instrument_errors import DEFAULT_SE
from services.fit.measurements.blocks import BlockInstrument, BlockTask, PixelBlock, write_block
from services.fit.measurements.instrument.photographs import block_of, error_derivatives
from services.fit.passes.derivatives import Differentiation
from services.fit.passes.passes import StackProblem, TraceRow, trace_row
from services.fit.solve.covariance import Uncertainty
from services.fit.solve.estimates import estimates
from services.fit.solve.information import AddedInformation, added_information, covariance_after
from services.fit.solve.sandwich import Sandwich
from services.tasks.engine_host import EngineHost
from services.transport.optics.parameters import Tissue
from services.transport.scene.recipe import SceneRecipe, View
from services.transport.scene.recipe_files import read_recipe, write_recipe
from services.transport.scene.rigid_moves import rigid

Array = NDArray[np.float64]

PIXELS = 100
"""Number of pixels of each view, spread evenly."""
VIEW_ANGLE = np.radians(60)
"""Angle in rad by which candidate views are turned from the first camera."""
MIN_REDUCTION = 0.1
"""Least relative reduction of an error, including the prediction's own uncertainty, for which a candidate is
recommended."""
LIGHTS = {
    "at the left": (-1, 0, 0), "at the right": (1, 0, 0), "above": (0, 1, 0), "below": (0, -1, 0),
    "beside the camera": (0, 0, 1), "behind the tooth": (0, 0, -1), "at the left behind the tooth": (-1, 0, -1),
    "at the right behind the tooth": (1, 0, -1), "above, behind the tooth": (0, 1, -1),
}  # fmt: skip
"""Directions from the tooth in the first camera's axes: right, up, towards the camera."""
VIEWS = {"60° further to the left": (0, -1, 0), "60° further to the right": (0, 1, 0), "60° higher": (-1, 0, 0)}
"""Axes (right, up, towards the camera) about which the first camera is turned around the tooth."""


@dataclass(frozen=True)
class Candidate:
    """A planned light or view; the halves are predictions from two sets of pixels."""

    words: str
    halves: tuple[AddedInformation, AddedInformation]

    @property
    def whole(self) -> AddedInformation:
        """Prediction from all pixels."""
        return self.halves[0] + self.halves[1]


@dataclass(frozen=True)
class Sensor:
    """Expected noise of an image: standard deviations as a share of the value and as a share of the image's maximum."""

    relative: float
    floor: float

    def variance(self, image: Array) -> Array:
        """Noise variance (L, N) of images (L, N)."""
        return np.asarray((self.relative * image) ** 2 + (self.floor * image.max(axis=-1, keepdims=True)) ** 2)


@dataclass(frozen=True)
class Probe:
    """A view of planned images, stored as a block, and the number of measurements that the fit would have for each
    measurement of the block.
    """

    block: StoredFile
    words: tuple[str, ...]
    """Candidate to which each light belongs, '' for lights that do not count."""
    ratio: float
    own_error: str = ""
    """Kind of error that such images add: a new light's gain, a new camera's flare; '' where the instrument counts as
    exact."""


def capture_advice(
    problem: StackProblem[Tissue],
    uncertainty: Uncertainty,
    folder: Path,
    parts: Sequence[str],
    sensor: Sensor,
    weight: float,
    samples: int,
) -> tuple[str, tuple[Candidate, ...]]:
    """One sentence on the light or view that would reduce the largest relative error most, and all candidates; '' where
    there are none.

    Args:
        problem: the least-squares problem at the solution, which is its base.
        uncertainty: uncertainty at the solution.
        folder: receives the scenes and blocks of the planned images.
        parts: names of the media, such as ``enamel``.
        sensor: expected noise of the planned images.
        weight: weight of a measurement in the fit.
        samples: paths per pixel and seed, as in the fit's last measurement.
    """
    assert uncertainty.sandwich is not None
    recipe, probes = probes_of(problem, folder)
    _, similar, differentiation = problem.jacobian_media(uncertainty.x)
    seeds = problem.seed(0, "advice-1"), problem.seed(0, "advice-2")
    images = problem.seed(0, "advice-image-1"), problem.seed(0, "advice-image-2")
    run, label, pending = problem.passes.executor, f"{problem.passes.seeds.channel}-advice", []
    for index, probe in enumerate(probes):
        task = BlockTask(probe.block, index, recipe, label, similar, samples)
        pending.append(
            run.submit(
                f"{label}-{index}",
                advice_task,
                task,
                differentiation,
                seeds,
                uncertainty.sandwich,
                images,
                probe,
                sensor,
                weight,
            )
        )
    parts_found: list[tuple[dict[str, tuple[AddedInformation, AddedInformation]], TraceRow]] = run.gather(pending)
    problem.passes.record([row for _, row in parts_found])
    sums: dict[str, tuple[AddedInformation, AddedInformation]] = {}
    for found, _ in parts_found:
        for words, (first, second) in found.items():
            sums[words] = (sums[words][0] + first, sums[words][1] + second) if words in sums else (first, second)
    candidates = tuple(Candidate(words, halves) for words, halves in sums.items())
    return sentence(problem.base, parts, uncertainty, candidates), candidates


def sentence(tissue: Tissue, parts: Sequence[str], uncertainty: Uncertainty, candidates: Sequence[Candidate]) -> str:
    """Sentence on the best candidate, judged by the quantity with the largest relative error, or by the next ones where
    no candidate reduces that one.
    """
    before = relative_errors(estimates(tissue, parts, uncertainty))
    if not before or not candidates:
        return ""
    names = sorted(before, key=lambda name: -before[name])
    found = [(candidate, predicted(tissue, parts, uncertainty, candidate)) for candidate in candidates]
    for name in names:
        candidate, (after, prediction_se) = min(((c, p[name]) for c, p in found), key=lambda entry: sum(entry[1]))
        if after + prediction_se <= (1 - MIN_REDUCTION) * min(before[name], 1.0):
            initial = in_percent(before[name]) if before[name] <= 1 else "more than 100 %"
            return (
                f"{candidate.words} would help most: it would cut the error of {quantity_in_words(name)} from {initial}"
                f" to {in_percent(after)}."
            )
    return (
        f"None of the {len(candidates)} further lights and views that were tried would cut the error of"
        f" {quantity_in_words(names[0])} by more than a tenth."
    )


def predicted(
    tissue: Tissue, parts: Sequence[str], uncertainty: Uncertainty, candidate: Candidate
) -> dict[str, tuple[float, float]]:
    """Relative errors with a candidate's images, and the uncertainty of these predictions: two predictions from half
    the pixels each, counted twice, differ by noise alone.
    """

    def after(added: AddedInformation) -> dict[str, float]:
        return relative_errors(
            estimates(tissue, parts, replace(uncertainty, covariance=covariance_after(uncertainty, added)))
        )

    whole, *halves = (after(added) for added in (candidate.whole, *(half.scaled(2) for half in candidate.halves)))
    return {name: (value, 0.5 * abs(halves[0][name] - halves[1][name])) for name, value in whole.items()}


def relative_errors(table: Mapping[str, Estimate]) -> dict[str, float]:
    """Relative standard errors of the report's leading quantities."""
    return {
        name: e.se / abs(e.value)
        for name, e in table.items()
        if name.rpartition(".")[2] in QUANTITIES and e.se is not None and e.se > 0 and e.value != 0
    }


def probes_of(problem: StackProblem[Tissue], folder: Path) -> tuple[StoredFile, tuple[Probe, ...]]:
    """Scene with the candidate lights added, and views to predict: the fit's own under these lights, and further views
    under the present lights.
    """
    blocks, recipe = problem.passes.read_blocks(), read_recipe(problem.passes.recipe)
    cameras = {block.view.camera.name: block.view.camera for block in blocks}
    first, lights = next(iter(cameras.values())), len(recipe.light_positions_mm)
    vertices = recipe.teeth[0].outer.vertices_mm
    centre = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    distance = float(np.median(np.linalg.norm(recipe.light_positions_mm - centre, axis=1)))
    axes = np.asarray(first.camera_from_world)[:3, :3] * np.array([[1.0], [-1.0], [-1.0]])
    added = np.array(
        [centre + distance * (np.asarray(d, dtype=float) / np.linalg.norm(d)) @ axes for d in LIGHTS.values()]
    )
    more = replace(
        recipe,
        light_positions_mm=np.vstack([recipe.light_positions_mm, added]),
        light_intensities=np.concatenate(
            [recipe.light_intensities, np.full(len(added), np.median(recipe.light_intensities))]
        ),
    )
    light_words = tuple(f"A light {words}" for words in LIGHTS)
    probes = []
    for name, camera in cameras.items():
        own = [block for block in blocks if block.view.camera.name == name]
        pixels = np.concatenate([block.view.pixels for block in own])
        probes.append(_probe(folder, camera, pixels, ("",) * lights + light_words, own[0].instrument, "light_gain"))
    for words, axis in VIEWS.items():
        camera = rotated_camera(first, centre, np.asarray(axis, dtype=float) @ axes)
        pixels = visible_pixels(camera, more, 1)
        if len(pixels):
            probes.append(
                _probe(
                    folder,
                    camera,
                    pixels,
                    (f"A camera {words}",) * lights + ("",) * len(added),
                    blocks[0].instrument,
                    "flare",
                )
            )
    return write_recipe(folder, more), tuple(probes)


def _probe(
    folder: Path,
    camera: Camera,
    pixels: NDArray[np.int32],
    words: tuple[str, ...],
    instrument: BlockInstrument | None,
    own_error: str,
) -> Probe:
    chosen = pixels[np.unique(np.linspace(0, len(pixels) - 1, min(PIXELS, len(pixels))).astype(int))]
    shape = (len(words), len(chosen))
    counted = np.array([word != "" for word in words])
    block = PixelBlock(
        View(camera, chosen),
        np.zeros(shape),
        np.ones(shape),
        np.where(counted[:, None], np.ones(shape), 0.0),
        np.zeros(shape, dtype=bool),
        instrument=None if instrument is None else _of_new_images(instrument, len(words), own_error),
    )
    return Probe(write_block(folder, block), words, len(pixels) / len(chosen), "" if instrument is None else own_error)


def _of_new_images(instrument: BlockInstrument, lights: int, own_error: str) -> BlockInstrument:
    # Errors of the fit that also act on planned images: gains of its lights, and flares of its cameras.
    flare = "" if own_error == "flare" else instrument.flare
    return replace(instrument, lights=instrument.lights + ("",) * (lights - len(instrument.lights)), flare=flare)


def rotated_camera(camera: Camera, centre_mm: Array, axis: Array) -> Camera:
    """The camera turned around a point about an axis by ``VIEW_ANGLE``, still looking at the point as before."""
    rotation = rigid(np.concatenate([VIEW_ANGLE * axis, np.zeros(3)]), centre_mm)
    moved = np.asarray(camera.camera_from_world) @ np.linalg.inv(rotation)
    return Camera.model_validate(camera.model_dump() | {"camera_from_world": tuple(map(tuple, moved.tolist()))})


def visible_pixels(camera: Camera, recipe: SceneRecipe, step: int) -> NDArray[np.int32]:
    """Every ``step``-th pixel (N, 2) in whose cell a point of the tooth's surface appears."""
    outer = recipe.teeth[0].outer
    corners = outer.vertices_mm[outer.faces]
    weights = np.array([(i, j, 4 - i - j) for i in range(5) for j in range(5 - i)]) / 4
    points, depth = camera.project(np.einsum("wc,fcx->wfx", weights, corners).reshape(-1, 3))
    cells = np.unique(np.floor(points[depth > 0] / step).astype(np.int64), axis=0)
    inside = ((cells >= 0) & (cells * step < np.asarray(camera.size))).all(axis=1)
    return (cells[inside] * step).astype(np.int32)


def advice_task(
    host: EngineHost,
    task: BlockTask,
    differentiation: Differentiation,
    seeds: tuple[int, int],
    sandwich: Sandwich,
    image_seeds: tuple[int, int],
    probe: Probe,
    sensor: Sensor,
    weight: float,
) -> tuple[dict[str, tuple[AddedInformation, AddedInformation]], TraceRow]:
    """Information that one view adds, by candidate, from its even and its odd pixels, and the task's trace."""
    start, block = time.time(), block_of(task)
    view, half = block.fitted_view, max(task.samples // 2, 1)
    images = [
        np.asarray(
            host.call("images", task.recipe, task.tissue, view, samples=half, seed=seed, batches=1).mean,
            dtype=np.float64,
        )
        for seed in image_seeds
    ]
    expected = 0.5 * (images[0] + images[1])
    error_rows = error_derivatives(expected, block, differentiation.errors)
    slopes = [
        np.concatenate([rows, error_rows]).reshape(-1, *expected.shape)
        for rows in differentiation.render(host, task, view, seeds, block.parts)
    ]
    variance = sensor.variance(expected)
    out = {}
    for words in dict.fromkeys(word for word in probe.words if word):
        lights = np.array([word == words for word in probe.words])
        halves = []
        for odd in (0, 1):
            first, second = (rows[:, lights, odd::2].reshape(len(rows), -1) for rows in slopes)
            renders = [image[lights, odd::2].reshape(-1) for image in images]
            one = added_information(
                sandwich,
                (first, second),
                (renders[0], renders[1]),
                variance[lights, odd::2].reshape(-1),
                weight,
                _own_errors(probe, expected, block.instrument, differentiation.errors)[:, lights, odd::2].reshape(
                    -1, renders[0].size
                ),
            )
            halves.append(one.scaled(probe.ratio))
        out[words] = (halves[0], halves[1])
    return out, trace_row("advice", task, start)


def _own_errors(probe: Probe, image: Array, instrument: BlockInstrument | None, fitted: tuple[str, ...]) -> Array:
    """Change (K, L, N) of new images by one standard error of the error that they add; empty where the fit has no
    errors of the instrument.
    """
    if not probe.own_error or instrument is None or not fitted:
        return np.zeros((0, *image.shape))
    changed = image if probe.own_error == "light_gain" else np.full(image.shape, instrument.brightest)
    return np.asarray(DEFAULT_SE[probe.own_error] * changed[None])


def in_percent(fraction: float) -> str:
    """A relative error in percent, as the sentences of a report state it."""
    return f"{100 * fraction:.0f} %" if fraction >= 0.1 else f"{100 * fraction:.1f} %"
