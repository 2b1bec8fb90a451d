"""The reference tables of slabs, as layers to simulate and expected values."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from services.slab.simulate import Layer, Sums, accumulate
from tests.support.shared_data import shared_path

SOURCES = ("normal", "diffuse")
BOUNDARIES = {"none": "matched", "thin": "thin", "smooth": "smooth"}
"""The project's name of a boundary by the tables' name."""
COSTLY_DEPTH = 50
"""Optical depth beyond which a finite white slab is costly: its paths scatter hundreds of times, so a case takes up to
a minute and is run at the wider tolerance only."""


@dataclass(frozen=True)
class SlabCase:
    """Reference values that one simulation gives: layers under one source, with the columns R and T."""

    name: str
    layers: tuple[Layer, ...]
    boundary: str
    ior: float
    source: str
    names: tuple[str, ...]
    """Names of the parameters of the derivatives."""
    values: NDArray[np.float64]
    """(1 + derivatives, 2): one row of totals, then one row per derivative."""

    def derivative_tolerance(self) -> NDArray[np.float64]:
        """Tolerance (derivatives, 2): 1 % of each derivative, or of 1e-3 of the case's largest one if that is more."""
        size = np.abs(self.values[1:])
        return 0.01 * np.maximum(size, 1e-3 * size.max())


def is_costly(case: SlabCase) -> bool:
    """Whether a slab is finite and deeper than ``COSTLY_DEPTH``."""
    return COSTLY_DEPTH < case.layers[0].thickness_mm < np.inf


def simulate(case: SlabCase, shortfall: Callable[[Sums], float], seed: int, *, border_terms_only: bool = False) -> Sums:
    """Trace until ``shortfall`` is at most 1; with derivatives where the case has any.

    Args:
        border_terms_only: compute the derivative to the border's depth from the two border terms, as in a tooth, not
            from the extinction scores, which give the same value in a slab.
    """
    names, sums = accumulate(
        case.layers, shortfall, ior=case.ior, boundary=case.boundary, source=case.source, gradient=bool(case.names),
        seed=seed, border_terms_only=border_terms_only,
    )  # fmt: skip
    assert names[-len(case.names) :] == case.names
    return sums


def fewer_lanes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the passes of a test have a quarter of the walks, for simulations that reach their error in less than the
    usual first pass. The spread of 2048 lanes gives an error to 2 %.
    """
    monkeypatch.setattr("services.slab.simulate.LANES", 2048)


def passes(count: int) -> Callable[[Sums], float]:
    """A shortfall function that ends a simulation after ``count`` passes, whatever the error. Each pass is four times
    as long as the one before.
    """
    return lambda sums: 0.0 if sums.passes >= count else 10.0


def total_cases() -> list[SlabCase]:
    """Read ``slab_totals.csv``. Extinction is 1 per mm, so the thickness in mm is the optical depth."""
    cases = []
    for row in rows_of("slab_totals.csv"):
        ior = float(row["n"])
        layer = Layer(sigma=1, alpha=float(row["a"]), g1=float(row["g"]), thickness_mm=float(row["tau"]))
        for source in SOURCES:
            name = f"a={row['a']} g={row['g']} tau={row['tau']} n={row['n']} {source}"
            values = np.array([[float(row[f"R_{source}"]), float(row[f"T_{source}"])]])
            cases.append(SlabCase(name, (layer,), "smooth" if ior > 1 else "matched", ior, source, (), values))
    return cases


def derivative_cases() -> list[SlabCase]:
    """Read ``slab_derivatives.csv``, in the order in which the simulation returns its derivatives."""
    groups: dict[str, list[dict[str, str]]] = {}
    for row in rows_of("slab_derivatives.csv"):
        groups.setdefault(row["case"], []).append(row)
    cases = []
    for name, rows in groups.items():
        layers = tuple(_layer(rows[0], number) for number in range(1, int(rows[0]["layers"]) + 1))
        for source in SOURCES:
            values = [[float(rows[0][f"{side}_{source}"]) for side in "RT"]] + [
                [float(row[f"d{side}_{source}"]) for side in "RT"] for row in rows
            ]
            # With one layer and one lobe the simulation's names have no layer numbers; the order is the table's.
            names = ("sigma", "alpha", "g") if len(rows) == 3 else tuple(row["wrt"] for row in rows)
            cases.append(
                SlabCase(
                    f"{name} {source}",
                    layers,
                    BOUNDARIES[rows[0]["boundary"]],
                    float(rows[0]["n"]),
                    source,
                    names,
                    np.array(values),
                )
            )
    return cases


def zero_cases() -> list[SlabCase]:
    """Read ``boundary_zero_test.csv``: slabs under uniform light, with the border at the table's middle depth. dR/dc,
    the derivative to the border's depth, is exactly zero.
    """
    cases = []
    for row in rows_of("boundary_zero_test.csv"):
        border, depth = float(row["c2_mm"]), float(row["depth_mm_T_below_1e-6"])
        optics: dict[str, Any] = {
            "alpha": float(row["alpha"]),
            "beta": float(row["beta"]),
            "g1": float(row["g1"]),
            "g2": float(row["g2"]),
        }
        layers = (
            Layer(sigma=float(row["sigma_top"]), thickness_mm=border, **optics),
            Layer(sigma=float(row["sigma_bottom"]), thickness_mm=depth - border, **optics),
        )
        values = np.array([[float(row["R_diffuse"]), 0.0], [0.0, 0.0]])
        cases.append(
            SlabCase(row["case"], layers, BOUNDARIES[row["boundary"]], float(row["n"]), "diffuse", ("c",), values)
        )
    return cases


def named(cases: list[SlabCase], *names: str) -> list[SlabCase]:
    """The cases whose first word is among ``names``."""
    return [case for case in cases if case.name.split()[0] in names]


def _layer(row: dict[str, str], number: int) -> Layer:
    def value(column: str, default: float = 0.0) -> float:
        return float(row[column]) if row[column] else default

    n = str(number)
    return Layer(
        sigma=value("sigma" + n),
        alpha=value("alpha" + n),
        beta=value("beta" + n, 1.0),
        g1=value(f"g{n}a"),
        g2=value(f"g{n}b"),
        thickness_mm=value("d" + n),
    )


def rows_of(file: str) -> list[dict[str, str]]:
    """Read the rows of a reference table."""
    with shared_path(f"reference/{file}").open(newline="") as stream:
        return list(csv.DictReader(stream))
