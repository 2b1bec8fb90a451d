"""How often a tooth's 95 % intervals contain the truth when the errors of its instrument are drawn; about two
core-minutes a fit.

python -m tests.benchmarks.instrument_coverage --seeds 5 --json instrument_coverage.json

What gain, lights, flares and moves of scan and dome do to the photographs comes from stock Mitsuba (``render_moves``).
How a fit's solution responds to them, and the ± that must contain it, come from the fit's own noisy derivatives: its
final uncertainty estimate is made once more with stock's changes of the images in place of its own. In each draw the
errors are normal with the standard errors that the fit assumes, and the rest of the solution's error is normal with the
covariance that the fit states for photographs, rendering and what else is not the instrument's. The images are linear
in all of these. ``shift_over_se`` is the linear prediction of ``instrument_errors``: how far one standard error of each
error of the instrument moves each quantity, over the quantity's ±.

``bound`` is the Cramér–Rao bound of each quantity: photographs' noise, instrument errors with their priors, moves too
as unknowns that photographs determine (with stock's changes), and the held mean cosines, of which photographs are
taken to know nothing. It has no noise of rendering. What photographs tell of moves is the product of stock's changes in
two halves of the pixels, whose noise is independent.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from services.core.calibration.uncertainty import TWIST
from services.fit.coordinates.domain import Domain
from services.fit.coordinates.instrument_errors import DEFAULT_SE, kind_of_error
from services.fit.measurements.blocks import BlockTask, PixelBlock, read_block
from services.fit.passes import final_uncertainty as closing
from services.fit.passes.final_uncertainty import measure_final_uncertainty
from services.fit.passes.moves import Changes as RenderedChanges
from services.fit.passes.passes import TraceRow
from services.fit.solve import covariance
from services.fit.solve.final_uncertainty import FinalSums, positive_part
from services.fit.solve.recombination import Recombination
from services.fit.solve.sandwich import CombinedSolution, Sandwich, combine_with_prior
from services.fit.stages import channel_fit
from services.transport.platform import prepare_device
from tests.benchmarks.instrument_errors import QUANTITIES, fit, relative_slopes
from tests.benchmarks.render_moves import STORED

Array = NDArray[np.float64]

INTERVAL = 1.959964
INSTRUMENT = ("gain", "light_gain", "flare", "teeth", "dome")
"""Parts of a ± by the instrument's errors."""


@dataclass(frozen=True)
class Changes:
    """Changes of the photographs by one standard error of each error of the instrument, as stock Mitsuba renders
    them.
    """

    stored: dict[str, Array]
    step: int
    """Edge of the fit's squares in pixels of 0.5 mm, 1 or 2."""

    @staticmethod
    def read(step: int) -> Changes:
        """The stored images, for squares of so many pixels."""
        with np.load(STORED) as file:
            return Changes({name: np.asarray(file[name], dtype=np.float64) for name in file if name[0] == "c"}, step)

    @property
    def moves(self) -> list[str]:
        """Names of the dome's six moves, which the fit does not estimate."""
        return [name.removeprefix("c0_") for name in self.stored if name.startswith("c0_dome")]

    def of_block(self, block: PixelBlock, errors: Sequence[str]) -> NDArray[np.float32]:
        """Changes (K, 2, L, N) of a block's images, twice the same: by the errors named, then by the moves."""
        names = block.instrument
        assert names is not None
        image = self._squares(block, "none").mean(axis=(0, 1))
        by_name = {names.gain: image, names.flare: np.full_like(image, names.brightest)}
        for k, light in enumerate(names.lights):
            by_name[light] = np.where(np.arange(len(image))[:, None] == k, image, 0.0)
        by_se = {name: DEFAULT_SE[kind_of_error(name)] * change for name, change in by_name.items()}
        by_se |= {f"teeth.{axis}": self._squares(block, f"teeth.{k}").mean(axis=(0, 1)) for k, axis in enumerate(TWIST)}
        changes = [by_se.get(name, np.zeros_like(image)) for name in errors]
        moved = [self._squares(block, name).mean(axis=(0, 1)) for name in self.moves]
        return np.repeat(np.array([*changes, *moved])[:, None], 2, axis=1).astype(np.float32)

    def information(self, block: PixelBlock) -> Array:
        """What a block's photographs tell of the moves, (6, 6): products of the changes of the pixels on one diagonal
        of each square with those on the other. NaN for squares of one pixel, which has no halves.
        """
        if self.step == 1:
            return np.full((len(self.moves), len(self.moves)), np.nan)
        squares = [self._squares(block, name) for name in self.moves]
        one, other = (
            np.array([0.5 * (each[0, k] + each[1, 1 - k]) for each in squares]).reshape(len(squares), -1)
            for k in (0, 1)
        )
        product = (one * block.fit_weight.reshape(-1)) @ other.T
        return np.asarray(0.5 * (product + product.T))

    def _squares(self, block: PixelBlock, name: str) -> Array:
        # Stored images at the pixels of each of the block's pixels, (rows, columns, L, N).
        camera, pixels = block.fitted_view.camera, block.fitted_view.pixels
        width, height = camera.size
        step = self.step
        image = self.stored[f"{camera.name}_{name}"][:, : height * step, : width * step]
        squares = image.reshape(len(image), height, step, width, step).transpose(2, 4, 0, 1, 3)
        return np.asarray(squares[..., pixels[:, 1], pixels[:, 0]])


