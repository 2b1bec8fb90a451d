"""Numbers and colours in the tables of reports."""

from __future__ import annotations

import math

import numpy as np

from services.core.pages.pictures import ColourStops
from services.core.results import Estimate


def cell(estimate: Estimate | None) -> dict[str, str]:
    """Cells of a number in the report's tables: value, standard error and flag.

    A coefficient is not negative, so one below its standard error is told as an upper limit.
    """
    if estimate is None:
        return {"value": "", "se": "", "flag": ""}
    if estimate.se is None:
        return {"value": f"{estimate.value:.4g}", "se": "", "flag": "" if estimate.determined else "not fitted"}
    digits = _decimals(estimate.se)
    flag = "" if estimate.determined else "not determined"
    if estimate.unit == "1/mm" and 0 <= estimate.value < estimate.se:
        limit = f"at most {estimate.value + 2 * estimate.se:.{digits}f} (two standard errors)"
        return {"value": limit, "se": "", "flag": flag}
    return {"value": f"{estimate.value:.{digits}f}", "se": f"{estimate.se:.{digits}f}", "flag": flag}


def _decimals(se: float) -> int:
    # Number of decimals that gives two significant digits of the standard error.
    return int(np.clip(1 - math.floor(math.log10(se)), 0, 8)) if se > 0 and math.isfinite(se) else 4


def gradient(stops: ColourStops) -> str:
    """Colour stops in the syntax of a CSS gradient."""
    return ", ".join(f"rgb{colour} {100 * position:g}%" for position, colour in stops)
