"""The real incisor with known optics, rendered by stock Mitsuba, fitted end to end with the project's engine."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from services.core.records import FitReport, JobSpec
from services.core.stage import LocalContext
from services.fit.stage import run
from services.preprocess.stage import run as prepare
from tests.support.shared_data import shared_path


def noisy_copy(target: Path, seed: int) -> Path:
    """The capture with sensor noise: 1 % of the value and 0.2 % of the image's maximum."""
    source = shared_path("data/tooth-ur1-truth")
    target.mkdir()
    for path in source.rglob("*"):
        if path.is_file():
            (target / path.relative_to(source)).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, target / path.relative_to(source))
    rng = np.random.default_rng(seed)
    for image in json.loads((target / "capture.json").read_text())["images"]:
        radiance, variance = (np.load(target / image[key]) for key in ("file", "variance_file"))
        noise = np.where(radiance > 0, (0.01 * radiance) ** 2 + (0.002 * radiance.max()) ** 2, 0.0)
        np.save(target / image["file"], (radiance + np.sqrt(noise) * rng.standard_normal(radiance.shape)).astype(np.float32))
        np.save(target / image["variance_file"], (variance + noise).astype(np.float32))
    return target


def fit_incisor(folder: Path, seed: int, **options: object) -> tuple[FitReport, dict[str, float]]:
    spec = JobSpec.model_validate({"capture": noisy_copy(folder / "capture", seed), "boundary": "matched", "dentin": "known", "seed": seed} | options)
    context = LocalContext(folder / "job")
    prepare(spec, context)
    truth = json.loads((shared_path("data/tooth-ur1-truth") / "truth.json").read_text())
    return run(spec, context), {part: truth[part]["sigma_s_reduced"] for part in ("enamel", "dentin")}


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("seed", [1, 2])
def test_real_incisor_within_its_goals(tmp_path: Path, seed: int) -> None:
    report, truth = fit_incisor(tmp_path, seed, max_samples_per_pixel=512)
    assert report.converged, report.advice
    assert report.held_out_error["green"] <= 0.05
    for part, value in truth.items():
        assert report.parameters["green"][f"{part}.sigma_s_reduced"].value == pytest.approx(value, rel=0.2)
