"""Table of the accuracy that a fit of a single tooth must reach, on captures rendered by stock Mitsuba with sensor
noise, as JSON.

python -m tests.benchmarks.fit_table --cases homogeneous,known --json fit_table.json
python -m tests.benchmarks.fit_table --cases starts --subjects canine --options '{"max_samples_per_pixel": 256}' \\
    --json starts.json

Figures of reduced scattering and 1 - alpha' are relative errors of the report's values. Image errors have sensor noise
and the truth's Monte Carlo noise subtracted, and are never below the resolution that the photographs' noise allows.
Fits run in this process, on one thread; ``seconds`` is its processor time.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from services.assets.fitted_job import fitted_teeth
from services.bench.fits.tooth_capture import PreparedTooth, prepared_tooth, tissue_of
from services.core.records import JobSpec
from services.core.results import FitReport
from services.core.stage import LocalContext
from services.core.store import open_stage
from services.fit.stage import run
from services.fit.stages.tooth.schedule import ChannelSchedule
from services.transport.optics.parameters import Tissue
from services.transport.platform import prepare_device
from services.transport.thickness import thickness_image
from tests.support.truths import SIDE_LIGHTS, Truth, read, write_capture

LAYERED = ("central-incisor", "canine", "premolar")
HOMOGENEOUS = "homogeneous"
JUDGE_SAMPLES = 512
STARTS = 10
START_SPREAD = {"sigma": 0.7, "alpha": 0.4}
"""Half width of a start's uniform random perturbation, by parameter: of ln sigma, and of log10(1 - alpha)."""


@dataclass(frozen=True)
class Figure:
    """One figure with its limits; a limit is reached when the figure is not above it."""

    case: str
    subject: str
    figure: str
    value: float
    must: float
    goal: float | None
    seconds: float
    note: str = ""

    @property
    def reached(self) -> str:
        """The strictest limit reached: ``goal``, ``must`` or ``missed``."""
        if self.goal is not None and self.value <= self.goal:
            return "goal"
        return "must" if self.value <= self.must else "missed"


@dataclass(frozen=True)
class Fit:
    """A finished fit of a truth."""

    truth: Truth
    prepared: PreparedTooth
    report: FitReport
    history: list[dict[str, Any]]
    seconds: float

    @property
    def tissue(self) -> Tissue:
        """Parameters that the report states."""
        return tissue_of({name: estimate.value for name, estimate in self.report.parameters["green"].items()})

    def off(self, part: str, quantity: str) -> float:
        """Relative error of ``sigma_s_reduced``, or of ``1 - alpha_reduced``, of a medium."""
        true, found = self.truth.medium(part), getattr(self.tissue, part)
        if quantity == "sigma_s_reduced":
            return abs(float(found.sigma_s_reduced) / true["sigma_s_reduced"] - 1)
        return abs((1 - float(found.alpha_reduced)) / (1 - true["alpha_reduced"]) - 1)

    def image_errors(self) -> tuple[float, float]:
        """Relative errors of fitted and of held-out images, at least the resolution that noise allows."""
        sums = self.prepared.errors(self.tissue, samples=JUDGE_SAMPLES, seed=23)
        fitted, held_out = (
            max(one.resolved_error or 0.0, self.prepared.resolution(held))
            for one, held in zip(sums, (False, True), strict=True)
        )
        return fitted, held_out

    def note(self) -> str:
        """Number of steps, and whether the fit converged."""
        return f"{self.report.steps} steps, {'converged' if self.report.converged else 'not converged'}"


@dataclass(frozen=True)
class Bench:
    """The folder of the fits, and options for all of them."""

    folder: Path
    options: dict[str, Any]

    def fit(self, subject: str, label: str, *, seed: int = 1, tested_camera: str | None = None, **options: Any) -> Fit:
        """Fit a stored truth with sensor noise."""
        folder = self.folder / f"{subject}-{label}"
        truth = write_capture(subject, folder / "capture", seed=1, tested_camera=tested_camera)
        held_out = {} if tested_camera is not None else {"held_out_lights": SIDE_LIGHTS}
        chosen = (
            {"capture": folder / "capture", "boundary": "matched", "dentin": "known", "seed": seed}
            | held_out
            | self.options
            | options
        )
        spec = JobSpec.model_validate(chosen)
        began = time.process_time()
        prepared = prepared_tooth(folder / "job", spec)
        run(spec, LocalContext(folder / "job"))
        stage, report = open_stage(folder / "job", "fit", FitReport)
        return Fit(
            truth, prepared, report, json.loads((stage / "history.json").read_text()), time.process_time() - began
        )


