"""The report of a job in red, green and blue shows colour differences, translucency and shade; the command
that computes the shade writes it anew.
"""

from __future__ import annotations

import base64
import json
import re
import shutil
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from services.assets.appearance.shade import NOT_FOR, read_shade
from services.assets.content import RGB
from services.assets.photograph_free import export_without_photographs
from services.assets.stage import export
from services.cli.app import build_app
from services.core.errors import CaptureInputError
from services.core.records import JobSpec
from services.core.stage import LocalContext
from services.core.store import write_record
from services.fit.stage import run as fit
from tests.support.prepared import FAKE, write_prepared

OPTIONS: dict[str, Any] = {
    "boundary": "matched", "dentin": "known", "samples_per_pixel": 16, "max_samples_per_pixel": 16, "max_steps": 1,
    "search_candidates": 200, "instrument": "off", "advise": False,
}  # fmt: skip
GUIDE = "tab,geometry,L,a,b,se\nlight,45/0,90,0,5,0.3\ndark,45/0,40,2,9,0.3\n"


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("colour")
    write_prepared(root, channels=RGB)
    spec = JobSpec(capture=root, **OPTIONS)
    write_record(root / "job.json", spec)
    fit(spec, LocalContext(root), engine=FAKE)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("services.assets.colour.beside.PATHS", 20_000)
        export(spec, LocalContext(root))
    return root


@pytest.fixture
def own_job(job: Path, tmp_path: Path) -> Path:
    """A copy of the job whose report a test may write again."""
    return Path(shutil.copytree(job, tmp_path / "job"))


def test_colour_differences_stand_beside_what_noise_gives(job: Path) -> None:
    page = (job / "report.html").read_text()
    assert "<h2>Colour differences ΔE00</h2>" in page
    assert "0.8 is just seen and 1.8 accepted by half of observers" in page
    # Those of the first picture's two pairs come before those of the fit's pictures.
    assert page.count('alt="Colour difference, camera') == 2 + page.count('alt="photo, camera') > 3
    found = re.findall(r"median ([0-9.]+), 95 % below [0-9.]+; noise alone gives ([0-9.]+)", page)
    assert len(found) == page.count('alt="Colour difference, camera')
    for median, noise in found[2:]:
        # The engine's noise is greater than what its render and the photograph differ by otherwise. At least 12 squares
        # with a spread of half their median: that is known to 0.18, and twice is five standard errors.
        assert 0.5 * float(noise) < float(median) < 2 * float(noise)


def test_the_report_begins_with_photographs_beside_renders(job: Path) -> None:
    picture = base64.b64encode((job / "asset" / "render_beside_photograph.png").read_bytes()).decode()
    page = (job / "report.html").read_text()
    assert page.index(picture) < page.index("Error on held-out images")
    assert "render_beside_photograph.png" in json.loads((job / "asset" / "asset.json").read_text())["files"]


def test_translucency_is_shown(job: Path) -> None:
    page = (job / "report.html").read_text()
    rows = re.findall(r'<th scope="row"> (enamel|dentin)</th><td>([0-9.]+) <span class="pm">± ([0-9.]+)</span>', page)
    assert [tissue for tissue, _, _ in rows] == ["enamel", "dentin"]
    assert all(0 < float(value) < 100 and float(se) > 0 for _, value, se in rows)
    assert "<h2>Shade</h2>" not in page
    assert "red, green and blue are taken for linear sRGB" in page


def test_without_photographs_no_difference_from_one_is_shown(job: Path) -> None:
    page = (export_without_photographs(job) / "report.html").read_text()
    assert "<h2>Colour differences ΔE00</h2>" not in page
    assert "<h2>Translucency</h2>" in page


def test_the_shades_command_writes_the_report_again(own_job: Path, tmp_path: Path) -> None:
    guide = tmp_path / "own.csv"
    guide.write_text(GUIDE)
    done = CliRunner().invoke(build_app(), ["shade", str(own_job), str(guide)])
    assert done.exit_code == 0, done.output
    assert done.output.startswith("tooth 11: ΔE00 ")
    assert "(45/0, D65)" in done.output
    assert NOT_FOR in done.output
    page = (own_job / "report.html").read_text()
    assert "<h2>Shade</h2>" in page
    assert NOT_FOR in page
    assert "guide own under D65" in page
    shade = read_shade(own_job, own_job / "asset")
    assert shade is not None
    (tooth,) = shade.teeth
    assert {one.tab for one in tooth.tabs} == {"light", "dark"}
    assert all(one.se > 0 for one in tooth.tabs)


def test_a_shade_of_an_earlier_fit_is_not_shown(own_job: Path, tmp_path: Path) -> None:
    guide = tmp_path / "own.csv"
    guide.write_text(GUIDE)
    assert CliRunner().invoke(build_app(), ["shade", str(own_job), str(guide)]).exit_code == 0
    assert read_shade(own_job, own_job / "asset") is not None
    told = json.loads((own_job / "shade.json").read_text())
    (own_job / "shade.json").write_text(json.dumps(told | {"parameters_sha256": "0" * 64}))
    assert read_shade(own_job, own_job / "asset") is None


def test_a_guide_with_a_missing_tab_is_refused_and_nothing_is_written(job: Path, tmp_path: Path) -> None:
    guide = tmp_path / "own.csv"
    guide.write_text(GUIDE.replace("40,2,9", ",,"))
    before = (job / "report.html").read_bytes()
    done = CliRunner().invoke(build_app(), ["shade", str(job), str(guide)])
    assert isinstance(done.exception, CaptureInputError)
    assert "misses tab dark: it has no value of L" in done.exception.message
    assert (job / "report.html").read_bytes() == before
