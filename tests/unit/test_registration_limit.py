"""The limit by which a registration accepts a scan as one of the photographed teeth."""

from __future__ import annotations

import pytest

from services.calibrate.registration.register import DOUBTFUL_MISFIT_MM, MAX_MISFIT_MM, doubts_of

OWN_MM = (0.116, 0.158, 0.146, 0.162, 0.198, 0.294)
"""Misfits of a patient's own teeth in photographs from the front and along the teeth, as
``tests.benchmarks.registration_real`` prints them."""
OTHERS_MM = (0.409, 0.461, 0.535, 0.571)
"""Misfits of another person's teeth in photographs of the same patient."""


def test_real_teeth_are_accepted_and_others_refused() -> None:
    assert max(OWN_MM) < MAX_MISFIT_MM < min(OTHERS_MM)


@pytest.mark.parametrize("misfit_mm", OWN_MM)
def test_what_a_calibrated_rig_would_not_leave_is_doubted(misfit_mm: float) -> None:
    (sentence,) = doubts_of(misfit_mm)
    assert sentence.startswith(f"The scan's teeth lie {misfit_mm:.2f} mm from the photographs' outlines")
    assert doubts_of(DOUBTFUL_MISFIT_MM) == ()
