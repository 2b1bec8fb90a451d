"""The smoothness prior of a slab's phase function, for a medium whose phase function bends sharply at few angles."""

from __future__ import annotations

import numpy as np

from services.slab.cell.dictionary import ANGLES_RAD, KNOTS, Material, henyey_greenstein
from services.slab.solve.coordinates import Knots
from services.slab.solve.prior import POLE_SCALE, Quadratic, precision, pull_covariance, second_differences, widened

TROUGH = KNOTS // 3
"""Knot of a trough between two rings, three knots wide; ln f bends there by 100 per rad2 and more."""
SHARP = Material(
    henyey_greenstein(1.0, 0.5, 0.0).scattering * np.exp(-0.3 * np.exp(-0.5 * ((np.arange(KNOTS) - TROUGH) / 3) ** 2)),
    0.0,
)
CURVATURE = 30.0
"""Curvature that the images give each knot's ln f: one knot alone is known to 18 %."""


def drawn(scale: float | np.ndarray) -> float:
    """How far the prior moves ln f in the trough."""
    x, prior = Knots().unknowns(SHARP), precision(scale)
    return float(-(np.linalg.solve(prior + CURVATURE * np.eye(KNOTS + 1), prior @ x))[TROUGH])


def test_a_trough_that_is_seen_is_filled_less_where_the_prior_follows_it() -> None:
    # There are no random numbers here: 0.21 and 0.11, for a trough that is 0.3 deep.
    assert drawn(10.0) > 0.2
    assert drawn(widened(10.0, SHARP)) < 0.6 * drawn(10.0)


def test_a_scale_follows_a_medium_where_it_bends_and_nowhere_else() -> None:
    scale, bends = widened(10.0, SHARP), np.abs(second_differences() @ np.log(SHARP.scattering))
    assert bends[TROUGH] > 100
    # The trough's bends, over 9 knots of 0.9 degrees, are averaged over angles of 5 degrees to either side.
    assert scale[TROUGH] > 0.4 * bends[TROUGH]
    assert scale[TROUGH + 40 :].max() < 11


def test_a_corner_at_one_knot_makes_no_room_for_itself_alone() -> None:
    slope = 2.0 * np.abs(ANGLES_RAD - ANGLES_RAD[TROUGH])
    corner = Material(henyey_greenstein(1.0, 0.0, 0.0).scattering * np.exp(slope), 0.0)
    bends, scale = second_differences() @ np.log(corner.scattering), widened(10.0, corner)
    assert bends[TROUGH] > 200
    assert np.abs(np.delete(bends, [0, TROUGH, KNOTS - 1])).max() < 1e-6
    assert 10 < scale[TROUGH] < 0.4 * bends[TROUGH]
    assert scale[TROUGH + 4] > 0.8 * scale[TROUGH]


def test_a_peak_where_no_camera_looks_is_not_followed() -> None:
    peak = henyey_greenstein(1.0, 0.85, 0.0)
    assert (second_differences() @ np.log(peak.scattering))[0] < -80
    assert widened(10.0, peak)[:2].max() < 10.5


def test_evidence_is_asked_for_sharp_scales_at_the_end_alone() -> None:
    # The images determine ln f everywhere and show the trough.
    x, nothing = Knots().unknowns(SHARP), np.zeros((KNOTS + 1, KNOTS + 1))
    matrix = 1e4 * np.eye(KNOTS + 1)
    quadratic = Quadratic(matrix, -matrix @ x, nothing, np.zeros(KNOTS + 1), nothing)
    assert np.ndim(Knots().scale(SHARP, quadratic, sharp=False)) == 0
    sharp = np.asarray(Knots().scale(SHARP, quadratic, sharp=True))
    assert sharp.shape == ANGLES_RAD.shape
    assert sharp[TROUGH] > 5 * np.median(sharp)


PEAK = henyey_greenstein(1.0, 0.8, 0.0)


def quadratic_of(material: Material, seen_from_deg: float) -> Quadratic:
    """Images that determine ln f to 1 % at all knots from an angle on, and nothing below it."""
    weights = np.append(np.where(np.degrees(ANGLES_RAD) >= seen_from_deg, 1e4, 0.0), 1e4)
    matrix, nothing = np.diag(weights), np.zeros((KNOTS + 1, KNOTS + 1))
    return Quadratic(matrix, -matrix @ Knots().unknowns(material), nothing, np.zeros(KNOTS + 1), nothing)


def test_a_peak_may_be_sharp_where_images_determine_it_and_not_elsewhere() -> None:
    seen, unseen = (np.asarray(Knots().scale(PEAK, quadratic_of(PEAK, low), sharp=True)) for low in (0.0, 8.0))
    assert seen[0] > 0.99 * POLE_SCALE
    assert unseen[0] < 31
    # Beyond the peak the medium hardly bends, and a peak with a scale of its own leaves the others narrow.
    assert seen[KNOTS // 2] < 11


def test_the_pull_of_the_prior_on_an_unseen_peak_is_more_than_the_prior_says() -> None:
    quadratic = quadratic_of(PEAK, 8.0)
    scale = Knots().scale(PEAK, quadratic, sharp=True)
    told, own = np.diag(Knots().pull_covariance(PEAK, quadratic, scale)), np.diag(precision(scale))
    assert told[0] > 4 * own[0]
    assert np.all(told >= 0.999 * own)


def test_the_pull_on_media_that_bend_as_the_prior_says_is_its_precision() -> None:
    scale = np.linspace(3.0, 30.0, KNOTS)
    np.testing.assert_allclose(pull_covariance(scale, scale), precision(scale), rtol=1e-12)
