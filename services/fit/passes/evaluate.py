"""Evaluation of renders against photographs: the relative image error, without the noise of either.

    err^2 = [sum (C1 - ref)(C2 - ref) - sum var_ref] / [sum ref^2 - sum var_ref]

over valid pixels, in linear radiance, with C1 and C2 two independent renders. Monte Carlo noise cancels in the product,
and sensor noise is subtracted, so a perfect model has error 0 on average whatever the noise; a negative square is noise
and counts as 0. A reported error is never below its own Monte Carlo standard error, so that few samples cannot look
like a perfect fit.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from services.fit.measurements.blocks import BlockTask
from services.fit.measurements.instrument.photographs import block_of, photographed
from services.fit.passes.passes import Passes, TraceRow, trace_row
from services.tasks.engine_host import EngineHost
from services.transport.optics.parameters import Mouth, Tissue

Array = NDArray[np.float64]

SIGNIFICANT_Z = 3.0
"""Standard errors by the renders' noise beyond which a photograph's error is its own."""


@dataclass(frozen=True)
class ErrorSums:
    """Sums over measurements; the sums of blocks add."""

    product: float = 0.0
    reference_squared: float = 0.0
    reference_variance: float = 0.0
    product_noise: float = 0.0
    """Monte Carlo variance of ``product``. The lights of a pixel share their walks, so their errors are summed before
    they are squared."""

    def __add__(self, other: ErrorSums) -> ErrorSums:
        return ErrorSums(
            self.product + other.product,
            self.reference_squared + other.reference_squared,
            self.reference_variance + other.reference_variance,
            self.product_noise + other.product_noise,
        )

    @property
    def error(self) -> float | None:
        """Relative image error, 0.05 for 5 %; None where there is no signal."""
        signal = self.reference_squared - self.reference_variance
        return float(np.sqrt(max(self.product - self.reference_variance, 0.0) / signal)) if signal > 0 else None

    @property
    def loss(self) -> float | None:
        """Relative squared error, with the reference's noise included, and not below its own Monte Carlo standard
        error.
        """
        signal = self.reference_squared
        return float(max(self.product, np.sqrt(self.product_noise)) / signal) if signal > 0 else None

    @property
    def resolved_error(self) -> float | None:
        """``error``, and not below its own Monte Carlo standard error."""
        return None if self.error is None or self.error_se is None else max(self.error, self.error_se)

    @property
    def error_se(self) -> float | None:
        """Monte Carlo standard error of ``error``. At error 0 it is the error whose square equals the standard error of
        the squared error.
        """
        error, signal = self.error, self.reference_squared - self.reference_variance
        if error is None:
            return None
        square_se = np.sqrt(self.product_noise) / signal
        return float(min(square_se / (2 * error), np.sqrt(square_se))) if error > 0 else float(np.sqrt(square_se))


def error_sums(first: Array, second: Array, reference: Array, variance: Array, chosen: NDArray[np.bool_]) -> ErrorSums:
    """Sums over the chosen measurements of two independent renders against a reference; all arrays (L, N), or (N,) for
    one light.
    """
    a, b, r, v = (np.where(chosen, values, 0.0) for values in (first, second, reference, variance))
    spread = np.atleast_2d((a - b) * (0.5 * (a + b) - r)).sum(axis=0)
    return ErrorSums(float(((a - r) * (b - r)).sum()), float((r * r).sum()), float(v.sum()), float(spread @ spread))


@dataclass(frozen=True)
class FrameSums:
    """Sums (L, L) over pixels that are valid under both lights: the row is the render's light, the column the
    photograph's; the sums of one camera's blocks add.
    """

    product: Array
    """Sum of (C1 - ref)(C2 - ref) less the reference's variance, for two independent renders C1 and C2."""
    signal: Array
    """Sum of ref^2 less the reference's variance."""
    noise: Array
    """Monte Carlo variance of ``product``."""

    def __add__(self, other: FrameSums) -> FrameSums:
        return FrameSums(self.product + other.product, self.signal + other.signal, self.noise + other.noise)

    def is_above(self, error: float) -> NDArray[np.bool_]:
        """Mask (L, L) of the errors that exceed a limit by more than ``SIGNIFICANT_Z`` standard errors of the renders'
        noise.
        """
        return np.asarray(self.product - error**2 * self.signal > SIGNIFICANT_Z * np.sqrt(self.noise))

    def are_apart(self, worse: tuple[int, int], better: tuple[int, int]) -> bool:
        """Whether of two entries (render, photograph) the first is worse by more than the renders' noise."""
        noise = float(np.sqrt(self.noise[worse] + self.noise[better]))
        return bool(self.product[worse] - self.product[better] > SIGNIFICANT_Z * noise)

    @property
    def errors(self) -> Array:
        """Relative error (L, L) of each photograph against each render; infinite where there is no signal."""
        has_signal = self.signal > 0
        square = np.where(has_signal, self.product, 0.0) / np.where(has_signal, self.signal, 1.0)
        return np.where(has_signal, np.sqrt(np.maximum(square, 0.0)), np.inf)


def frame_sums(first: Array, second: Array, reference: Array, variance: Array, valid: NDArray[np.bool_]) -> FrameSums:
    """Frame sums of one block of a camera; all arrays (L, N)."""
    a, b, r, v = (np.where(valid, values, 0.0) for values in (first, second, reference, variance))
    counted = valid.astype(np.float64)
    signal = counted @ (r**2 - v).T
    # The variance of (a - ref)(b - ref) is the mean of (a - b)^2 ((a + b) / 2 - ref)^2, pixel by pixel.
    square, mean = (a - b) ** 2, 0.5 * (a + b)
    noise = (square * mean**2) @ counted.T - 2 * (square * mean) @ r.T + square @ (r**2).T
    return FrameSums((a * b) @ counted.T - (a + b) @ r.T + signal, signal, np.maximum(noise, 0.0))


