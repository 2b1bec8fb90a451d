"""Version of a fit's numerics; a checkpoint is continued only under the version that began it."""

NUMERICS = 19
"""Version of everything that decides the numbers of a fit: estimators, random streams, solvers, schedules. Raise it
with every change after which the same job, data and seeds give results that differ by more than rounding. A fit that
was begun under another version starts anew. ``tests/physics/test_numerics.py`` fails where the version should have been
raised and was not."""

_NAME_OF_FIRST = "0.1.0"
"""Name that version 0.1.0 wrote into its checkpoints; these are continued while ``NUMERICS`` is 1."""


def numerics_name(number: int = NUMERICS) -> str:
    """Name of the numerics in a checkpoint's fingerprint."""
    return _NAME_OF_FIRST if number == 1 else f"numerics {number}"
