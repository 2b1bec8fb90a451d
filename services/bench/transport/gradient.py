"""Benchmark of the gradients of an L2 loss over the images of an incisor under all lights of a dome, against the best
available alternatives to this engine.

The loss for the media is 1/2 sum (C - reference)^2, differentiated with respect to sigma, alpha, g and the weight of
the lobes of enamel and dentin. This engine's gradient is J'(C - reference) from a few Jacobian passes: the derivatives
of each pass are combined with the images of the others, so that the two have independent seeds. The peer is stock
``prbvolpath``, an image and a backward pass for each of a few lights, scaled to all lights. For shape and stains see
``shape_gradient`` and ``stain_gradient``.

The product of the images' noise and the derivatives' noise falls as 1 / paths squared and dominates short runs of both,
so they are compared at nearly equal error: the peer at its largest number of paths, this engine at the number whose
error is nearest.

Efficiency is 1 / (variance x time). Time is processor time of all threads, after all compilation: it is the same
measure for both on equal numbers of threads, and other jobs on the machine change it less than time by the clock.
Variances come from independent repeats. Pixels (of this engine) and lights (of the peer) have independent random
numbers, so a gradient's variance is the sum of theirs.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.bench.transport.gradient_rows import Estimate, GradientRow, of_parts
from services.bench.transport.incisor_stack import TISSUE, IncisorStack, incisor_stack
from services.bench.transport.shape_gradient import shape_rows
from services.bench.transport.stain_gradient import stain_rows
from services.bench.transport.stock_gradient import StockGradient, shared_names
from services.transport.engine import Engine
from services.transport.optics.parameters import Medium, Tissue
from services.transport.scene.recipe import View

Array = NDArray[np.float64]

OTHER_TISSUE = Tissue(Medium(3.8, 0.996, 0.9, 0.8, -0.1), Medium(13.5, 0.9925, 1.0, 0.72))
"""Media of the reference images: about 10 % from those of ``TISSUE``."""

PASSES = 4
"""Number of Jacobian passes of one gradient of this engine: of the pairs of passes, one in four pairs a pass with
itself, so that it would not be independent, and is left out."""


def run(*, quick: bool) -> list[dict[str, Any]]:
    """Return the rows by parameter of this engine and of the peers, and the peers' summary rows."""
    return [row.model_dump() for row in [*media_rows(quick=quick), *shape_rows(quick=quick), *stain_rows(quick=quick)]]


def media_rows(*, quick: bool) -> list[GradientRow]:
    """Compare the gradient with respect to the media with that of ``prbvolpath``.

    Returns:
        Rows of both at increasing numbers of paths, and the peer's summary rows by parameter and over all parameters.
    """
    stack = incisor_stack(18 if quick else 54)
    engine, names = Engine(stack.recipe()), shared_names(TISSUE)
    view = stack.tooth_view(engine, TISSUE)
    chosen = stack.some_lights(2 if quick else 6)
    reference = engine.images(OTHER_TISSUE, view, samples=256 if quick else 1024, seed=7).mean

    counts, peer_counts, repeats = ((32, 128), (16, 64), 3) if quick else ((64, 128, 256), (16, 64), 4)
    pairs = [
        our_gradient(engine, TISSUE, view, reference, names, chosen, samples=samples, repeats=repeats)
        for samples in counts
    ]
    ours = pairs[-1][0]
    rows = [
        row
        for samples, (whole, _) in zip(counts, pairs, strict=True)
        for row in _rows("dentine", names, samples, whole, ours.mean)
    ]
    scale = len(reference) / len(chosen)
    with tempfile.TemporaryDirectory() as folder:
        for samples in peer_counts:
            peer = _stock_gradient(Path(folder), stack, view, reference, chosen, samples=samples, repeats=repeats)
            scaled = Estimate(
                peer.mean * scale, peer.variance * scale, peer.mean_variance * scale, peer.seconds * scale
            )
            rows += _rows("mitsuba-prbvolpath", names, samples, scaled, ours.mean)
    return rows + _summary(names, pairs, peer, scaled)


