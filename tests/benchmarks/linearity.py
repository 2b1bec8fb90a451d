"""Check of a camera's linearity on real frames: the counts as they are, this project's decision, the curve that it
would always apply, and Debevec's response by OpenCV.

python -m tests.benchmarks.linearity --json linearity.json

A quarter of a minute of one core. Of the colour chart every choice of three or four exposures is fitted on the bands
400, 500, 600 and 700 nm, and measured on the three others: 5, 50 and 95 % of the ratios of patch means over those of
the exposure times, 1 for a linear camera, and their median distance from 1. ``bends`` has the same for frames whose
counts are bent by a known share at full scale. ``subsets`` counts how often a curve is applied to choices of exposures
and one, two or all bands of this linear sensor.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from services.preprocess.raw.response import Linearity, _curve, _pairs, measure_linearity
from tests.support.chart_frames import (
    BANDS_NM,
    FULL,
    TIMES_MS,
    Correct,
    Image,
    as_counted,
    bent,
    counts,
    pairs,
    patch_ratios,
)

FITTED, MEASURED = BANDS_NM[::2], BANDS_NM[1::2]


def always(times_ms: Sequence[int], bands_nm: Sequence[int], bend: Correct) -> Linearity:
    """The curve that is fitted to all pairs, applied without a test."""
    found = _curve(_pairs(pairs(times_ms, bands_nm, bend), FULL))
    return Linearity(np.empty(0), found or (0.0, 0.0), FULL)


def debevec(times_ms: Sequence[int], bands_nm: Sequence[int], bend: Correct) -> Correct:
    """Debevec and Malik's response (1997) of counts above black in 8 bits, all bands beside each other as one scene."""
    rows = []
    for time_ms in times_ms:
        own = [bend(frame - dark) for frame, dark in (counts(band, time_ms) for band in bands_nm)]
        flat = np.concatenate([np.moveaxis(one, -1, 0).reshape(-1, one.shape[1]) for one in own])
        rows.append(cv2.cvtColor(np.clip(np.rint(flat), 0, 255).astype(np.uint8), cv2.COLOR_GRAY2BGR))
    calibration = cv2.createCalibrateDebevec(samples=200, random=False)
    response = calibration.process(rows, np.array(times_ms, dtype=np.float32) / 1000)[:, 0, 0]
    scale = 128 / float(response[128])

    def correct(signal: Image) -> Image:
        return np.asarray(np.interp(bend(signal), np.arange(256), response * scale), dtype=np.float32)

    return correct


def measured(times_ms: Sequence[int], bend: Correct) -> dict[str, Any]:
    """Ratios by each way, fitted on some bands and measured on others."""
    found = measure_linearity(pairs(times_ms, FITTED, bend), FULL)
    ways: dict[str, Correct] = {
        "plain": bend,
        "decided": lambda signal: found.linearised(bend(signal)),
        "always": lambda signal: always_found.linearised(bend(signal)),
        "debevec": debevec(times_ms, FITTED, bend),
    }
    always_found = always(times_ms, FITTED, bend)
    told: dict[str, Any] = {"times_ms": list(times_ms), "curve": not found.is_linear}
    for name, correct in ways.items():
        ratios = patch_ratios(times_ms, MEASURED, correct)
        ratios = ratios[np.isfinite(ratios) & (ratios > 0)]
        told[name] = [round(float(one), 3) for one in np.percentile(ratios, (5, 50, 95))]
        told[f"{name}_off"] = round(float(np.median(np.abs(np.log(ratios)))), 4)
    return told


def applied() -> dict[str, int]:
    """How often a curve is applied to choices of exposures and bands of the chart."""
    bands = [BANDS_NM, *combinations(BANDS_NM, 2), *combinations(BANDS_NM, 1)]
    choices = [times for count in (4, 3, 2) for times in combinations(TIMES_MS, count)]
    found = [measure_linearity(pairs(times, own), FULL) for times in choices for own in bands]
    told = [one for one in found if one.ratios.size]
    return {"choices": len(told), "curves": sum(not one.is_linear for one in told)}


def main() -> None:
    """Measure all choices, and print them as a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    begun = time.process_time()
    choices = [times for count in (4, 3) for times in combinations(TIMES_MS, count)]
    result: dict[str, Any] = {
        "linear": [measured(times, as_counted) for times in choices],
        "bends": {f"{share:+g}": measured(TIMES_MS, bent(share)) for share in (-0.2, -0.1, -0.05, -0.03, 0.05, 0.1)},
        "subsets": applied(),
    }
    result["core_minutes"] = round((time.process_time() - begun) / 60, 1)
    if arguments.json:
        arguments.json.write_text(json.dumps(result, indent=1))
    print(json.dumps(result))


if __name__ == "__main__":
    main()
