"""Fits of single teeth of the jaw that stock Mitsuba rendered (``tests/support/jaw_truth.py``), with gums and other
teeth around them and without, as JSON.

python -m tests.benchmarks.surroundings --json surroundings.json [--teeth 11 21] [--options '{"pixel_step": 1}']

The photographs show a whole jaw with a wall behind it, which the fit of a tooth does not have. Every tooth of that jaw
has media of its own, while a fit takes the other teeth to have the fitted one's.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

from services.core.records import JobSpec
from services.core.results import FitReport
from services.core.store import open_stage
from tests.support.jaw_truth import CHANNEL, JawTruth, read_jaw_truth, write_jaw_capture

TEETH = (11, 12, 13, 21, 22, 23)
"""The front teeth, of which most pixels are seen."""


def row(folder: Path, truth: JawTruth, fdi: int, options: dict[str, Any], *, surroundings: bool) -> dict[str, Any]:
    """Fit one tooth, and return its errors: that of its held-out images, and for each quantity the relative error with
    its standard error.
    """
    from services.pipeline.stages import run_job

    told: dict[str, Any] = {"capture": folder / "capture", "fdi": fdi, "boundary": "matched", "dentin": "known"}
    told |= {"surroundings": "on" if surroundings else "off", "instrument": "off", "advise": False}
    job = folder / f"{fdi}-{surroundings}"
    run_job(JobSpec.model_validate(told | options), job, workers=1)
    report = open_stage(job, "fit", FitReport)[1]
    (tissue,) = (own for own, tooth in zip(truth.mouth.teeth, truth.jaw.teeth, strict=True) if tooth.fdi == fdi)
    errors = {}
    for part, medium in (("enamel", tissue.enamel), ("dentin", tissue.dentin)):
        for leaf, true in (
            ("sigma_s_reduced", medium.sigma_s_reduced),
            ("sigma_a", (1 - medium.alpha) * medium.sigma),
        ):
            found = report.parameters[CHANNEL][f"{part}.{leaf}"]
            errors[f"{part}.{leaf}"] = (found.value / true - 1, None if found.se is None else found.se / true)
    return {
        "fdi": fdi,
        "surroundings": surroundings,
        "held_out_error": report.held_out_error.get(CHANNEL),
        "fit_error": report.fit_error[CHANNEL],
        "converged": report.converged,
        "seconds": report.seconds,
        "errors": errors,
    }


def main() -> None:
    """Print each row when it is known, and write all of them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--teeth", type=int, nargs="+", default=TEETH)
    parser.add_argument("--options", default="{}", help="options of the job, JSON")
    parser.add_argument("--json", type=Path, required=True)
    arguments = parser.parse_args()
    truth, rows = read_jaw_truth(), list[dict[str, Any]]()
    with tempfile.TemporaryDirectory() as folder:
        write_jaw_capture(Path(folder) / "capture", truth, seed=1)
        for fdi in arguments.teeth:
            for surroundings in (True, False):
                options = json.loads(arguments.options)
                rows.append(row(Path(folder), truth, fdi, options, surroundings=surroundings))
                print(json.dumps(rows[-1]), flush=True)
                arguments.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
