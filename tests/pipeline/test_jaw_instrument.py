"""A jaw's fit with a formula engine to photographs that are all too bright: one gain for all teeth, and the parts of
each ±.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import pytest

from services.assets.stage import export
from services.core.records import JobSpec
from services.core.results import FitReport
from services.core.stage import LocalContext
from services.fit.measurements.observations import Observations, read_channel
from services.fit.measurements.view_stack import ViewStack
from services.fit.stage import run
from tests.support.small_jaw import jaw_spec, write_prepared_jaw

ENGINE = "tests.support.fake_mouth:QuietFakeMouthEngine"
FDI = (11, 12, 21)
GAIN = 1.02


@pytest.fixture(scope="module")
def brighter(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, JobSpec, FitReport]:
    root = tmp_path_factory.mktemp("brighter")
    write_prepared_jaw(root, ENGINE, FDI)
    spec = jaw_spec(root, max_samples_per_pixel=64, max_steps=2, search_candidates=100)

    def photographed(observations: Observations, channel: str, spec: JobSpec) -> tuple[ViewStack, ...]:
        return tuple(replace(v, reference=GAIN * v.reference) for v in read_channel(observations, channel, spec))

    with patch("services.fit.stages.jaw.driver.read_channel", photographed):
        return root, spec, run(spec, LocalContext(root), engine=ENGINE)


def test_a_jaws_errors_are_those_of_one_instrument(brighter: tuple[Path, JobSpec, FitReport]) -> None:
    _, _, report = brighter
    found = report.instrument["green"]
    lights = [f"light_gain.l{k}" for k in range(5) if k != 3]
    assert list(found) == ["gain.green", *lights, "flare.c0.green", "flare.c1.green"]
    gain = found["gain.green"]
    assert gain.se is not None
    # The gain's error is two prior standard errors. For one fit at one seed, the estimate is within 3 of its standard
    # errors.
    assert abs(gain.value - (GAIN - 1)) < 3 * gain.se
    assert report.assumed == (*found, "teeth", "dome")
    assert report.instrument_told[0].startswith("Assumed, as the calibration does not state")


def test_every_tooth_says_which_part_of_its_error_the_instrument_makes(
    brighter: tuple[Path, JobSpec, FitReport],
) -> None:
    root, spec, report = brighter
    for fdi in map(str, FDI):
        for name in ("enamel.sigma_a", "dentin.sigma_a"):
            one = report.teeth[fdi].parameters["green"][name]
            assert one.se is not None
            assert {"photographs", "gain", "light_gain", "flare", "dome"} <= one.se_parts.keys()
            assert sum(part**2 for part in one.se_parts.values()) == pytest.approx(one.se**2, rel=1e-6)
    export(spec, LocalContext(root))
    table = json.loads((root / "parameters.json").read_text())["green"]
    assert table["gain.green"]["se"] == report.instrument["green"]["gain.green"].se
    page = (root / "report.html").read_text()
    assert "light_gain.l0" in page
    assert "12 enamel, absorption σa" in page
