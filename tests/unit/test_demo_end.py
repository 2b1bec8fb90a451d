"""What a demonstration ends with: the fit beside the truth, the next command and the picture's path."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import typer

from services.cli.client.demo_end import tell_end
from services.core.errors import CorruptStoreError
from services.core.results import AssetManifest, Figure, Verdict
from services.phantom.truth import compared_scattering, scattering_lines
from tests.support.colour_job import MEDIA, write_job

PICTURE = "asset/render_beside_photograph.png"


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_job(tmp_path_factory.mktemp("demo") / "job", 4)


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
def test_the_last_line_is_the_pictures_path(job: Path, converged: bool, capsys: pytest.CaptureFixture[str]) -> None:
    asset = AssetManifest(files=(), held_out_error=0.03, converged=converged, verdict=verdict(converged=converged))
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
    assert "How it went." in err


def test_a_program_is_told_the_same(job: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asset = AssetManifest(files=(), held_out_error=0.03, verdict=verdict(converged=True))
    tell_end(asset, job, as_json=True)
    told = json.loads(capsys.readouterr().out)
    assert told["picture"] == str(job / PICTURE)
    first = told["reduced_scattering"][0]
    assert (first["tissue"], first["channel"], first["unit"]) == ("enamel", "red", "1/mm")
    assert (first["found"], first["se"], first["simulated"]) == pytest.approx((0.3325, 0.003325, 0.3325))
