"""Total reflectance and transmittance of flat layers, with derivatives, to a requested error.

Runs the fit's own walk (``services.transport.paths.walk``) between planes instead of meshes; light that leaves
either face is counted instead of connected to lights.
"""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from services.core.errors import InputError, NonFiniteError
from services.core.geometry import Record
from services.transport.optics.parameters import Medium
from services.transport.optics.phase_table import PhaseTable
from services.transport.platform import prepare_device

LANES = 8192
FIRST_SAMPLES = 32
GRADIENT_ERROR = 0.003
"""Standard error of a derivative, as a fraction of its value or of ``GRADIENT_FLOOR`` of the largest beside it."""
GRADIENT_FLOOR = 1e-3
EXIT_FLOOR = 0.1
"""Standard errors of radiances and of rings are relative to the value, or to this fraction of the largest of its
kind."""
MAX_SAMPLES = 4096
MAX_PATHS = 2**37


class Layer(Record):
    """One layer; the first one is lit."""

    sigma: float = Field(description="extinction, per mm")
    alpha: float = Field(description="single-scattering albedo")
    beta: float = Field(default=1.0, description="weight of the first lobe")
    g1: float = Field(default=0.0, description="mean cosine of the first lobe")
    g2: float = Field(default=0.0, description="mean cosine of the second lobe")
    table: PhaseTable | None = Field(default=None, description="phase function in place of the lobes")
    thickness_mm: float = Field(description="thickness; the last layer may be infinite")

    model_config = Record.model_config | {"allow_inf_nan": True}


class FaceValues(Record):
    """Values of scattered light that leaves the lit face (R) and the far face (T), one per exit cosine or per ring,
    with standard errors.
    """

    R: tuple[float, ...]
    T: tuple[float, ...]
    R_se: tuple[float, ...]
    T_se: tuple[float, ...]


class SlabResult(Record):
    """Totals per incident flux. R includes the specular reflection of the lit face, T the unscattered beam."""

    R: float
    T: float
    R_se: float
    T_se: float
    dR: dict[str, float] = Field(default_factory=dict)
    dT: dict[str, float] = Field(default_factory=dict)
    dR_se: dict[str, float] = Field(default_factory=dict)
    dT_se: dict[str, float] = Field(default_factory=dict)
    radiance: FaceValues | None = Field(
        default=None, description="azimuthal mean at each exit cosine, per sr and incident irradiance"
    )
    rings: FaceValues | None = Field(
        default=None, description="share of the incident flux that leaves within each ring, the last one unbounded"
    )
    paths: int = Field(description="number of walks")
    complete: bool = Field(description="whether every standard error asked for was reached before the time ran out")

    def as_json(self) -> dict[str, Any]:
        """Plain values for printing."""
        return self.model_dump()


@dataclass
class Sums:
    """Float64 sums over lanes; rows are the totals, then each derivative, each exit cosine and each ring, columns R and
    T.
    """

    rows: int
    specular: float
    """Share of the incident flux that the lit face reflects, known exactly."""
    first: NDArray[np.float64] = field(init=False)
    second: NDArray[np.float64] = field(init=False)
    lanes: int = 0
    samples: int = 0
    passes: int = 0

    def __post_init__(self) -> None:
        self.first, self.second = np.zeros((self.rows, 2)), np.zeros((self.rows, 2))

    def add(self, table: NDArray[np.float64], samples: int) -> None:
        """Add a pass: sums (lanes, rows, 2) over ``samples`` paths per lane.

        Raises:
            NonFiniteError: a sum is NaN or infinite.
        """
        if not np.isfinite(table).all():
            raise NonFiniteError(
                f"{np.count_nonzero(~np.isfinite(table))} of {table.size} slab sums are not finite; report the"
                " parameters."
            )
        self.first += table.sum(axis=0)
        self.second += (table**2).sum(axis=0) / samples
        self.lanes += len(table)
        self.samples += len(table) * samples
        self.passes += 1

    def mean(self) -> NDArray[np.float64]:
        """Means of all rows per incident flux (rows, 2), the specular reflection included."""
        mean = self.first / self.samples
        mean[0, 0] += self.specular
        return mean

    def standard_error(self) -> NDArray[np.float64]:
        """Standard errors (rows, 2) from the spread between lanes."""
        spread = np.maximum(self.second - self.first**2 / self.samples, 0) / max(self.lanes - 1, 1)
        return np.sqrt(spread / self.samples)


