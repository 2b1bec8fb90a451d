"""Stored truths are as described: optics of their subject, closed meshes, little space; the added sensor noise has the
variance in the files.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from services.phantom.subjects import subject_tissues
from services.transport.optics.parameters import MEDIUM_FIELDS
from tests.support.truths import FOLDER, SIDE_LIGHTS, names, read, write_capture


def test_truths_are_small() -> None:
    assert sum(path.stat().st_size for path in FOLDER.glob("*.npz")) < 1e6


@pytest.mark.parametrize("name", names())
def test_optics_are_those_of_the_subject(name: str) -> None:
    truth = read(name)
    tissue = subject_tissues(truth.optics["seed"], ("green",))["green"]
    for part in ("enamel", "dentin"):
        assert {field: truth.medium(part)[field] for field in MEDIUM_FIELDS} == pytest.approx(
            {field: getattr(getattr(tissue, part), field) for field in MEDIUM_FIELDS}
        )
    for part, mesh in truth.meshes.items():
        mesh.require_solid(part)
    assert set(SIDE_LIGHTS) < {light["name"] for light in truth.description["lights"]}


def test_noise_has_the_variance_that_is_written(tmp_path: Path) -> None:
    # The sum of squared z-scores of N pixels is chi-squared; five standard deviations of it happen by chance once in a
    # million.
    name = names()[0]
    truth = write_capture(name, tmp_path / "capture", seed=3, tested_camera="c1")
    description = json.loads((tmp_path / "capture" / "capture.json").read_text())
    squares = []
    for image in description["images"]:
        light = [one["name"] for one in description["lights"]].index(image["light"])
        mean, own = truth.mean[image["camera"]][light], truth.standard_error[image["camera"]][light] ** 2
        noisy, variance = (np.load(tmp_path / "capture" / image[key])[..., 0] for key in ("file", "variance_file"))
        lit = mean > 0
        squares.append((noisy - mean)[lit] ** 2 / (variance - own)[lit])
        assert image["held_out"] == (image["camera"] == "c1")
    z = np.concatenate(squares)
    assert abs(z.sum() - len(z)) < 5 * np.sqrt(2 * len(z))
