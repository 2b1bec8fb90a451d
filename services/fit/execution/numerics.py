"""Which numbers a fit of the same seeds gives: what a checkpoint may be continued under."""

NUMERICS = 3
"""Raise it with every change after which the same job, data and seeds give other numbers than rounding explains:
estimators, random streams, solvers, schedules. A fit that was begun under another number starts anew.
``tests/physics/test_numerics.py`` fails where it should have been raised and was not."""

_NAME_OF_FIRST = "0.1.0"
"""What version 0.1.0 wrote into its checkpoints, which are continued as long as the numerics are its own."""


def numerics_name(number: int = NUMERICS) -> str:
    """The part of a checkpoint's fingerprint that stands for the numerics."""
    return _NAME_OF_FIRST if number == 1 else f"numerics {number}"
