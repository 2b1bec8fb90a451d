"""The notes of a slab's fit: which of them a fit has, by what its solver and its images tell."""

from __future__ import annotations

from typing import Any

import numpy as np

from services.slab.cell.dictionary import henyey_greenstein
from services.slab.read.images import Measurements
from services.slab.results.notes import notes_of
from services.slab.results.result import Errors
from services.slab.solve.coordinates import Knots
from services.slab.solve.normal import UNKNOWNS
from services.slab.solve.prior import Quadratic
from services.slab.solve.solution import Solution
from tests.support.small_slab import made_up_fit, small_rig

GOOD = Errors(fit_error=0.01, held_out_error=None)
PLACES = (("f0", "l0"), ("f0", "l1"), ("b0", "l0"), ("b0", "l1"))


def notes(*, sigma_s: float = 1.0, errors: Errors = GOOD, too_bright: tuple[int, ...] = (), **changes: Any) -> str:
    """All notes of a fit whose images are ones, but for those that are twice as bright as the fit says."""
    zeros = np.zeros((UNKNOWNS, UNKNOWNS))
    told: dict[str, Any] = {"misfit": 0.0, "converged": True, "path_variance": 0.1} | changes
    solution = Solution(
        henyey_greenstein(sigma_s, 0.5, 0.1), Quadratic(zeros, zeros[0], zeros, zeros[0], zeros), zeros, 30.0, used=100,
        steps=1, paths=1, coordinates=Knots(), misfit_se=0.0, data_noise=zeros, matrix_error_gradient=zeros[0], **told,
    )  # fmt: skip
    rendered = np.ones((len(PLACES), 8))
    values = rendered * np.where(np.isin(np.arange(len(PLACES)), too_bright), 2.0, 1.0)[:, None]
    held_out = np.zeros(len(PLACES), dtype=bool)
    measured = Measurements(values, np.full_like(values, 1e-4), held_out, PLACES, assumed_noise=False)
    like = made_up_fit()
    return " ".join(
        notes_of(small_rig(), "tents", measured, solution, like.parameters, like.phase, errors, (rendered, rendered))
    )


def test_a_good_fit_has_no_note() -> None:
    assert notes() == ""


def test_a_fit_whose_paths_are_the_larger_part_of_its_error_asks_for_more() -> None:
    assert "raise option effort for a smaller standard error" in notes(path_variance=2.0)


def test_a_camera_that_stands_out_is_named_where_images_do_not_fit() -> None:
    misfit: dict[str, Any] = {"misfit": 5000.0}
    assert "The images of camera b0 are 50 % off the fit" in notes(too_bright=(2, 3), **misfit)
    assert "The images of light l1 are 50 % off the fit" in notes(too_bright=(1, 3), **misfit)
    assert "off the fit" not in notes(too_bright=(1, 2), **misfit)
    assert "off the fit" not in notes(too_bright=(2, 3))


def test_no_dilution_is_advised_for_a_material_that_is_not_the_cells() -> None:
    assert "The sample is too thick" in notes(sigma_s=30.0)
    assert "The sample is too thick" not in notes(sigma_s=30.0, errors=Errors(fit_error=2.0, held_out_error=None))