def our_gradient(
    engine: Engine,
    tissue: Tissue,
    view: View,
    reference: Array,
    names: tuple[str, ...],
    chosen: NDArray[np.int64],
    *,
    samples: int,
    repeats: int,
) -> tuple[Estimate, Estimate]:
    """Return this engine's gradient over all lights, and over the chosen lights alone, with the time of all lights.

    Args:
        engine: engine of the scene.
        tissue: media at which the gradient is taken.
        view: pixels of the images.
        reference: reference images (L, N).
        names: names of the F parameters.
        chosen: indices of the chosen lights.
        samples: paths per pixel of all passes together, a multiple of ``PASSES``.
        repeats: number of independent repeats.
    """

    def once(repeat: int) -> Array:
        passes = [
            engine.jacobian(tissue, view, names, samples=samples // PASSES, seed=repeat * PASSES + k, batches=1)
            for k in range(PASSES)
        ]
        # Take the mean over all pairs of two different passes: the product of the sums minus each pass's product with
        # itself.
        residuals = [one.mean - reference for one in passes]
        alone = sum(one.jacobian * residual for one, residual in zip(passes, residuals, strict=True))
        together = sum(one.jacobian for one in passes) * sum(residuals)
        return np.asarray((together - alone) / (PASSES * (PASSES - 1)))

    once(0)
    begun = time.process_time()
    terms = np.stack([once(repeat) for repeat in range(1, repeats + 1)])
    seconds = (time.process_time() - begun) / repeats
    return of_parts(terms.sum(axis=2), seconds), of_parts(terms[:, :, chosen].sum(axis=2), seconds)


def _stock_gradient(
    folder: Path,
    stack: IncisorStack,
    view: View,
    reference: Array,
    chosen: NDArray[np.int64],
    *,
    samples: int,
    repeats: int,
) -> Estimate:
    seconds, by_light = 0.0, []
    for light in chosen.tolist():
        gradient = StockGradient(stack.stock_scene(folder, TISSUE, light), TISSUE, view)
        gradient(reference[light], samples=samples, seed=0)
        begun = time.process_time()
        by_light.append(
            [
                gradient(reference[light], samples=samples, seed=1 + light * repeats + repeat)
                for repeat in range(repeats)
            ]
        )
        seconds += (time.process_time() - begun) / repeats
    return of_parts(np.array(by_light).transpose(1, 2, 0), seconds)


def _rows(peer: str, names: tuple[str, ...], samples: int, estimate: Estimate, gradient: Array) -> list[GradientRow]:
    errors = np.sqrt(estimate.variance) / np.abs(gradient)
    common: dict[str, Any] = {
        "benchmark": "transport-gradient",
        "peer": peer,
        "seconds": estimate.seconds,
        "samples": samples,
    }
    single = [
        GradientRow(**common, error=e, parameter=n, gradient=g)
        for n, e, g in zip(names, errors.tolist(), estimate.mean.tolist(), strict=True)
    ]
    return [*single, GradientRow(**common, error=float(np.exp(np.mean(np.log(errors)))))]


def _summary(
    names: tuple[str, ...], pairs: list[tuple[Estimate, Estimate]], peer: Estimate, scaled: Estimate
) -> list[GradientRow]:
    few, known = pairs[-1][1], pairs[-1][0].mean
    whole = min((ours for ours, _ in pairs), key=lambda ours: abs(np.mean(np.log(scaled.variance / ours.variance))))
    z = (peer.mean - few.mean) / np.sqrt(peer.mean_variance + few.mean_variance)
    # The gradient's own size is common to both and cancels in the ratio.
    ratios = scaled.variance * scaled.seconds / (whole.variance * whole.seconds)
    errors = np.sqrt(scaled.variance) / np.abs(known)
    common: dict[str, Any] = {
        "benchmark": "transport-gradient-summary",
        "peer": "mitsuba-prbvolpath",
        "seconds": scaled.seconds,
    }
    single = [
        GradientRow(**common, error=error, parameter=name, z=score, efficiency_ratio=ratio)
        for name, error, score, ratio in zip(names, errors.tolist(), z.tolist(), ratios.tolist(), strict=True)
    ]
    means: dict[str, Any] = {
        "error": float(np.exp(np.mean(np.log(errors)))),
        "efficiency_ratio": float(np.exp(np.mean(np.log(ratios)))),
        "z": float(np.sqrt(np.mean(z**2))),
    }
    return [*single, GradientRow(**common, **means)]
