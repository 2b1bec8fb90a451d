"""Random parameter sets from the extremes of the parameters of media and slabs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.transport.optics.parameters import Medium

SIGMA = (1e-4, 1e4)
"""Range of extinction, per mm."""
MIN_ABSORBED = 1e-7
"""Smallest 1 - alpha other than 0."""
NARROWEST = 1e-4
"""Smallest 1 - |g|."""
WIDTH_MM = (1e-3, 10.0)
"""Range of a layer's thickness."""
IOR = (1.0, 4.0)
"""Range of the index of refraction."""
MATCHED, THIN, SMOOTH = 0, 1, 2
"""Codes of the boundary models."""

REGIONS = (
    "anywhere",
    "alpha near 1",
    "alpha near 0",
    "g near 1",
    "g near 0",
    "unequal lobes",
    "thin layer",
    "clear",
    "opaque",
    "faces",
    "all at an end",
)


@dataclass(frozen=True)
class Corners:
    """N parameter sets of slabs with two layers. Arrays of both layers are (2, N), all others (N,)."""

    region: NDArray[np.int64]
    """Index into REGIONS."""
    sigma: NDArray[np.float64]
    absorbed: NDArray[np.float64]
    """1 - alpha."""
    beta: NDArray[np.float64]
    g1: NDArray[np.float64]
    g2: NDArray[np.float64]
    width_mm: NDArray[np.float64]
    boundary: NDArray[np.int64]
    """Boundary model: MATCHED, THIN or SMOOTH."""
    ior: NDArray[np.float64]
    diffuse: NDArray[np.bool_]
    """True for diffuse incident light, False for light at normal incidence."""

    def __len__(self) -> int:
        return len(self.region)

    def media(self) -> list[list[Medium]]:
        """Return the media of the first and of the second layer, one per set."""
        fields = (self.sigma, 1 - self.absorbed, self.beta, self.g1, self.g2)
        return [
            [Medium(*values) for values in zip(*(field[k].tolist() for field in fields), strict=True)] for k in range(2)
        ]


def draw(count: int, seed: int) -> Corners:
    """Draw ``count`` sets, the regions in rotation; parameters that a region does not make extreme lie anywhere in
    their whole range.
    """
    rng = np.random.default_rng(seed)
    region = np.arange(count) % len(REGIONS)
    pair = (2, count)

    def decades(low: float, high: float) -> NDArray[np.float64]:
        return np.exp(rng.uniform(np.log(low), np.log(high), pair))

    def one_of(*values: float) -> NDArray[np.float64]:
        return rng.choice(values, pair)

    def within(name: str) -> NDArray[np.bool_]:
        return np.asarray(region == REGIONS.index(name))

    def pick(choices: dict[str, NDArray[np.float64]], otherwise: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.select([within(name) for name in choices], list(choices.values()), otherwise)

    narrow, weak = one_of(-1, 1) * (1 - decades(NARROWEST, 1e-2)), one_of(-1, 1) * decades(1e-8, 1e-2)
    g_end = one_of(0, 1 - NARROWEST, NARROWEST - 1)
    free = [one_of(-1, 1) * (1 - decades(NARROWEST, 1.0)) for _ in range(2)]
    boundary = np.where(
        within("faces"), rng.integers(THIN, SMOOTH + 1, count), rng.integers(MATCHED, SMOOTH + 1, count)
    )
    nearly_one = 1 + decades(1e-4, IOR[1] - 1)[0]
    ior = np.select(
        [boundary == MATCHED, within("all at an end"), within("faces")],
        [1.0, rng.choice([1.0001, 4.0], count), nearly_one],
        rng.uniform(1.3, 1.7, count),
    )
    return Corners(
        region=region,
        sigma=pick(
            {"clear": decades(SIGMA[0], 1e-2), "opaque": decades(1e2, SIGMA[1]), "all at an end": one_of(*SIGMA)},
            decades(*SIGMA),
        ),
        absorbed=pick(
            {
                "alpha near 1": np.where(rng.random(count) < 0.3, 0.0, decades(MIN_ABSORBED, 1e-4)),
                "alpha near 0": 1 - np.where(rng.random(count) < 0.3, 0.0, decades(1e-7, 1e-2)),
                "all at an end": one_of(0, MIN_ABSORBED, 1),
            },
            decades(MIN_ABSORBED, 1.0),
        ),
        beta=pick(
            {"unequal lobes": np.abs(one_of(0, 1) - decades(1e-7, 1e-2)), "all at an end": one_of(0, 1, 1e-7)},
            rng.random(pair),
        ),
        g1=pick(
            {"g near 1": narrow, "g near 0": weak, "unequal lobes": np.abs(narrow), "all at an end": g_end}, free[0]
        ),
        g2=pick(
            {"g near 1": -narrow, "g near 0": -weak, "unequal lobes": -np.abs(narrow), "all at an end": -g_end}, free[1]
        ),
        width_mm=pick(
            {"thin layer": decades(WIDTH_MM[0], 1e-2), "all at an end": one_of(*WIDTH_MM)}, decades(*WIDTH_MM)
        ),
        boundary=boundary,
        ior=ior,
        diffuse=rng.random(count) < 0.5,
    )
