"""What the judgement of a calibration advises; it never advises what cannot help."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from services.calibrate.cameras.bundle import fit_bundle
from services.calibrate.cameras.models import ModelChoice
from services.calibrate.session.boards import CamerasStep
from services.calibrate.session.judge import judge
from services.calibrate.session.spheres import IntensityStep, LightsStep
from services.core.calibration.uncertainty import CalibrationUncertainty
from services.core.raw.records import RawFolder
from tests.support.board_sessions import photographed, true_rig

NAMES = ("light side", "middle", "right")
"""The first camera's name contains the word light, which must not cause advice to photograph spheres."""


@pytest.fixture(scope="module")
def cameras() -> CamerasStep:
    random = np.random.default_rng(3)
    rig = true_rig(random, 8)
    views = photographed(rig, 0.1, random)
    choices = {name: ModelChoice(lens, 0.1, {}) for name, lens in zip(NAMES, rig.lenses, strict=True)}
    return CamerasStep(NAMES, fit_bundle(views, rig), choices, tuple(views), ())


def folder(*channels: str) -> RawFolder:
    return cast("RawFolder", SimpleNamespace(channels=channels, light=(), frame=()))


def lights(variance: float = 0.01, views: tuple[SimpleNamespace, ...] = ()) -> LightsStep:
    """One light, well known by default; nothing else of the fit is used."""
    fit = SimpleNamespace(
        lights=np.array([0]),
        covariance=variance * np.eye(3),
        positions_mm=np.zeros((1, 3)),
        edge_shifts_px=(),
        outliers=(),
    )
    return cast("LightsStep", SimpleNamespace(fit=fit, views=views, view_names=(), no_highlight=(), aligned=None))


INTENSITY = cast(
    "IntensityStep",
    SimpleNamespace(fit=SimpleNamespace(residuals=np.zeros((4, 1)), used=range(4)), photos=(), lit_by_others={}),
)


def test_a_chart_is_advised_for_three_channels_alone(cameras: CamerasStep) -> None:
    told = judge(folder("red", "green", "blue"), cameras, lights(), INTENSITY, None, None)
    assert "Photograph a colour chart" in told.advice
    told = judge(folder("near infrared"), cameras, lights(), INTENSITY, None, None)
    assert "chart" not in told.advice


def test_boards_are_advised_for_a_camera_whatever_its_name(cameras: CamerasStep) -> None:
    shaken = replace(cameras.fit, residuals_px=cameras.fit.residuals_px * 15)
    told = judge(folder("red"), replace(cameras, fit=shaken), lights(), INTENSITY, None, None)
    assert [one.what for one in told.broken] == [f"scatter of corners, camera {name}" for name in NAMES]
    assert told.advice.startswith("Photograph boards again: scatter of corners, camera")
    # Corners scatter by 0.1 px in each coordinate, so their rms is 15 × 0.141 = 2.1 px, and 2.1² asks for five times as
    # many.
    assert "; 5 times as many photographs would meet it" in told.advice


def test_what_looks_wrong_is_mended_before_photographs_are_counted(cameras: CamerasStep) -> None:
    shaken = replace(cameras, fit=replace(cameras.fit, residuals_px=cameras.fit.residuals_px * 15, converged=False))
    told = judge(folder("red"), shaken, lights(), INTENSITY, None, None)
    assert told.advice.startswith("First mend what looks wrong: scatter of corners, camera")


@pytest.mark.parametrize(("places", "remedy"), [(9, "in ten places that lie far apart"), (10, "4 times as many")])
def test_places_far_apart_are_advised_before_more_photographs(
    cameras: CamerasStep, places: int, remedy: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("services.calibrate.session.judge.suspicions", lambda *_: ())
    unsure = lights(variance=5.3, views=tuple(SimpleNamespace(place=place) for place in range(places)))
    told = judge(folder("red"), cameras, unsure, INTENSITY, None, None)
    # The light's ± is (3 · 5.3)^1/2 = 4.0 mm, twice the limit.
    assert "position of the lights, rms ± is 4 mm against 2 mm; " in told.advice
    assert remedy in told.advice


def test_the_white_sphere_is_advised_where_intensities_are_worst(cameras: CamerasStep) -> None:
    stated = CalibrationUncertainty(names=("light_gain.L0.red",), covariance=((0.025**2,),))
    told = judge(folder("red"), cameras, lights(), INTENSITY, None, stated)
    assert (
        "white sphere again: intensity of the lights, rms ± is 2.5 % against 0.5 %; measure its radius" in told.advice
    )


def test_a_figure_that_is_not_known_is_told(cameras: CamerasStep, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("services.calibrate.session.judge.uncertainty_at_the_boards", lambda *_: np.array([np.inf]))
    told = judge(folder("red"), cameras, lights(), INTENSITY, None, None)
    assert "boards again: uncertainty of projection at the boards, camera light side is not known at all" in told.advice
    assert [one.value for one in told.recorded if "projection" in one.what] == [None] * 3


def test_an_adjustment_that_did_not_settle_is_told(cameras: CamerasStep) -> None:
    assert cameras.fit.converged
    unsettled = replace(cameras, fit=replace(cameras.fit, converged=False))
    told = judge(folder("red"), unsettled, lights(), INTENSITY, None, None)
    assert any("stopped before it settled" in sentence for sentence in told.suspicions)
    assert judge(folder("red"), cameras, lights(), INTENSITY, None, None).suspicions == ()
