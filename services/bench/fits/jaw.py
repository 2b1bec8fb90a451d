"""Benchmark of a jaw's fit: errors of images and of media against processor time, stage by stage.

The jaw is the procedural one of subject 1 (14 teeth with gums and wall), photographed by stock Mitsuba with sensor
noise: three views, five lights to fit and two held out. The fit runs in this process on one thread, and seconds are its
processor time, including the construction of scenes and the compilation of kernels. After every joint step the error of
the whole mouth is measured, which does not count as time of the fit: with exact media, from two renders of this engine,
without the noise of sensor and renderer. No other renderer gives derivatives of a whole mouth's scene within hours, so
there is no peer.
"""

from __future__ import annotations

import resource
import statistics
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from services.bench import Row
from services.bench.fits.tooth_capture import CHANNEL, PreparedTooth, prepare, write_photograph
from services.core.records import FolderCapture, JobSpec
from services.core.results import FitReport
from services.core.stage import LocalContext, StageEvent
from services.core.store import StageWriter, is_published, read_record
from services.transport.optics.parameters import MEDIUM_FIELDS, Medium, Mouth, Tissue
from services.transport.platform import prepare_device

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SUBJECT, CAMERAS, LIGHTS, HELD_OUT = 1, 3, 7, 2
QUANTITIES = tuple((part, leaf) for part in ("enamel", "dentin") for leaf in ("sigma_s_reduced", "alpha_reduced"))


@dataclass(frozen=True)
class Case:
    """Size of the jaw's capture and effort of its fit."""

    pixel_mm: float
    photograph_samples: int
    error_samples: int
    options: Mapping[str, Any]
    """Options of the job."""


FULL = Case(1.0, 512, 64, {"max_samples_per_pixel": 256})
QUICK = Case(
    3.0, 32, 32, {"samples_per_pixel": 8, "max_samples_per_pixel": 16, "max_steps": 2, "search_candidates": 400}
)


class JawRow(Row):
    """State of a jaw's fit after so many seconds of processor time.

    ``error`` is the relative error on the held-out images.
    """

    error_se: float
    """Standard error of ``error`` by the Monte Carlo noise of its measurement."""
    fitted_error: float
    """Relative error on the fitted images."""
    stage: str
    step: int
    off: dict[str, dict[str, float]]
    """Relative errors of ``enamel.sigma_s_reduced`` and so on, by FDI number; for alpha' the relative error of
    1 - alpha'."""
    peak_memory_mb: float
    """Peak memory of this process so far, including the measurement of errors."""


@dataclass
class ErrorRecorder:
    """Measures the error of a mouth, makes a row of it and passes on all rows so far."""

    case: PreparedTooth
    truth: Mouth
    keep: Callable[[list[dict[str, Any]]], None]
    samples: int
    rows: list[JawRow] = field(default_factory=list)

    def record(self, seconds: float, mouth: Mouth, stage: str, step: int) -> None:
        """Measure the error of a mouth and keep the row."""
        fitted, held_out = self.case.errors(mouth, samples=self.samples, seed=11)
        fdi = [str(tooth.fdi) for tooth in self.case.observations.teeth]
        row = JawRow(
            benchmark="jaw", peer="dentine", seconds=seconds, error=held_out.resolved_error or 0.0,
            error_se=held_out.error_se or 0.0, fitted_error=fitted.resolved_error or 0.0, stage=stage, step=step,
            off={
                one: relative_errors(found, true)
                for one, found, true in zip(fdi, mouth.teeth, self.truth.teeth, strict=True)
            },
            peak_memory_mb=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        )  # fmt: skip
        self.rows.append(row)
        self.keep([one.model_dump() for one in self.rows])


def relative_errors(found: Tissue, true: Tissue) -> dict[str, float]:
    """Return the relative errors of reduced scattering and of 1 - alpha' of both media."""

    def measure(tissue: Tissue, part: str, leaf: str) -> float:
        value = float(getattr(tissue.medium(part), leaf))
        return 1 - value if leaf == "alpha_reduced" else value

    return {f"{part}.{leaf}": measure(found, part, leaf) / measure(true, part, leaf) - 1 for part, leaf in QUANTITIES}


def run(*, quick: bool, keep: Callable[[list[dict[str, Any]]], None] = lambda _: None) -> list[dict[str, Any]]:
    """Return one row per joint step and one for the end of the fit.

    Args:
        quick: take the smaller case.
        keep: called with all rows so far after every new one.
    """
    from services.phantom.jaw import jaw_surfaces, known_mouth

    prepare_device(threads=1)
    case = QUICK if quick else FULL
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_photographs(folder / "capture", case)
        options = {"kind": "jaw", "capture": folder / "capture", "boundary": "matched", "dentin": "known"} | dict(
            case.options
        )
        truth = known_mouth(jaw_surfaces(SUBJECT), CHANNEL, SUBJECT)
        recorder = ErrorRecorder(
            prepared_jaw(folder / "job", JobSpec.model_validate(options)), truth, keep, case.error_samples
        )
        timed_fit(recorder)
    return [row.model_dump() for row in recorder.rows]


