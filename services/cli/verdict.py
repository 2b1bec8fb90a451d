"""The verdict on a fit, as a sentence and an exit status."""

from __future__ import annotations

import sys

import typer

from services.core.results import Verdict
from services.core.verdict import NOT_CONVERGED_STATUS


def require_converged(verdict: Verdict) -> None:
    """Print on standard error how well a fit went.

    Raises:
        typer.Exit: the fit did not converge.
    """
    print(verdict.headline, file=sys.stderr)
    if verdict.advice and (verdict.doubtful or not verdict.converged):
        print(verdict.advice, file=sys.stderr)
    if not verdict.converged:
        raise typer.Exit(NOT_CONVERGED_STATUS)
