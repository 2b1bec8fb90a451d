"""The error of a dome's position where the calibration states the positions of its lights, and how the brightness of
moved lights changes.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.core.calibration.uncertainty import TWIST, CalibrationUncertainty
from services.core.geometry import Light
from services.core.records import JobSpec
from services.core.results import PreparedManifest
from services.fit.coordinates.instrument_errors import DEFAULT_MOVE_SE
from services.fit.measurements.instrument.capture import instrument_of
from services.fit.measurements.instrument.moves import move_covariance
from services.transport.scene.recipe import single_tooth
from services.transport.scene.recipe_files import read_recipe
from services.transport.scene.rigid_moves import rigid
from tests.support.prepared import camera, sphere

Array = NDArray[np.float64]
PLACES_MM = np.array([[0.0, 900, 100], [500, 700, 0], [-600, 650, 200], [100, 500, 800], [-200, 600, -700]])
LIGHTS = tuple(
    Light(name=f"l{k}", position_mm=tuple(place), intensity=(1.0 + 0.1 * k,))
    for k, place in enumerate(PLACES_MM.tolist())
)
PLACED = tuple(f"light.{light.name}.{axis}" for light in LIGHTS for axis in "xyz")
GAINS = tuple(f"light_gain.{light.name}" for light in LIGHTS)
SINGLE_MM = 1.5


def stated(names: tuple[str, ...], covariance: Array) -> CalibrationUncertainty:
    return CalibrationUncertainty(names=names, covariance=tuple(map(tuple, covariance.tolist())))


def shift_by(twist: Array) -> Array:
    move = rigid(twist, PLACES_MM.mean(axis=0))
    return np.asarray((PLACES_MM @ move[:3, :3].T + move[:3, 3] - PLACES_MM).reshape(-1))


def default_dome() -> Array:
    return np.diag(np.square(DEFAULT_MOVE_SE["dome"]))


def test_a_dome_whose_lights_are_all_placed_moves_by_what_their_errors_share() -> None:
    random = np.random.default_rng(1)
    root = random.standard_normal((6, 6)) * np.array([2e-3] * 3 + [3.0] * 3)[:, None]
    steps = np.diag([1e-6] * 3 + [1e-3] * 3)
    derivative = np.array([(shift_by(step) - shift_by(-step)) / (2 * step.sum()) for step in steps]).T
    together = derivative @ root @ root.T @ derivative.T
    covariance, assumed = move_covariance(stated(PLACED, together + 1e-9 * np.eye(len(PLACED))), LIGHTS)
    # Central differences of a turn by 1e-6 are good to rounding, 1e-9; the ridge adds less.
    np.testing.assert_allclose(covariance[6:, 6:], root @ root.T, rtol=1e-4, atol=1e-7)
    assert assumed == ("teeth",)

    # Independent errors of single lights give a dome of five lights an error smaller by the root of five.
    apart, _ = move_covariance(stated(PLACED, SINGLE_MM**2 * np.eye(len(PLACED))), LIGHTS)
    np.testing.assert_allclose(np.sqrt(np.diag(apart)[9:]), SINGLE_MM / np.sqrt(len(LIGHTS)), rtol=1e-9)


def test_a_dome_keeps_its_default_where_a_light_has_no_stated_place() -> None:
    covariance, assumed = move_covariance(stated(PLACED[3:], np.eye(len(PLACED) - 3)), LIGHTS)
    np.testing.assert_allclose(covariance[6:, 6:], default_dome())
    assert assumed == ("teeth", "dome")


def test_a_move_of_the_dome_that_is_named_counts_besides_its_lights() -> None:
    names = (*PLACED, *(f"dome.{axis}" for axis in TWIST))
    covariance, assumed = move_covariance(stated(names, 0.01 * np.eye(len(names))), LIGHTS)
    np.testing.assert_allclose(covariance[6:, 6:], 0.01 * np.eye(6))
    assert assumed == ("teeth",)


def brighter_by_moves_of_the_dome(folder: Path, names: tuple[str, ...]) -> float:
    """Largest relative change of a light's brightness at the teeth by any move of the dome; each moves some light."""
    ball = sphere(4.0)
    manifest = PreparedManifest(
        channels=("green",), cameras=(camera("c0"),), lights=LIGHTS, held_out=(), fdi=(11,), dentin_known=(),
        median_motion_px=None, valid_fraction=0.9, uncertainty=stated(names, 0.01 * np.eye(len(names))),
    )  # fmt: skip
    teeth_mm, found = ball.vertices_mm.mean(axis=0), []
    instrument = instrument_of(manifest, JobSpec(capture=folder), teeth_mm)
    assert instrument is not None
    recipe = single_tooth(ball, None, PLACES_MM, np.array([light.intensity[0] for light in LIGHTS]))
    for move in instrument.moves(folder, recipe):
        if move.body == "dome":
            scene, own = read_recipe(move.recipe), slice(move.first, move.first + len(LIGHTS))
            places_mm = scene.light_positions_mm[own]
            assert np.abs(places_mm - PLACES_MM).max() > 0.01
            away, before = (np.linalg.norm(places - teeth_mm, axis=1) for places in (places_mm, PLACES_MM))
            found.append(scene.light_intensities[own] / recipe.light_intensities * (before / away) ** 2 - 1)
    return float(np.abs(found).max())


def test_lights_whose_gains_know_their_distances_move_without_growing_brighter(tmp_path: Path) -> None:
    assert brighter_by_moves_of_the_dome(tmp_path, PLACED + GAINS) < 1e-9
    # Where the calibration states no gains, only the move changes the distances: two ± of a shift, 0.09 mm at a metre,
    # are 2e-4.
    assert brighter_by_moves_of_the_dome(tmp_path, PLACED) > 1e-4
