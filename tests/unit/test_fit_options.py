"""How a job's options enter the names of its checkpoints and the report of its fit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from services.assets.job_report import describe_options
from services.core.files.content_files import StoredFile
from services.core.records import JobSpec
from services.fit.coordinates.instrument_errors import InstrumentErrors
from services.fit.measurements.instrument.moves import Move
from services.fit.measurements.observations import ChannelFiles, Level
from services.fit.stages.attempt import fingerprint

CAPTURE = Path("/captures/anna")
# Digests made by the code before any option was added to those of version 0.1; "numerics" and "engine" stand for the
# names of the two.
DEFAULTS = "e33e4fc488397004ade7c2cdd7597ecd3f3abfabb456bad41b5432e95fe798e5"
CHANGED = "b324cf722b393bbd186c58817ac47d75250a935e80cb1d6f3df350ab132599a0"
OPTIONS: dict[str, Any] = {"max_steps": 4, "loss": "robust", "held": {"enamel.sigma": 4.5}}


@pytest.fixture(autouse=True)
def numerics(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("services.fit.stages.attempt.numerics_name", lambda: "numerics")


def digest(**options: object) -> str:
    # The first version compared single pixels, where today's default chooses squares.
    return fingerprint(JobSpec.model_validate({"capture": CAPTURE, "pixel_step": 1} | options), "engine", [])


def test_checkpoints_keep_their_names_though_options_are_added() -> None:
    assert digest() == DEFAULTS
    assert digest(**OPTIONS, workers=5) == CHANGED


def test_every_option_that_changes_the_answer_makes_another_checkpoint() -> None:
    assert (
        len({digest(), digest(max_steps=4), digest(seed=2), digest(prior="literature"), digest(image_tolerance=0.01)})
        == 5
    )


def test_an_option_that_was_added_is_named_by_its_default_nowhere() -> None:
    assert digest(image_tolerance=0.004) == DEFAULTS


def test_another_uncertainty_of_the_instrument_makes_another_checkpoint() -> None:
    scene, spec = StoredFile(Path("/scene"), "scene"), JobSpec(capture=CAPTURE)
    move = Move("dome", StoredFile(Path("/moved"), "moved"), 8, ((1.0, 0.0, 0.0, 0.0),))
    plain = ChannelFiles("green", scene, (level := Level((), (), 0, 0.0)), level, (), scene, 1.0, 1.0)
    known = InstrumentErrors(("gain.green",), ((1e-4,),))
    files = [
        plain,
        replace(plain, errors=known),
        replace(plain, errors=replace(known, names=("light_gain.a",))),
        replace(plain, errors=known, moves=(move,)),
        replace(plain, errors=known, moves=(replace(move, recipe=scene),)),
        replace(plain, errors=known, moves=(replace(move, camera_move=((2.0, 0.0, 0.0, 0.0),)),)),
    ]
    assert len({fingerprint(spec, "engine", [one]) for one in files}) == len(files)


def test_the_report_names_the_options_that_were_set() -> None:
    assert describe_options(JobSpec(capture=CAPTURE)) == "all at their defaults"
    told = describe_options(
        JobSpec(capture=CAPTURE, calibration=CAPTURE, held_out_lights=("l1",), image_tolerance=0.01, **OPTIONS)
    )
    assert told == (
        'held = {"enamel.sigma": 4.5}; loss = robust; held_out_lights = ["l1"]; max_steps = 4; image_tolerance = 0.01; '
        "all others at their defaults"
    )