Shown = tuple[tuple[str, int], ...]
"""Images to return as a whole: camera name and light index."""


@dataclass(frozen=True)
class Evaluation:
    """Errors on fitted and on held-out images, and the requested images."""

    fitted: ErrorSums
    held_out: ErrorSums
    renders: dict[tuple[str, int], tuple[NDArray[np.int32], Array]]
    """Mean of the two renders (N,) and its pixels (N, 2), by camera name and light index."""
    parts: dict[int, tuple[ErrorSums, ErrorSums]] = field(default_factory=dict)
    """For a jaw, sums on fitted and on held-out images by the part that the pixels show (``blocks.PixelParts``)."""
    spreads: dict[tuple[str, int], Array] = field(default_factory=dict)
    """Half the absolute difference (N,) of the two renders, for the images in ``renders``: one standard error of their
    mean, estimated from two values."""
    frames: dict[str, FrameSums] = field(default_factory=dict)
    """By camera, sums of each photograph against the renders under all lights, without the instrument's errors; empty
    where they were not requested."""


def evaluate(
    passes: Passes, label: str, tissue: Tissue | Mouth, samples: int, shown: Shown = (), *, by_frame: bool = False
) -> Evaluation:
    """Evaluate a tissue with two renders of ``samples`` paths per pixel each, from seeds that no other pass uses.

    Args:
        passes: passes over the blocks to evaluate.
        label: names the evaluation in seeds and keys.
        tissue: the tissue parameters.
        samples: paths per pixel of each render.
        shown: images to return.
        by_frame: whether to compare each photograph with the renders under all lights, too.
    """
    seeds = passes.seeds(label, "evaluate-1"), passes.seeds(label, "evaluate-2")
    found: list[BlockErrors] = passes.run(
        f"{passes.seeds.channel}-{label}-evaluate", tissue, samples, evaluate_task, seeds, shown, by_frame
    )
    passes.record([block.trace for block in found])
    fitted, held_out = ErrorSums(), ErrorSums()
    parts: dict[int, tuple[ErrorSums, ErrorSums]] = {}
    pieces: dict[tuple[str, int], list[tuple[NDArray[np.int32], Array]]] = {}
    spreads: dict[tuple[str, int], list[Array]] = {}
    frames: dict[str, FrameSums] = {}
    for block in found:
        fitted, held_out = fitted + block.fitted, held_out + block.held_out
        for part, (own_fitted, own_held_out) in block.parts.items():
            known_fitted, known_held_out = parts.get(part, (ErrorSums(), ErrorSums()))
            parts[part] = known_fitted + own_fitted, known_held_out + own_held_out
        if block.frames is not None:
            known = frames.get(block.camera)
            frames[block.camera] = block.frames if known is None else known + block.frames
        for image, values in block.renders.items():
            pieces.setdefault(image, []).append((block.pixels, values))
            spreads.setdefault(image, []).append(block.spreads[image])
    renders = {
        image: (np.concatenate([p for p, _ in some]), np.concatenate([v for _, v in some]))
        for image, some in pieces.items()
    }
    return Evaluation(
        fitted, held_out, renders, parts, {image: np.concatenate(some) for image, some in spreads.items()}, frames
    )


@dataclass(frozen=True)
class BlockErrors:
    """Errors, images and frame sums of one block."""

    fitted: ErrorSums
    held_out: ErrorSums
    pixels: NDArray[np.int32]
    renders: dict[tuple[str, int], Array]
    spreads: dict[tuple[str, int], Array]
    parts: dict[int, tuple[ErrorSums, ErrorSums]]
    trace: TraceRow
    camera: str
    frames: FrameSums | None = None


def evaluate_task(
    host: EngineHost, task: BlockTask, seeds: tuple[int, int], shown: Shown, by_frame: bool = False
) -> BlockErrors:
    """Evaluate one block, with the instrument's errors applied to the renders."""
    start, block = time.time(), block_of(task)
    used = np.any((block.fit_weight > 0) | block.held_out, axis=1)
    used[[light for name, light in shown if name == block.view.camera.name]] = True
    stacks = [
        host.call(
            "images", task.recipe, task.tissue, block.view_under(used), samples=task.samples, seed=seed, batches=1
        )
        for seed in seeds
    ]
    first, second = (photographed(stack.mean, block, dict(task.errors)) for stack in stacks)

    def sums(pixels: NDArray[np.bool_]) -> tuple[ErrorSums, ErrorSums]:
        fitted, held_out = (
            error_sums(first, second, block.reference, block.variance, chosen & pixels)
            for chosen in (block.fit_weight > 0, block.held_out)
        )
        return fitted, held_out

    fitted, held_out = sums(np.ones(len(block.view), dtype=bool))
    parts = (
        {}
        if block.parts is None
        else {int(part): sums(block.parts.shown == part) for part in np.unique(block.parts.shown)}
    )
    camera = block.view.camera.name
    own_images = [(name, light) for name, light in shown if name == camera]
    renders = {(name, light): 0.5 * (first[light] + second[light]) for name, light in own_images}
    spreads = {(name, light): 0.5 * np.abs(first[light] - second[light]) for name, light in own_images}
    valid = (block.fit_weight > 0) | block.held_out
    # Use the media's renders without the instrument's errors: gains that adapted to a wrong frame would hide it.
    frames = frame_sums(stacks[0].mean, stacks[1].mean, block.reference, block.variance, valid) if by_frame else None
    trace = trace_row("evaluate", task, start)
    return BlockErrors(fitted, held_out, block.view.pixels, renders, spreads, parts, trace, camera, frames)
