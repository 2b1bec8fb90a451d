"""What a demonstration ends with: the fit beside the truth, and a photograph in colour beside the asset's render."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import typer

from services.assets.colour.beside import BACKGROUND, MIN_SIDE_PX, Beside, beside, picture
from services.assets.colour.develop import developed
from services.assets.colour.spaces import LINEAR_SRGB
from services.cli.client.demo_end import PICTURE, tell_end
from services.core.errors import CorruptStoreError, InputError
from services.core.pages.pictures import tone_map
from services.core.results import AssetManifest, Figure, Verdict
from services.core.store import StoredArray
from services.phantom.truth import compared_scattering, scattering_lines
from tests.support.colour_job import COLOURS, LIGHTS, MEDIA, write_job

SAMPLES = 256


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_job(tmp_path_factory.mktemp("demo") / "job", SAMPLES)


def test_the_assets_render_has_the_colours_of_its_photograph(job: Path) -> None:
    found = beside(job, SAMPLES)
    assert (found.camera, found.light, found.held_out, found.matrix) == ("c0", "l1", True, "the calibration")
    # Photograph and render are of other seeds. A pixel's noise is 8.6 % and 208 pixels show the ball, so the means'
    # difference has a standard error of 0.85 %; four of them.
    np.testing.assert_allclose(found.render.mean(axis=(0, 1)), found.photo.mean(axis=(0, 1)), rtol=0.034)
    # The developed photograph is the stored one over a diffuser's radiance, intensity ÷ (π d²), by the matrices.
    raw = StoredArray(job / "prepared" / "prepared.zarr" / "radiance")[0, 1].astype(np.float64)
    position = np.array(LIGHTS[1].position_mm)
    white = np.array(LIGHTS[1].intensity) / (np.pi * position @ position)
    np.testing.assert_allclose(found.photo, developed(raw / white, COLOURS["c0"], LINEAR_SRGB), rtol=1e-6, atol=1e-9)
    # Blue is absorbed most, so the ball is yellow.
    red, _, blue = found.photo.mean(axis=(0, 1))
    assert red > 1.1 * blue


def test_without_held_out_photographs_the_brightest_is_shown(tmp_path: Path) -> None:
    found = beside(write_job(tmp_path / "job", 16, held_out=()), 16)
    assert (found.light, found.held_out) == ("l1", False)


def test_an_asset_of_one_channel_has_no_colours(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no red, green and blue; fit these channels"):
        beside(write_job(tmp_path / "job", 4, channels=("green",)), 4)


def test_the_picture_shows_both_at_one_exposure_above_what_they_are() -> None:
    random = np.random.default_rng(0)
    photo = random.uniform(0.2, 0.5, (24, 20, 3))
    one = Beside("c0", "l1", held_out=True, photo=photo, render=0.5 * photo, matrix="the calibration")
    shown = picture(one, "Simulated photograph")
    factor = MIN_SIDE_PX // 24
    white = np.percentile(photo.max(axis=-1), 99)
    for image in (photo, 0.5 * photo):
        wanted = tone_map(image, white).repeat(factor, axis=0).repeat(factor, axis=1)
        rows = shown[16 : 16 + wanted.shape[0]]
        width = wanted.shape[1]
        places = [x for x in range(rows.shape[1] - width + 1) if (rows[:, x : x + width] == wanted).all()]
        assert len(places) == 1
    caption = shown[16 + wanted.shape[0] + 4 :]
    assert (caption != BACKGROUND).any(axis=-1).sum() > 500
    assert (shown[:, :4] == BACKGROUND).all()
    assert (shown[:, -4:] == BACKGROUND).all()


def test_each_value_stands_beside_its_truth(job: Path) -> None:
    compared = compared_scattering(job)
    assert [(one.tissue, one.channel) for one in compared] == [
        (tissue, channel) for tissue in ("enamel", "dentin") for channel in ("red", "green", "blue")
    ]
    assert compared[1].simulated == MEDIA["green"].enamel.sigma_s_reduced
    head, *lines = scattering_lines(compared)
    assert len({len(line) for line in lines}) == 1
    assert lines[0].split() == ["enamel", "red", "0.332", "±", "0.003", "0.332"]
    assert head.index("simulated") <= lines[0].rindex("0.332") < len(head)


def test_a_folder_without_its_truth_is_named(tmp_path: Path) -> None:
    with pytest.raises(CorruptStoreError, match=r"truth.json cannot be read .* new folder"):
        compared_scattering(tmp_path)


def verdict(*, converged: bool) -> Verdict:
    return Verdict(
        headline="How it went.", steps=9, converged=converged, doubtful=False, is_above_limit=False, limit=0.1,
        error_of="held-out", error=Figure(value=0.03, se=0.001), channels={}, enamel_thickness=None, advice="",
    )  # fmt: skip


@pytest.mark.parametrize("converged", [True, False])
def test_the_last_line_is_the_pictures_path(
    job: Path, converged: bool, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("services.cli.client.demo_end.PICTURE_SAMPLES", 4)
    asset = AssetManifest(files=(), held_out_error=0.03, converged=converged, verdict=verdict(converged=converged))
    (job / PICTURE).unlink(missing_ok=True)
    if converged:
        tell_end(asset, job, as_json=False)
    else:
        with pytest.raises(typer.Exit):
            tell_end(asset, job, as_json=False)
    out, err = capsys.readouterr()
    lines = out.splitlines()
    assert lines[0].startswith("reduced scattering")
    assert lines[-3:] == [f"report: {job / 'report.html'}", f"next: dentine export {job} --to blender gltf",
                          f"picture: {job / PICTURE}"]  # fmt: skip
    assert (job / PICTURE).read_bytes().startswith(b"\x89PNG")
    assert "How it went." in err


def test_a_program_is_told_the_same(
    job: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("services.cli.client.demo_end.PICTURE_SAMPLES", 4)
    asset = AssetManifest(files=(), held_out_error=0.03, verdict=verdict(converged=True))
    tell_end(asset, job, as_json=True)
    told = json.loads(capsys.readouterr().out)
    assert told["picture"] == str(job / PICTURE)
    first = told["reduced_scattering"][0]
    assert (first["tissue"], first["channel"], first["unit"]) == ("enamel", "red", "1/mm")
    assert (first["found"], first["se"], first["simulated"]) == pytest.approx((0.3325, 0.003325, 0.3325))
