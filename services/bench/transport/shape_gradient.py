"""Derivative with respect to the dentin's shape, compared with central differences by the engine itself.

The derivative is that of the images projected on one picture, sum w C, where w is the residual of an L2 loss for dentin
of another shape. This engine's method is one ``shape_gradient`` for all modes, with photons and camera walks. One
Jacobian pass for all modes (with both border terms) has a row of its own. The peer is two image passes per mode with
common random numbers; the time to move the surfaces does not count.

Central differences have a bias that grows as the square of their step h. It is measured in the same run by a fit of
D(h) = D(0) + k h^2 to all steps. For a wanted error e a step h needs variance(h) / (e^2 - bias(h)^2) samples, and the
peer uses its best step. This engine's method has a bias too, of its series and its texels: its difference from the
peer's D(0). A bias counts, for either method, only where it is significant against the noise. A part of this engine's
variance falls as 1 / paths squared (photons times walks), so its number of paths is chosen to come near the wanted
error.
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from services.anatomy.blend import dentin_blend_shape
from services.bench.transport.gradient_rows import Estimate, GradientRow, of_parts
from services.bench.transport.incisor_stack import TISSUE, incisor_stack
from services.transport.engine import Engine
from services.transport.optics.parameters import Medium, Tissue
from services.transport.scene.recipe import View

Array = NDArray[np.float64]

TISSUES = {"white": TISSUE, "dark": Tissue(Medium(2.0, 0.95, 0.93, 0.82, -0.1), Medium(4.0, 0.85, 1.0, 0.75))}
SHAPE, OTHER_SHAPE = (0.5, 0.5, 0.5), (0.8, 0.8, 0.8)
STEPS = (0.05, 0.1, 0.2, 0.4)
RESOLVED = 3.0
"""Number of standard errors beyond which a bias is significant."""
WANTED_ERROR = 0.05
"""Relative error of the derivative at which the two methods are compared."""


def shape_rows(*, quick: bool) -> list[GradientRow]:
    """Return for each tissue and mode this engine's rows, the peer's row at every step, and its summary at the best
    step.
    """
    stack = incisor_stack(18 if quick else 54)
    engine = Engine(stack.recipe(dentin_blend_shape(stack.outer)))
    samples, repeats = (32, 3) if quick else (64, 16)
    walks, gradients = (512, 4) if quick else (4096, 6)
    rows: list[GradientRow] = []
    for name, media in TISSUES.items():
        tissue = replace(media, shape=SHAPE)
        view = stack.tooth_view(engine, tissue)
        other = engine.images(replace(media, shape=OTHER_SHAPE), view, samples=2 * samples, seed=7).mean
        picture = engine.images(tissue, view, samples=2 * samples, seed=7).mean - other
        ours = _gradients(engine, tissue, view, picture, walks, gradients)
        scores = _scores(engine, tissue, view, picture, samples, min(repeats, 4))
        for mode in range(1 if quick else len(SHAPE)):
            differences = {h: _differences(engine, tissue, view, mode, h, picture, samples, repeats) for h in STEPS}
            rows += _compare(name, mode, (walks, samples), ours[mode], scores[mode], differences)
    return rows


def _gradients(
    engine: Engine, tissue: Tissue, view: View, picture: Array, samples: int, repeats: int
) -> list[Estimate]:
    """Return the derivative with respect to every mode by ``shape_gradient``, from light and importance on the border;
    the time is divided equally among the modes.
    """
    engine.shape_gradient(tissue, view, picture, samples=16, seed=0)
    begun = time.process_time()
    found = np.stack(
        [
            engine.shape_gradient(tissue, view, picture, samples=samples, seed=100 + repeat).gradient
            for repeat in range(repeats)
        ]
    )
    seconds = (time.process_time() - begun) / repeats / found.shape[1]
    return [of_parts(found[:, [mode], None], seconds) for mode in range(found.shape[1])]


def _scores(engine: Engine, tissue: Tissue, view: View, picture: Array, samples: int, repeats: int) -> list[Estimate]:
    """Return the derivative with respect to every mode by one Jacobian pass for all; the time is divided equally among
    the modes.
    """
    names = tuple(f"shape.{k}" for k in range(len(tissue.shape)))
    engine.jacobian(tissue, view, names, samples=samples, seed=0)
    begun = time.process_time()
    slopes = np.stack(
        [engine.jacobian(tissue, view, names, samples=samples, seed=100 + repeat).jacobian for repeat in range(repeats)]
    )
    seconds = (time.process_time() - begun) / repeats / len(names)
    by_pixel = (slopes * picture).sum(axis=2)
    return [of_parts(by_pixel[:, [mode]], seconds) for mode in range(len(names))]


def _differences(
    engine: Engine, tissue: Tissue, view: View, mode: int, step: float, picture: Array, samples: int, repeats: int
) -> Estimate:
    # The two sides of a difference have common random numbers; different steps have different ones.
    seconds, sides, first_seed = 0.0, [], 1000 + round(1000 * step)
    for sign in (1, -1):
        moved = tissue.with_values({f"shape.{mode}": tissue.shape[mode] + sign * step})
        engine.images(moved, view, samples=16, seed=0)
        begun = time.process_time()
        sides.append(
            np.stack(
                [
                    engine.images(moved, view, samples=samples, seed=first_seed + repeat).mean
                    for repeat in range(repeats)
                ]
            )
        )
        seconds += (time.process_time() - begun) / repeats
    return of_parts(((sides[0] - sides[1]) * picture).sum(axis=1)[:, None] / (2 * step), seconds)


def _compare(
    tissue: str,
    mode: int,
    samples: tuple[int, int],
    ours: Estimate,
    scores: Estimate,
    differences: dict[float, Estimate],
) -> list[GradientRow]:
    # Fit the peer's derivative D(0) and the curvature k of its bias to its differences, by weighted least squares.
    steps = np.array([*differences])
    values = np.array([d.mean[0] for d in differences.values()])
    spread = np.sqrt([d.mean_variance[0] for d in differences.values()])
    design = np.stack([np.ones_like(steps), steps**2], axis=1) / spread[:, None]
    covariance = np.linalg.inv(design.T @ design)
    theirs, curvature = covariance @ design.T @ (values / spread)
    noise_squared = covariance[0, 0] + ours.mean_variance[0]
    curvature_squared = _resolved(curvature, covariance[1, 1])
    our_bias_squared = _resolved(theirs - ours.mean[0], noise_squared)

    derivative = np.average([theirs, ours.mean[0]], weights=[1 / covariance[0, 0], 1 / ours.mean_variance[0]])
    target_variance = (WANTED_ERROR * derivative) ** 2
    costs = {
        h: d.seconds * d.variance[0] / max(target_variance - curvature_squared * h**4, 1e-300)
        for h, d in differences.items()
    }
    best = min(costs, key=lambda h: costs[h])
    our_cost = ours.seconds * ours.variance[0] / max(target_variance - our_bias_squared, 1e-300)
    z = float((theirs - ours.mean[0]) / np.sqrt(noise_squared))

    def row(peer: str, estimate: Estimate, paths: int) -> GradientRow:
        error = float(np.sqrt(estimate.variance[0]) / abs(derivative))
        return GradientRow(
            benchmark=f"transport-gradient {tissue}", peer=peer, seconds=estimate.seconds, error=error,
            parameter=f"shape.{mode}", samples=paths, gradient=float(estimate.mean[0]),
        )  # fmt: skip

    walks, paths = samples
    rows = [row("dentine", ours, walks), row("dentine jacobian", scores, paths)]
    rows += [row(f"central differences, step {h:g}", d, paths) for h, d in differences.items()]
    summary = row(f"central differences, step {best:g}", differences[best], paths)
    ratio = float(costs[best] / our_cost)
    return [
        *rows,
        summary.model_copy(
            update={"benchmark": f"transport-gradient {tissue}-summary", "efficiency_ratio": ratio, "z": z}
        ),
    ]


def _resolved(bias: float, variance: float) -> float:
    """Return the square of a bias minus its variance; 0 where the bias is not significant."""
    return float(bias**2 - variance) if bias**2 > RESOLVED**2 * variance else 0.0