def write_photographs(folder: Path, case: Case) -> None:
    """Render the jaw with stock Mitsuba, and add sensor noise."""
    from services.phantom.jaw import write_jaw_phantom

    write_jaw_phantom(
        folder,
        subject=SUBJECT,
        pixel_mm=case.pixel_mm,
        cameras=CAMERAS,
        lights=LIGHTS,
        held_out=HELD_OUT,
        samples=case.photograph_samples,
        renderer="mitsuba",
    )
    random = np.random.default_rng(SUBJECT)
    for image in read_record(folder / "capture.json", FolderCapture).images:
        assert image.variance_file is not None
        write_photograph(folder, folder, (image.file, image.variance_file), random)


def prepared_jaw(job: Path, spec: JobSpec) -> PreparedTooth:
    """Prepare a jaw's capture below ``job`` if it is not prepared, and build its scene; its views are labelled with
    what each pixel shows.
    """
    from services.anatomy.job_dentin import jaw_dentins
    from services.fit.measurements.observations import channel_scene, read_channel, read_observations
    from services.fit.stages.jaw.views import label_views
    from services.transport.engine import Engine

    if not is_published(job, "prepared"):
        prepare(job, spec)
    observations = read_observations(job, spec)
    dentins = jaw_dentins(observations.teeth, observations.manifest.cameras, spec)
    scene = channel_scene(observations, CHANNEL, dentins, spec)
    return PreparedTooth(
        job, spec, observations, label_views(read_channel(observations, CHANNEL, spec), observations), Engine(scene)
    )


def timed_fit(recorder: ErrorRecorder) -> FitReport:
    """Run the product's own fit stage in this process, and measure its error after every joint step and at its end."""
    from services.fit.stage import ENGINE
    from services.fit.stages.attempt import Attempt
    from services.fit.stages.jaw.driver import JawDriver

    paused, step = 0.0, 0

    def listen(event: StageEvent) -> None:
        nonlocal paused, step
        if event.kind == "step" and event.data["tooth"] is None:
            begun, step = time.process_time(), int(event.data["step"])
            recorder.record(
                begun - started - paused, mouth_of(event.data["parameters"], recorder.truth), event.data["stage"], step
            )
            paused += time.process_time() - begun

    context = LocalContext(recorder.case.job, listener=listen)
    started = time.process_time()
    report = JawDriver(Attempt(recorder.case.spec, context, StageWriter(recorder.case.job, "fit", 1), ENGINE)).run(
        time.time()
    )
    recorder.record(time.process_time() - started - paused, reported_mouth(report, recorder.truth), "final", step)
    return report


def mouth_of(values: Mapping[str, float], like: Mouth) -> Mouth:
    """Return the mouth of a fit's parameters; a tooth without dentin is enamel throughout.

    Args:
        values: parameters by name.
        like: a mouth with the same parts.
    """
    one = Medium(1.0, 0.5)
    shapes = [
        tuple(value for name, value in values.items() if name.startswith(f"{k}.shape.")) for k in range(len(like.teeth))
    ]
    mouth = Mouth(
        tuple(Tissue(one, one, shape) for shape in shapes), None if like.gums is None else one, like.reflectance
    )
    known = {
        name: value for name, value in values.items() if name.rpartition(".")[2] in {*MEDIUM_FIELDS, "reflectance"}
    }
    for k in range(len(like.teeth)):
        if f"{k}.dentin.sigma" not in known:
            known |= {f"{k}.dentin.{leaf}": known[f"{k}.enamel.{leaf}"] for leaf in MEDIUM_FIELDS}
    return mouth.with_values(known)


def reported_mouth(report: FitReport, like: Mouth) -> Mouth:
    """Return the mouth of a jaw's report, whose teeth are in the order of the capture."""
    tables = {f"{k}.": tooth.parameters[CHANNEL] for k, tooth in enumerate(report.teeth.values())} | {
        "": report.parameters[CHANNEL]
    }
    return mouth_of(
        {prefix + name: estimate.value for prefix, table in tables.items() for name, estimate in table.items()}, like
    )


def picture(rows: list[dict[str, Any]]) -> Figure:
    """Draw the errors of the images, and the median over teeth of the errors of the media, against processor time; the
    last point of each stage is marked by a ring.
    """
    from services.bench.plots import finish, grid

    figure, (images, media) = grid(2)
    seconds = [row["seconds"] for row in rows]
    for label, name in (("held out", "error"), ("fitted", "fitted_error")):
        images.plot(seconds, [100 * row[name] for row in rows], "o-", markersize=4, label=label)
    ends = [
        row
        for row, after in zip(rows, [*rows[1:], None], strict=True)
        if after is None or after["stage"] != row["stage"]
    ]
    images.plot(
        [row["seconds"] for row in ends],
        [100 * row["error"] for row in ends],
        "ko",
        fillstyle="none",
        markersize=9,
        linestyle="none",
    )
    for row in ends:
        images.annotate(
            row["stage"], (row["seconds"], 100 * row["error"]), textcoords="offset points", xytext=(4, 6), fontsize=7
        )
    finish(images, "processor time, s", "error of the images, %")
    for part, leaf in QUANTITIES:
        name = f"{part}.{leaf}"
        middle = [100 * statistics.median(abs(tooth[name]) for tooth in row["off"].values()) for row in rows]
        media.plot(
            seconds, middle, "o-", markersize=4, label=f"{part}, {'1 - α′' if leaf == 'alpha_reduced' else 'σs′'}"
        )
    finish(media, "processor time, s", "median error over teeth, %")
    return figure