@dataclass
class Recorder:
    """Stands between a fit and its final uncertainty estimate, and keeps what the draws need of the last one."""

    changes: Changes
    shifts: Array = field(default_factory=lambda: np.zeros((0, 0)))
    """Effect (K, F) of each change on the whitened gradient."""
    information: Array = field(default_factory=lambda: np.zeros((0, 0)))
    """What photographs know of the moves, (6, 6), by stock's changes."""
    effect: Array = field(default_factory=lambda: np.zeros((0, 0)))
    """Change (F, K) of the solution by each change."""
    names: tuple[str, ...] = ()
    """Names (K,) of the instrument's errors that cause the changes."""
    solution: CombinedSolution | None = None
    slopes: Array = field(default_factory=lambda: np.zeros((0, 0)))
    """Relative derivatives (Q, F) of the reported quantities."""

    def measure(
        self, problem: Any, x: Array, whiten: Array, held: Any, samples: int, moves: Any, *more: Any
    ) -> FinalSums:
        """The final uncertainty estimate with the fit's own changes, which is returned, and with stock's, which is
        kept."""
        errors = problem.domain.errors.names
        self.names = (*errors, *self.changes.moves)
        self.information = np.zeros((len(moves), len(moves)))

        def by_stock(_: Any, tasks: Sequence[BlockTask], *__: Any) -> list[list[Any]]:
            found = []
            for block in (read_block(task.block) for task in tasks):
                trace = TraceRow("moves", "by-stock", 0, "", 0.0, 0.0)
                found.append([RenderedChanges(self.changes.of_block(block, errors), trace)])
                self.information += self.changes.information(block)
            return found

        with patch.object(closing, closing._changes_by_scene.__name__, by_stock):
            stock: FinalSums = measure_final_uncertainty(problem, x, whiten, held, samples, moves, *more)
        self.shifts = stock.shifts[len(held) :]
        self.slopes = relative_slopes(problem.domain, problem.base, x)
        return measure_final_uncertainty(problem, x, whiten, held, samples, moves, *more)

    def combine(
        self, domain: Domain, x: Array, sandwich: Sandwich, meats: Any, unfinished: Array, parts: int = 1
    ) -> Any:
        """The last use of the prior, through which the changes go as well."""
        found = combine_with_prior(domain, x, sandwich, meats, unfinished, parts)
        whole = sandwich.product(sandwich.inverse, sandwich.meat + sandwich.weighing) + unfinished
        before = Recombination(whole, found.sandwich.response(sandwich.inverse), found.sandwich.prior)
        through = np.eye(len(x))
        through[:, domain.tissue_count :] += before.change(found.sandwich.rejected)
        self.effect = through @ sandwich.transform @ sandwich.inverse @ self.shifts.T
        self.solution = found
        return found

    def bound(self) -> Array:
        """Cramér–Rao covariance (Q, Q) of the reported quantities without the noise of rendering."""
        assert self.solution is not None
        if np.isnan(self.information).any():
            return np.full((len(QUANTITIES), len(QUANTITIES)), np.nan)
        known = self.shifts[-len(self.information) :].T
        told = positive_part(self.information)
        whole = np.block([[np.eye(len(known)), known], [known.T, np.eye(len(told)) + told]])
        own = self.slopes @ self.solution.sandwich.transform
        held = self.slopes @ self.solution.parts.get("mean_cosine", np.zeros_like(known @ known.T)) @ self.slopes.T
        return np.asarray(own @ np.linalg.inv(whole)[: len(known), : len(known)] @ own.T + held)