Row = Callable[[Bench, Sequence[str]], Iterator[Figure]]


def homogeneous(bench: Bench, _: Sequence[str]) -> Iterator[Figure]:
    """Fit a tooth without dentin, with five lights and three views."""
    fit = bench.fit(HOMOGENEOUS, "none", dentin="none")
    row = partial(Figure, "homogeneous", HOMOGENEOUS, seconds=fit.seconds, note=fit.note())
    fitted, held_out = fit.image_errors()
    yield row("sigma_s'", fit.off("enamel", "sigma_s_reduced"), must=0.10, goal=0.03)
    yield row("1 - alpha'", fit.off("enamel", "alpha_reduced"), must=0.05, goal=0.02)
    yield row("image, fitted", fitted, must=0.03, goal=0.015)
    yield row("image, held out", held_out, must=0.05, goal=0.02)


def known(bench: Bench, subjects: Sequence[str]) -> Iterator[Figure]:
    """Fit teeth whose dentin surface is given. Enamel's thickness d is then known, so the relative error of sigma' d is
    that of its reduced scattering.
    """
    for subject in subjects:
        fit = bench.fit(subject, "known")
        row = partial(Figure, "known", subject, seconds=fit.seconds, note=fit.note())
        yield row("image, held-out side lights", fit.image_errors()[1], must=0.05, goal=0.02)
        yield row("sigma_e' d", fit.off("enamel", "sigma_s_reduced"), must=0.15, goal=0.05)
        yield row("dentin 1 - alpha'", fit.off("dentin", "alpha_reduced"), must=0.10, goal=0.04)


def free(bench: Bench, subjects: Sequence[str]) -> Iterator[Figure]:
    """Fit the dentin's shape with known scattering of enamel."""
    for subject in subjects:
        fit = bench.fit(subject, "free", dentin="fit", held=known_enamel(subject))
        value = float(np.abs(thickness_mm(fit) - true_thickness_mm(fit)).mean())
        note = f"{fit.note()}; c = {', '.join(f'{c:.2f}' for c in fit.report.shape)}"
        yield Figure("free", subject, "thickness, incisal half, mm", value, 0.15, 0.08, fit.seconds, note)


def stages(bench: Bench, subjects: Sequence[str]) -> Iterator[Figure]:
    """Compare the loss of a fit with dentin to that of a homogeneous tooth, each from a fit of its own.

    The photographs' noise is part of every loss, and no fit goes below it; the note says how much it is. These truths
    have no stains; ``tests/pipeline/test_fit_stained_truth.py`` compares losses on a stained truth.
    """
    for subject in subjects:
        losses = []
        for dentin in ("none", "fit"):
            fit = bench.fit(subject, dentin, dentin=dentin)
            sums = fit.prepared.errors(fit.tissue, samples=JUDGE_SAMPLES, seed=23)[0]
            losses.append(sums.loss or 0.0)
        before, after = losses
        note = f"{before:.2e} to {after:.2e}, of which noise {sums.reference_variance / sums.reference_squared:.2e}"
        yield Figure(
            "stages", subject, "loss with dentin over the loss before", after / before, 0.8, None, fit.seconds, note
        )


def cameras(bench: Bench, subjects: Sequence[str]) -> Iterator[Figure]:
    """Fit two cameras under all lights, and compare the error of the third one to theirs."""
    for subject in subjects:
        fit = bench.fit(subject, "cameras", tested_camera="c1")
        fitted, tested = fit.image_errors()
        note = f"{100 * fitted:.2f} % and {100 * tested:.2f} %; {fit.note()}"
        yield Figure(
            "cameras", subject, "error, third camera over the fitted two", tested / fitted, 1.5, 1.15, fit.seconds, note
        )


def starts(bench: Bench, subjects: Sequence[str]) -> Iterator[Figure]:
    """Fit with ten seeds, each from a random perturbation of the table's best point. All losses are computed with the
    same seed.
    """
    for subject in subjects:
        losses, seconds = [], 0.0
        for seed in range(1, STARTS + 1):
            with patch.object(ChannelSchedule, "_homogeneous_start", _perturbed(seed)):
                fit = bench.fit(subject, f"start-{seed}", seed=seed)
            losses.append(fit.prepared.errors(fit.tissue, samples=JUDGE_SAMPLES, seed=23)[0].loss or 0.0)
            seconds += fit.seconds
        spread = (max(losses) - min(losses)) / float(np.median(losses))
        yield Figure(
            "starts",
            subject,
            "loss, largest less least over median",
            spread,
            0.10,
            0.03,
            seconds,
            ", ".join(f"{loss:.4e}" for loss in losses),
        )


