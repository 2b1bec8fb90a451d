"""The virtual jaw's optics and options; ``tests/pipeline/test_prepare_jaw.py`` reads the folder it writes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from services.anatomy.distance import SurfaceDistance
from services.cli.app import build_app
from services.core.errors import CaptureInputError, InputError
from services.core.files.meshes import read_teeth
from services.core.records import FolderCapture
from services.core.store import read_record
from services.phantom.files import Renderer, held_out_lights
from services.phantom.jaw import SCAN_DENTIN, write_jaw_phantom
from services.phantom.jaw_optics import COSINE_SPREAD, SIGMA_SPREAD, gums_medium, jaw_mouth
from services.phantom.tooth import TRUE_TISSUE
from services.transport.optics.parameters import Medium
from tests.support.labelled_scan import bumps, universal, write_vtp

FDI = (11, 12, 13, 21)
SUBJECTS = range(1, 30)


def test_an_average_jaw_has_one_tissue() -> None:
    mouth = jaw_mouth(FDI, "blue", None)
    assert set(mouth.teeth) == {TRUE_TISSUE["blue"]}
    assert mouth.gums == gums_medium("blue")


@pytest.mark.parametrize(
    ("channel", "reduced", "absorption"), [("red", 1.39, 0.05), ("green", 1.71, 1.2), ("blue", 1.99, 0.6)]
)
def test_gums_have_the_tables_optics(channel: str, reduced: float, absorption: float) -> None:
    medium = gums_medium(channel)
    assert medium.sigma_s_reduced == pytest.approx(reduced)
    assert (1 - medium.alpha) * medium.sigma == pytest.approx(absorption)


def test_every_tooth_of_every_subject_has_its_own_media() -> None:
    mouths = [jaw_mouth(FDI, "green", subject) for subject in SUBJECTS]
    media = [medium for mouth in mouths for tissue in mouth.teeth for medium in (tissue.enamel, tissue.dentin)]
    assert len(set(media)) == 2 * len(FDI) * len(SUBJECTS)
    # ../shared/reference/tooth_optics.csv, reduced scattering near 540 nm: 0.24 to 2.1 per mm in enamel, 0.245 to 3.77
    # in dentin.
    for mouth in mouths:
        for tissue in mouth.teeth:
            assert 0.24 < tissue.enamel.sigma_s_reduced < 2.11
            assert 0.245 < tissue.dentin.sigma_s_reduced < 3.77
    average = TRUE_TISSUE["green"].enamel
    ratios = np.array([tissue.enamel.sigma / average.sigma for mouth in mouths for tissue in mouth.teeth])
    cosines = np.array([tissue.enamel.g1 - average.g1 for mouth in mouths for tissue in mouth.teeth])
    assert SIGMA_SPREAD * 0.9 < np.ptp(ratios) / 2 <= SIGMA_SPREAD
    assert COSINE_SPREAD * 0.9 < np.ptp(cosines) / 2 <= COSINE_SPREAD


def test_a_tooth_is_the_same_in_all_channels_and_whatever_stands_beside_it() -> None:
    green, blue = (jaw_mouth(FDI, channel, 4) for channel in ("green", "blue"))

    def character(medium: Medium, average: Medium) -> list[float]:
        return [medium.sigma / average.sigma, (1 - medium.alpha) / (1 - average.alpha), medium.g1 - average.g1]

    for one, other in zip(green.teeth, blue.teeth, strict=True):
        np.testing.assert_allclose(
            character(one.dentin, TRUE_TISSUE["green"].dentin),
            character(other.dentin, TRUE_TISSUE["blue"].dentin),
            rtol=1e-9,
        )
    assert jaw_mouth((21,), "green", 4).teeth[0] == green.teeth[3]


def test_held_out_lights_lie_between_the_others() -> None:
    assert held_out_lights(8, None) == {3, 7}
    assert held_out_lights(7, 2) == {1, 5}
    assert held_out_lights(5, 0) == frozenset()
    assert all(len(held_out_lights(count, k)) == k for count in range(1, 40) for k in range(count))


@pytest.mark.slow
def test_a_scanned_jaw_is_the_same_by_both_renderers(tmp_path: Path) -> None:
    scan = bumps({11: (-4.5, 0.0), 21: (4.5, 0.0)})
    write_vtp(tmp_path / "scan.vtp", scan.mesh, universal(scan.fdi))
    brightness, noise = [], []
    renderers: tuple[Renderer, ...] = ("engine", "mitsuba")
    for renderer in renderers:
        out = tmp_path / renderer
        write_jaw_phantom(
            out,
            subject=3,
            scan=tmp_path / "scan.vtp",
            pixel_mm=1.5,
            cameras=1,
            lights=2,
            samples=1024,
            renderer=renderer,
        )
        images = read_record(out / "capture.json", FolderCapture).images
        brightness.append([np.load(out / entry.file).astype(float).sum() for entry in images])
        noise.append([np.load(out / str(entry.variance_file)).astype(float).sum() for entry in images])
    # Two values from 16 batches on each side: |z| <= 4.5 fails at most one correct run in 4,000.
    scores = (np.array(brightness[0]) - brightness[1]) / np.sqrt(np.sum(noise, axis=0))
    assert np.abs(scores).max() <= 4.5
    assert (np.sqrt(np.sum(noise, axis=0)) < 0.03 * np.array(brightness[0])).all()

    truth = json.loads((tmp_path / "engine" / "truth.json").read_text())
    assert set(truth["dentin_shape"]) == {"11", "21"}
    assert all(SCAN_DENTIN[0] <= weight <= SCAN_DENTIN[1] for weight in truth["dentin_shape"]["11"])
    assert truth["channels"]["green"]["cavity_reflectance"] is None
    assert not (tmp_path / "engine" / "cavity.ply").exists()
    for tooth in read_teeth(tmp_path / "engine"):
        assert tooth.dentin is not None
        # B0 is 0.1 mm deep; the weights add at most this share of the way to 2 mm.
        depths = SurfaceDistance(tooth.outer).closest(tooth.dentin.vertices_mm)[1]
        assert 0.04 < depths.min() < depths.max() < 0.1 + SCAN_DENTIN[1] * 1.9 + 0.05


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"renderer": "mitsuba", "boundary": "thin"}, "Stock Mitsuba has no thin boundary"),
        ({"channels": 2}, "1 or 3 channels"),
        ({"lights": 4, "held_out": 4}, "Of 4 lights 4 cannot be held out"),
        ({"samples": 8}, "16 samples"),
        ({"scan": Path("nowhere.vtp")}, "nowhere.vtp does not exist"),
    ],
)
def test_impossible_options_end_in_a_sentence(tmp_path: Path, options: dict[str, Any], sentence: str) -> None:
    with pytest.raises((InputError, CaptureInputError), match=sentence):
        write_jaw_phantom(tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--jaw", "--gums"], "Option --gums is for one tooth"),
        (["--jaw", "--outer", "o.ply"], "Option --outer is for one tooth"),
        (["--scan", "s.vtp"], "Option --scan is for a jaw; add --jaw"),
    ],
)
def test_options_of_the_other_kind_are_refused(tmp_path: Path, arguments: list[str], sentence: str) -> None:
    outcome = CliRunner().invoke(build_app(), ["phantom", "--out", str(tmp_path / "out"), *arguments])
    assert isinstance(outcome.exception, InputError)
    assert sentence in outcome.exception.message
    assert not (tmp_path / "out").exists()