def covered(seed: int, draws: int, changes: Changes) -> dict[str, Any]:
    """One fit, and the shares of the draws that its 95 % intervals contain."""
    recorder = Recorder(changes)
    with (
        tempfile.TemporaryDirectory() as folder,
        patch.object(channel_fit, measure_final_uncertainty.__name__, recorder.measure),
        patch.object(covariance, "combine_with_prior", recorder.combine),
    ):
        found = fit(Path(folder), "none", seed, instrument="on", pixel_step=changes.step)
    assert recorder.solution is not None
    slopes, rng = recorder.slopes, np.random.default_rng([29, seed])
    parts = {name: slopes @ part @ slopes.T for name, part in recorder.solution.parts.items()}
    whole = slopes @ recorder.solution.covariance @ slopes.T
    own = sum(parts[name] for name in INSTRUMENT if name in parts)
    shifts = slopes @ recorder.effect / np.sqrt(np.diag(whole))[:, None]
    instrument = rng.standard_normal((draws, len(recorder.shifts))) @ (slopes @ recorder.effect).T
    rest = rng.standard_normal((draws, len(QUANTITIES))) @ _root(whole - own).T
    return {
        "seed": seed,
        "converged": found["converged"],
        "se": np.sqrt(np.diag(whole)).tolist(),
        "bound": np.sqrt(np.diag(recorder.bound())).tolist(),
        "se_by_instrument": np.sqrt(np.diag(np.asarray(own))).tolist(),
        "by_stock": np.sqrt(((slopes @ recorder.effect) ** 2).sum(axis=1)).tolist(),
        "shift_over_se": dict(zip(recorder.names, shifts.T.round(3).tolist(), strict=True)),
        "covered": _shares(instrument + rest, whole),
        "covered_by_instrument_alone": _shares(instrument, np.asarray(own)),
        "seconds": found["seconds"],
    }


def _root(square: Array) -> Array:
    values, vectors = np.linalg.eigh(square)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def _shares(errors: Array, square: Array) -> list[float]:
    return [float(share) for share in (np.abs(errors) <= INTERVAL * np.sqrt(np.diag(square))).mean(axis=0)]


def summary(rows: Sequence[dict[str, Any]]) -> str:
    """Mean shares over all fits, by quantity and together, and the median ± over the bound."""
    lines = []
    for key in ("covered", "covered_by_instrument_alone"):
        shares = 100 * np.mean([row[key] for row in rows], axis=0)
        told = ", ".join(f"{name} {share:.1f} %" for name, share in zip(QUANTITIES, shares, strict=True))
        lines.append(f"{key}: {shares.mean():.1f} % ({told})")
    sharpness = np.median([np.array(row["se"]) / row["bound"] for row in rows], axis=0)
    told = ", ".join(f"{name} {ratio:.2f}" for name, ratio in zip(QUANTITIES, sharpness, strict=True))
    lines.append(f"± over bound, median: {told}")
    return "\n".join(lines)


def main() -> None:
    """Run the fits and their draws, and write the file after each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5, help="fits, by seeds of the sensor's noise from 1")
    parser.add_argument("--draws", type=int, default=500, help="of each fit")
    parser.add_argument("--pixel-step", type=int, choices=(1, 2), default=2, help="squares of 0.5 or 1 mm")
    parser.add_argument("--json", type=Path, required=True, help="where results go; fits in it are not run again")
    arguments = parser.parse_args()
    prepare_device(1)
    rows: list[dict[str, Any]] = json.loads(arguments.json.read_text()) if arguments.json.exists() else []
    changes = Changes.read(arguments.pixel_step)
    for seed in range(1 + len(rows), 1 + arguments.seeds):
        rows.append(covered(seed, arguments.draws, changes))
        print(json.dumps(rows[-1]), flush=True)
        arguments.json.write_text(json.dumps(rows, indent=1) + "\n")
    print(summary(rows))


if __name__ == "__main__":
    main()
