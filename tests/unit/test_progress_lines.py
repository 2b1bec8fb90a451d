"""A job's progress as one line of text."""

from __future__ import annotations

import pytest

from services.client.progress import _note
from services.core.events import JobEvent


@pytest.mark.parametrize(
    ("held_out", "se", "told"),
    [
        (0.062, 0.004, "Step 3; held-out error 6.2 ± 0.4 %."),
        (0.062, None, "Step 3; held-out error 6.2 %."),
        (0.066, 0.066, "Step 3; held-out error not yet told from the renders' noise."),
        (None, None, "Step 3."),
    ],
)
def test_a_held_out_error_that_is_all_noise_is_not_shown_as_a_number(
    held_out: float | None, se: float | None, told: str
) -> None:
    data = {"held_out_error": held_out, "held_out_se": se}
    event = JobEvent(
        id=1, job="j", time_s=0.0, stage="fit", attempt=1, kind="step", message="Step 3.", done=0.5, data=data
    )
    assert _note(event) == told