CASES: dict[str, Row] = {
    "homogeneous": homogeneous,
    "known": known,
    "free": free,
    "stages": stages,
    "cameras": cameras,
    "starts": starts,
}


def thickness_mm(fit: Fit) -> NDArray[np.float64]:
    """Enamel's fitted thickness (N,) at the pixels of the middle camera that see the incisal half of the crown."""
    observations = fit.prepared.observations
    (found,) = fitted_teeth(observations.folder, observations.manifest, fit.prepared.spec, fit.report)
    assert found.dentin is not None
    camera = observations.manifest.cameras[1]
    return np.asarray(thickness_image(found.outer, found.dentin, camera)[_incisal_half(fit)])


def true_thickness_mm(fit: Fit) -> NDArray[np.float64]:
    """Enamel's true thickness (N,) at the same pixels."""
    meshes = fit.truth.meshes
    return np.asarray(
        thickness_image(meshes["outer"], meshes["dentin"], fit.prepared.observations.manifest.cameras[1])[
            _incisal_half(fit)
        ]
    )


def _incisal_half(fit: Fit) -> NDArray[np.bool_]:
    # The crown begins where true enamel is thicker than 0.15 mm, the cover of a root; occlusal is down in the image.
    meshes, camera = fit.truth.meshes, fit.prepared.observations.manifest.cameras[1]
    thickness = thickness_image(meshes["outer"], meshes["dentin"], camera)
    rows = np.flatnonzero((np.nan_to_num(thickness) > 0.15).any(axis=1))
    middle = (rows[0] + rows[-1]) / 2
    return np.asarray(np.isfinite(thickness) & (np.arange(len(thickness)) > middle)[:, None])


def known_enamel(subject: str) -> dict[str, float]:
    """Values to hold: a truth's enamel with a single lobe of the same reduced scattering and absorption, similar to its
    two lobes to the second order. Only absorption is then fitted.
    """
    enamel = read(subject).medium("enamel")
    lobes = ((enamel["beta"], enamel["g1"]), (1 - enamel["beta"], enamel["g2"]))
    first, second = (sum(share * g**n for share, g in lobes) for n in (1, 2))
    g = (1 - second) / (1 - first) - 1
    sigma = enamel["sigma_s_reduced"] / (1 - g) + (1 - enamel["alpha"]) * enamel["sigma"]
    return {"enamel.sigma": sigma, "enamel.g1": g}


def _perturbed(seed: int) -> Callable[[ChannelSchedule], Tissue]:
    original, random = ChannelSchedule._homogeneous_start, np.random.default_rng(seed)
    moves = {leaf: float(random.uniform(-width, width)) for leaf, width in START_SPREAD.items()}

    def start(schedule: ChannelSchedule) -> Tissue:
        tissue = original(schedule)
        sigma, alpha = (
            tissue.enamel.sigma * np.exp(moves["sigma"]),
            1 - (1 - tissue.enamel.alpha) * 10 ** -moves["alpha"],
        )
        return tissue.with_values(
            {
                f"{part}.{leaf}": float(v)
                for part in ("enamel", "dentin")
                for leaf, v in (("sigma", sigma), ("alpha", alpha))
            }
        )

    return start


def main() -> None:
    """Run the rows asked for; print each figure when it is known, and write all of them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", default=",".join(CASES), help="rows, separated by commas")
    parser.add_argument("--subjects", default=",".join(LAYERED), help="stored truths with dentin, separated by commas")
    parser.add_argument("--options", default="{}", help="options of every fit's job, JSON")
    parser.add_argument("--json", type=Path, required=True)
    arguments = parser.parse_args()
    prepare_device(threads=1)
    rows: list[dict[str, Any]] = []
    for name in arguments.cases.split(","):
        with tempfile.TemporaryDirectory() as folder:
            for figure in CASES[name](
                Bench(Path(folder), json.loads(arguments.options)), arguments.subjects.split(",")
            ):
                goal = "" if figure.goal is None else f", goal {figure.goal:g}"
                print(
                    f"{name:12} {figure.subject:16} {figure.figure:40} {figure.value:.4f} (must {figure.must:g}{goal}):"
                    f" {figure.reached}; {figure.note}",
                    flush=True,
                )
                rows.append(asdict(figure) | {"reached": figure.reached})
                arguments.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
