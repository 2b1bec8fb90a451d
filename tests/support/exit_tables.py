"""Reference tables of the light that leaves a slab by direction and by position, and of the half space. Each becomes a
layer to simulate with its expected values.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.slab.simulate import Layer, Sums, accumulate
from tests.support.slab_tables import rows_of
from tests.support.z_scores import z_scores

UNKNOWN = math.nan


@dataclass(frozen=True)
class ExitCase:
    """Reference values that one simulation gives.

    ``values``, ``tolerance`` and ``reference_error`` have the rows of ``Sums`` and the columns R (reflected) and T
    (transmitted); NaN where a table has no value.
    """

    name: str
    layer: Layer
    options: dict[str, Any]
    """Keyword arguments of ``accumulate``."""
    values: NDArray[np.float64]
    tolerance: NDArray[np.float64]
    reference_error: NDArray[np.float64] | float = 0.0
    """Standard errors of the table itself."""

    def simulate(self, seed: int) -> Sums:
        """Trace until every standard error is at most a third of its tolerance."""
        known = ~np.isnan(self.values)

        def shortfall(sums: Sums) -> float:
            return float((3 * sums.standard_error() / self.tolerance)[known].max())

        sums = accumulate((self.layer,), shortfall, seed=seed, **self.options)[1]
        assert shortfall(sums) <= 1, self.name
        return sums

    def scores(self, sums: Sums) -> NDArray[np.float64]:
        """z-score of every value of the table; the error is that of the simulation and of the table together."""
        known = ~np.isnan(self.values)
        error = np.hypot(sums.standard_error(), self.reference_error)
        return z_scores(sums.mean()[known], self.values[known], error[known])


def angular_cases(relative_tolerance: float) -> list[ExitCase]:
    """Read ``angular_slab.csv``: pi times the radiance that leaves at a cosine. One case per medium and cosine of
    incidence.
    """
    groups: dict[tuple[str, ...], list[dict[str, str]]] = {}
    for row in rows_of("angular_slab.csv"):
        groups.setdefault(tuple(row[key] for key in ("a", "g", "tau", "mu_incident")), []).append(row)
    cases = []
    for (a, g, tau, mu), rows in groups.items():
        cosines = tuple(sorted({float(row["mu_exit"]) for row in rows}))
        values = np.full((1 + len(cosines), 2), UNKNOWN)
        for row in rows:
            values[1 + cosines.index(float(row["mu_exit"])), "RT".index(row["side"])] = (
                float(row["pi_L_recomputed"]) / math.pi
            )
        layer = Layer(sigma=1, alpha=float(a), g1=float(g), thickness_mm=float(tau))
        options = {"mu_incident": float(mu), "exit_cosines": cosines}
        cases.append(ExitCase(f"a={a} g={g} tau={tau} mu={mu}", layer, options, values, relative_tolerance * values))
    return cases


def half_space_cases(tolerance: float, relative_tolerance: float, *albedos: str) -> list[ExitCase]:
    """Read ``hfunction.csv``: reflected shares of an isotropic half space by single-scattering albedo a, and H(1),
    compared by the radiance a H(1)^2 / (8 pi) that leaves along the normal under normal incidence.

    Args:
        tolerance: of reflected shares, absolute.
        relative_tolerance: of the radiance.
        albedos: rows of the table, as text.
    """
    cases = []
    for row in rows_of("hfunction.csv"):
        if row["a"] not in albedos:
            continue
        a, layer = float(row["a"]), Layer(sigma=1, alpha=float(row["a"]), thickness_mm=math.inf)
        radiance = a * float(row["H_at_1"]) ** 2 / (8 * math.pi)
        for column, options, further in (
            ("R_mu0_1", {"exit_cosines": (1.0,)}, [radiance]),
            ("R_mu0_0.5", {"mu_incident": 0.5}, []),
            ("R_spherical", {"source": "diffuse"}, []),
        ):
            values = np.column_stack([[float(row[column]), *further], np.full(1 + len(further), UNKNOWN)])
            allowed = np.where(np.arange(len(values))[:, None] > 0, relative_tolerance * values, tolerance)
            cases.append(ExitCase(f"a={row['a']} {column}", layer, options, values, allowed))
    return cases


def ring_case(tolerance: float) -> ExitCase:
    """Read ``pencil_beam_rings.csv``: sigma 5 per mm, albedo 0.99, g 0.8, 1 mm between smooth faces of index 1.33. The
    totals in the first row come from adding-doubling.
    """
    rows = rows_of("pencil_beam_rings.csv")
    values = np.array([[0.300137, 0.554013], *([float(row["R_scattered"]), float(row["T_scattered"])] for row in rows)])
    errors = np.array([[0.0, 0.0], *([float(row["se_R"]), float(row["se_T"])] for row in rows)])
    options = {"ior": 1.33, "boundary": "smooth", "ring_edges_mm": tuple(float(row["r_outer_mm"]) for row in rows[:-1])}
    layer = Layer(sigma=5, alpha=0.99, g1=0.8, thickness_mm=1)
    return ExitCase("rings", layer, options, values, np.full_like(values, tolerance), errors)
