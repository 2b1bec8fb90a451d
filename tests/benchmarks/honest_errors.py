"""Check of a fit's ± by many small fits of known teeth: the number of 95 % intervals that contain the truth, and the
z-scores.

python -m tests.benchmarks.honest_errors --fits 100 --json honest_errors.json
python -m tests.benchmarks.honest_errors --fits 100 --truths 20 --json honest_errors_drawn.json
python -m tests.benchmarks.honest_errors --fits 100 --truths 100 --formula --json honest_errors_formula.json
python -m tests.benchmarks.honest_errors --fits 100 --truths 100 --formula --shape --json honest_errors_shape.json

Each fit is that of the product, from a prepared stage with new sensor noise to its report, on an ellipsoid of enamel
and dentin of some 90 pixels under six lights (one held out). The truth is rendered with ``--paths`` paths per pixel.
With ``--truths 1`` its mean cosine g is the value that fits hold. With more truths, optical parameters are drawn around
the centre and mean cosines from the fit's own prior, so that the errors from holding g are checked too. ``--formula``
replaces light transport by a formula in which media of equal reduced quantities give different images too; a fit then
takes a second, and only the solver's errors are checked. With ``--shape`` the dentin's blend weights are also drawn and
fitted, and enamel's mean thickness is checked.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np

from services.anatomy.job_dentin import dentin_shape
from services.core.files.meshes import read_teeth
from services.core.records import JobSpec
from services.core.results import PreparedManifest
from services.core.stage import LocalContext
from services.core.store import open_stage
from services.fit.coordinates.domain import to_natural
from services.fit.coordinates.priors import COSINE, WEAK
from services.fit.stage import ENGINE, run
from services.transport.optics.parameters import Medium, Tissue
from services.transport.platform import prepare_device
from services.transport.thickness import fitted_thickness
from tests.support.fake_engine import DirectFakeEngine
from tests.support.prepared import write_prepared
from tests.support.rendered_capture import rendered_tooth

CENTRE = {"enamel": (0.9, 0.01), "dentin": (2.4, 0.03)}
"""Reduced scattering and absorption (per mm) about which truths are drawn, by tissue."""
FORMULA = "tests.support.fake_engine:DirectFakeEngine"
LEAVES = ("sigma_s_reduced", "alpha_reduced")
INTERVAL = 1.959964


def tissue_of(reduced: dict[str, tuple[float, float]], g: dict[str, float]) -> Tissue:
    """Tissue of given reduced scattering and absorption (per mm) and mean cosine."""
    media = {}
    for part, (scattering, absorption) in reduced.items():
        sigma = scattering / (1 - g[part]) + absorption
        media[part] = Medium(sigma, 1 - absorption / sigma, g1=g[part])
    return Tissue(media["enamel"], media["dentin"])


def drawn_tissue(rng: np.random.Generator, *, with_shape: bool = False) -> Tissue:
    """Draw a tissue: scattering and absorption within factors of 1.3 and 1.6 of the centre, mean cosines from the fit's
    prior cut at two standard deviations, and blend weights if ``with_shape``.
    """
    cosines = {"enamel": COSINE, "dentin": WEAK["dentin.g1"]}
    reduced = {part: (s * 1.3 ** rng.uniform(-1, 1), a * 1.6 ** rng.uniform(-1, 1)) for part, (s, a) in CENTRE.items()}
    tissue = tissue_of(
        reduced,
        {
            part: to_natural("g1", mean + sd * float(np.clip(rng.standard_normal(), -2, 2)))
            for part, (mean, sd) in cosines.items()
        },
    )
    return replace(tissue, shape=tuple(rng.uniform(0.2, 0.8, 3).tolist())) if with_shape else tissue


class Subject(Protocol):
    """A tooth that can be photographed."""

    def photograph(self, root: Path, seed: int) -> None:
        """Publish ``prepared`` in ``root`` with new sensor noise."""


@dataclass(frozen=True)
class FormulaTooth:
    """A tooth whose images follow the formula of ``DirectFakeEngine``."""

    truth: Tissue

    def photograph(self, root: Path, seed: int) -> None:
        """See Subject."""
        write_prepared(root, truth=self.truth, seed=seed, engine=DirectFakeEngine)


def fit_rows(
    tooth: Subject, truth: Tissue, seed: int, options: dict[str, object], engine: str = ENGINE
) -> Iterator[dict[str, object]]:
    """Run one fit; yields one row per quantity with its estimate and its true value."""
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        tooth.photograph(root, seed)
        spec = JobSpec.model_validate(
            {
                "capture": root,
                "boundary": "matched",
                "dentin": "fit" if truth.shape else "known",
                "seed": seed,
                **options,
            }
        )
        report = run(spec, LocalContext(root), engine=engine)
        thickness = None
        if truth.shape:
            stage, prepared = open_stage(root, "prepared", PreparedManifest)
            (scanned,) = read_teeth(stage, prepared.fdi)
            dentin = dentin_shape(scanned, prepared.cameras, spec)
            thickness = fitted_thickness(scanned.outer, dentin, truth.shape, (), prepared.cameras[0])
        last = json.loads((root / "fit" / "history.json").read_text())[-1]
    found = {
        f"{part}.{leaf}": (report.parameters["green"][f"{part}.{leaf}"], getattr(getattr(truth, part), leaf))
        for part in CENTRE
        for leaf in LEAVES
    }
    if thickness is not None:
        assert report.enamel_thickness is not None
        found["enamel.thickness"] = report.enamel_thickness, thickness.mean.value
    for name, (estimate, true) in found.items():
        yield {
            "fit": seed,
            "quantity": name,
            "truth": float(true),
            "value": estimate.value,
            "se": estimate.se,
            "z": (estimate.value - float(true)) / estimate.se if estimate.se else None,
            "determined": estimate.determined,
            "converged": report.converged,
            "steps": report.steps,
            "samples": last["samples"],
            "verdict": last["verdict"],
            "g": [truth.enamel.g1, truth.dentin.g1],
        }


def summary(rows: list[dict[str, object]]) -> list[dict[str, object]]:
    """Per quantity: number of intervals that contain the truth, mean and rms of z, median relative standard error."""
    found = []
    for name in dict.fromkeys(str(row["quantity"]) for row in rows):
        mine = [row for row in rows if row["quantity"] == name]
        z = np.array([row["z"] for row in mine], dtype=float)
        relative = [float(str(row["se"])) / float(str(row["truth"])) for row in mine]
        found.append(
            {
                "quantity": name,
                "fits": len(mine),
                "held": int((np.abs(z) <= INTERVAL).sum()),
                "mean_z": float(z.mean()),
                "rms_z": float(np.sqrt(np.mean(z**2))),
                "largest_z": float(np.abs(z).max()),
                "median_relative_se": float(np.median(relative)),
                "determined": sum(bool(row["determined"]) for row in mine),
            }
        )
    return found


def main() -> None:
    """Run the study and print its summary."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fits", type=int, default=100)
    parser.add_argument("--truths", type=int, default=1)
    parser.add_argument("--formula", action="store_true", help="a formula in place of light transport")
    parser.add_argument(
        "--shape", action="store_true", help="draw and fit the dentin's shape; only with --formula and drawn truths"
    )
    parser.add_argument("--paths", type=int, default=65536, help="of the truth, per pixel")
    parser.add_argument("--pixels", type=int, default=10, help="of a camera's side")
    parser.add_argument("--first", type=int, default=0, help="seed of the first fit")
    parser.add_argument("--samples", type=int, default=32)
    parser.add_argument("--max-samples", type=int, default=256)
    parser.add_argument("--max-steps", type=int, default=8)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--json", type=Path, required=True)
    arguments = parser.parse_args()
    if arguments.shape and (not arguments.formula or arguments.truths == 1):
        parser.error("--shape needs --formula and more than one of --truths")
    prepare_device(arguments.threads)
    options: dict[str, object] = {
        "samples_per_pixel": arguments.samples, "max_samples_per_pixel": arguments.max_samples,
        "max_steps": arguments.max_steps, "search_candidates": 2000, "advise": False,
    }  # fmt: skip
    rng, rows = np.random.default_rng(2024), list[dict[str, object]]()
    held = tissue_of(CENTRE, {"enamel": 0.8, "dentin": 0.8})
    truths = (
        [held]
        if arguments.truths == 1
        else [drawn_tissue(rng, with_shape=arguments.shape) for _ in range(arguments.truths)]
    )
    teeth: dict[int, Subject] = {}
    for number in range(arguments.first, arguments.first + arguments.fits):
        which = number % len(truths)
        if which not in teeth:
            rendered = {"samples": arguments.paths, "seed": 770_000 + which, "pixels": arguments.pixels}
            teeth[which] = (
                FormulaTooth(truths[which]) if arguments.formula else rendered_tooth(truths[which], **rendered)
            )
        began_s = time.process_time()
        fresh = list(fit_rows(teeth[which], truths[which], number, options, FORMULA if arguments.formula else ENGINE))
        rows += fresh
        print(
            number,
            f"{time.process_time() - began_s:.1f} s",
            fresh[0]["verdict"],
            [f"{row['z']:+.1f}" for row in fresh],
            flush=True,
        )
        arguments.json.write_text(json.dumps({"summary": summary(rows), "rows": rows}, indent=1) + "\n")
    for line in summary(rows):
        print(line)


if __name__ == "__main__":
    main()