def simulate_slab(
    layers: tuple[Layer, ...],
    *,
    ior: float = 1.0,
    boundary: Literal["matched", "thin", "smooth"] = "matched",
    source: Literal["normal", "diffuse"] = "normal",
    mu_incident: float = 1.0,
    exit_cosines: tuple[float, ...] = (),
    ring_edges_mm: tuple[float, ...] = (),
    rel_error: float = 1e-3,
    gradient: bool = False,
    seed: int = 1,
    max_seconds: float = 600.0,
    numbered: bool = False,
) -> SlabResult:
    """Simulate until max(R_se / R, T_se / max(T, 1e-3)) <= ``rel_error`` and, with ``gradient``, every derivative is as
    accurate as described below.

    Derivative names: ``sigma`` (per mm, at fixed albedo), ``alpha``, ``g`` for one single-lobe layer; ``sigma1, alpha1,
    beta1, g1a, g1b, sigma2, ..., c`` for layers or where ``numbered``, c the depth of the first inner border at fixed
    total depth. A derivative's standard error is held to 0.3 % of its value or of 1e-3 of the largest derivative of the
    same source, whichever is larger; that of a radiance or ring to ``rel_error`` of its value or of a tenth of the
    largest. After ``max_seconds`` the result is returned as it is, with ``complete`` false and its true standard
    errors.

    Args:
        layers: the first one is lit.
        mu_incident: cosine to the normal of the collimated beam of source ``normal``.
        exit_cosines: cosines to the normal, in air, at which the radiance that leaves each face is computed; scattered
            light only.
        ring_edges_mm: radii about the point of entry; the light that leaves between each two of them, and beyond the
            last, is computed; scattered light only.

    Raises:
        InputError: a parameter is outside its range.
        PlatformError: no usable libLLVM.
        NonFiniteError: a total is not finite.
    """
    ring_count = len(ring_edges_mm) + 1 if ring_edges_mm else 0

    def parts(table: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        """Split rows into totals, derivatives, radiances and rings."""
        rows = len(table)
        return np.split(table, [1, rows - ring_count - len(exit_cosines), rows - ring_count])

    def shortfall(sums: Sums) -> float:
        mean, error = parts(sums.mean()), parts(sums.standard_error())
        (R, T), (R_se, T_se) = mean[0][0], error[0][0]
        worst = max(R_se / (max(R, 1e-30) * rel_error), T_se / (max(T, 1e-3) * rel_error))
        rules = ((GRADIENT_ERROR, GRADIENT_FLOOR), (rel_error, EXIT_FLOOR), (rel_error, EXIT_FLOOR))
        for values, errors, (limit, floor) in zip(mean[1:], error[1:], rules, strict=True):
            sizes = np.abs(values)
            allowed = limit * np.maximum(sizes, floor * sizes.max(initial=0))
            worst = max(worst, np.max(errors / np.maximum(allowed, 1e-30), initial=0))
        return float(worst)

    if not 0 < rel_error < 1:
        raise InputError(f"rel-error = {rel_error:g} must lie between 0 and 1; 1e-3 is usual.")
    names, sums = accumulate(
        layers, shortfall, ior=ior, boundary=boundary, source=source, mu_incident=mu_incident,
        exit_cosines=exit_cosines, ring_edges_mm=ring_edges_mm, gradient=gradient, seed=seed, max_seconds=max_seconds,
    )  # fmt: skip
    if numbered:
        names = tuple({"sigma": "sigma1", "alpha": "alpha1", "g": "g1a"}.get(name, name) for name in names)
    totals, derivatives, radiances, rings = (
        np.hstack(pair) for pair in zip(parts(sums.mean()), parts(sums.standard_error()), strict=True)
    )
    dR, dT, dR_se, dT_se = (dict(zip(names, column.tolist(), strict=True)) for column in derivatives.T)
    R, T, R_se, T_se = totals[0].tolist()
    return SlabResult(
        R=R, T=T, R_se=R_se, T_se=T_se, dR=dR, dT=dT, dR_se=dR_se, dT_se=dT_se,
        radiance=_face_values(radiances), rings=_face_values(rings), paths=sums.samples, complete=shortfall(sums) <= 1,
    )  # fmt: skip


def _face_values(rows: NDArray[np.float64]) -> FaceValues | None:
    """Values from rows of R, T and their standard errors; None where there is no row."""
    R, T, R_se, T_se = (tuple(column.tolist()) for column in rows.T)
    return FaceValues(R=R, T=T, R_se=R_se, T_se=T_se) if R else None


def accumulate(
    layers: tuple[Layer, ...],
    shortfall: Callable[[Sums], float],
    *,
    ior: float = 1.0,
    boundary: str = "matched",
    source: str = "normal",
    mu_incident: float = 1.0,
    exit_cosines: tuple[float, ...] = (),
    ring_edges_mm: tuple[float, ...] = (),
    gradient: bool = False,
    seed: int = 1,
    max_seconds: float = math.inf,
    border_terms_only: bool = False,
) -> tuple[tuple[str, ...], Sums]:
    """Trace until ``shortfall``, the largest ratio of a standard error to its allowed value, is at most 1.

    The derivative to the border's depth c comes from the border terms, or from the extinction scores of both layers, to
    which it is equal in a slab because R and T depend on sigma_i d_i alone: dR/dc = (sigma1/d1) dR/dsigma1 -
    (sigma2/d2) dR/dsigma2. The first pass takes the less noisy of the two; ``border_terms_only`` always takes the
    border terms.

    Returns:
        Names of the derivatives, and the sums.
    """
    prepare_device()
    ior = _checked(layers, ior, boundary, source)
    _check_directions(source, mu_incident, exit_cosines, ring_edges_mm)
    from services.transport.boundary.models import slab_boundary
    from services.transport.paths.scores import Plan
    from services.transport.paths.starts import SlabStart
    from services.transport.paths.walk import Walk
    from services.transport.scene.geometry import SlabGeometry
    from services.transport.scene.media import Media, Score

    names, scores = _derivatives(layers) if gradient else ((), ())
    faces = slab_boundary(boundary, ior)
    border = gradient and len(layers) == 2
    geometry = SlabGeometry(tuple(layer.thickness_mm for layer in layers), moving_border=border)
    media = Media([_medium(layer) for layer in layers])
    plan = Plan(
        scores=tuple(Score(*score) for score in scores), shape=0 if border else None, faces=True,
        exit_cosines=exit_cosines, ring_edges_mm=ring_edges_mm,
    )  # fmt: skip
    sums = Sums(
        1 + len(scores) + border + len(exit_cosines) + plan.rings, float(specular_share(ior, source, mu_incident))
    )
    spread = np.array([_spread_of_border(layers, score) for score in scores])
    from_scores: bool | None = False if border_terms_only or not border else None
    begun_s = time.monotonic()
    samples, missing = FIRST_SAMPLES, math.inf
    while missing > 1 and sums.samples < MAX_PATHS and time.monotonic() < begun_s + max_seconds:
        start = SlabStart(
            LANES,
            _pass_seed(seed, sums.passes),
            diffuse=source == "diffuse",
            boundary=faces,
            cosine=mu_incident,
        )
        slots, slopes = Walk(geometry, media, None, start, plan, faces).run(samples).arrays()
        table = np.stack([faces[:, :2] for faces in (slots, *slopes)], axis=1)
        if from_scores is not False:
            equivalent = np.tensordot(table[:, 1:-1], spread, axes=(1, 0))
            if from_scores is None:
                from_scores = bool(equivalent.var(axis=0).max() < table[:, -1].var(axis=0).max())
            if from_scores:
                table[:, -1] = equivalent
        sums.add(np.concatenate([table, slots[:, 2:].reshape(LANES, -1, 2)], axis=1), samples)
        missing = shortfall(sums)
        # Trace as many paths as the error asks for, but no pass far beyond the time that is left.
        elapsed_s = time.monotonic() - begun_s
        affordable = sums.samples / LANES * (max_seconds - elapsed_s) / elapsed_s
        required = min(sums.samples * (missing**2 * 1.05 - 1) / LANES, affordable, 4 * samples, MAX_SAMPLES)
        samples = max(FIRST_SAMPLES, int(required))
    return (*names, "c") if border else names, sums


def _checked(layers: tuple[Layer, ...], ior: float, boundary: str, source: str) -> float:
    if boundary not in {"matched", "thin", "smooth"}:
        raise InputError(f"boundary = {boundary} is not known; choose matched, thin or smooth.")
    if source not in {"normal", "diffuse"}:
        raise InputError(f"source = {source} is not known; choose normal or diffuse.")
    if not math.isfinite(ior) or not 1 <= ior <= 4:
        raise InputError(f"ior = {ior:g} must lie in 1 to 4; enamel has 1.631.")
    if not layers:
        raise InputError("The slab has no layer; give at least one.")
    from services.transport.scene.media import require_medium

    for number, layer in enumerate(layers, 1):
        require_medium(f"layer {number}", _medium(layer))
        last = number == len(layers)
        if not layer.thickness_mm > 0 or (math.isinf(layer.thickness_mm) and not last):
            raise InputError(
                f"layer {number}.thickness_mm = {layer.thickness_mm:g} must be positive, and only the last layer may be"
                " infinite."
            )
    if math.isinf(layers[-1].thickness_mm) and layers[-1].alpha == 1 and sum(layer.alpha < 1 for layer in layers) == 0:
        raise InputError(
            "A half space without absorption never lets its light go; give alpha below 1 or a finite width."
        )
    return 1.0 if boundary == "matched" else ior


def _check_directions(
    source: str, mu_incident: float, exit_cosines: tuple[float, ...], ring_edges_mm: tuple[float, ...]
) -> None:
    if not 0 < mu_incident <= 1:
        raise InputError(
            f"mu-incident = {mu_incident:g} must lie in 0 to 1, 0 excluded; it is the cosine of the beam to the normal."
        )
    if source == "diffuse" and mu_incident != 1:
        raise InputError(f"mu-incident = {mu_incident:g} is for a beam; leave it out, or choose source normal.")
    for cosine in exit_cosines:
        if not 0 < cosine <= 1:
            raise InputError(f"exit-cosines has {cosine:g}; give cosines to the normal in 0 to 1, 0 excluded.")
    if not all(low < high < math.inf for low, high in pairwise((0.0, *ring_edges_mm))):
        raise InputError(
            f"ring-edges = {', '.join(f'{edge:g}' for edge in ring_edges_mm)} must be positive, finite and increasing,"
            " in mm."
        )


def _medium(layer: Layer) -> Medium:
    return Medium(layer.sigma, layer.alpha, layer.beta, layer.g1, layer.g2, layer.table)


def _derivatives(layers: tuple[Layer, ...]) -> tuple[tuple[str, ...], tuple[tuple[int, str], ...]]:
    """Names as printed, and medium number and field of each score."""
    fields = [("sigma", "alpha", *_phase_fields(layer)) for layer in layers]
    if len(layers) == 1 and layers[0].beta == 1:
        return tuple({"g1": "g"}.get(field, field) for field in fields[0]), tuple((1, field) for field in fields[0])
    pairs = []
    for number, of_layer in enumerate(fields, 1):
        printed = {"g1": f"g{number}a", "g2": f"g{number}b"}
        pairs += [(printed.get(field, f"{field}{number}"), (number, field)) for field in of_layer]
    return tuple(name for name, _ in pairs), tuple(score for _, score in pairs)


def _phase_fields(layer: Layer) -> tuple[str, ...]:
    if layer.table is not None:
        return ()
    return ("beta", "g1", "g2") if layer.beta < 1 else ("g1",)


def _spread_of_border(layers: tuple[Layer, ...], score: tuple[int, str]) -> float:
    """Coefficient of one score in the derivative to the border's depth; see ``accumulate``."""
    number, name = score
    layer = layers[number - 1]
    return (1 if number == 1 else -1) * layer.sigma / layer.thickness_mm if name == "sigma" else 0.0


def specular_share(ior: ArrayLike, source: str, mu_incident: float = 1.0) -> NDArray[np.float64]:
    """Share of the incident flux that the lit face reflects, for each ``ior``; Lambertian light by Gauss-Legendre
    quadrature in float64.
    """
    eta = np.asarray(ior, dtype=np.float64)
    if source == "normal":
        return _fresnel(eta, mu_incident)
    nodes, weights = _gauss_nodes()
    cosine = 0.5 * (nodes + 1)
    return np.asarray(np.sum(weights * cosine * _fresnel(eta[..., None], cosine), axis=-1))


@functools.cache
def _gauss_nodes() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Nodes from -1 to 1 and weights of Lambertian light's quadrature."""
    return np.polynomial.legendre.leggauss(400)


def _fresnel(eta: NDArray[np.float64], cosine: NDArray[np.float64] | float) -> NDArray[np.float64]:
    """Unpolarised reflectance from air."""
    transmitted = np.sqrt(1 - (1 - np.square(cosine)) / eta**2)
    s = (cosine - eta * transmitted) / (cosine + eta * transmitted)
    p = (eta * cosine - transmitted) / (eta * cosine + transmitted)
    return 0.5 * (s**2 + p**2)


def _pass_seed(seed: int, number: int) -> int:
    return int(np.random.SeedSequence([seed, number]).generate_state(1)[0])
