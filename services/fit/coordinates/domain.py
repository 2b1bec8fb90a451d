"""The unbounded domain in which parameters are fitted, and its chain-rule factors (teeth 2018 Eq. 22, 24; signs as in
optics.md).

===========  =====================  =======================  ==========================
parameter    natural                d natural / d x          kept inside
===========  =====================  =======================  ==========================
sigma        exp(x), per mm         sigma                    1e-3 to 1e3 per mm
alpha        1 - 10^-x              10^-x ln 10              1 - alpha from 1e-7 to 0.9
g1, g2       tanh x                 sech^2 x                 abs(g) < 0.9991
cosine       tanh x                 sech^2 x                 -0.50 to 0.97
beta         logistic x             beta (1 - beta)          6e-4 to 1 - 6e-4
reflectance  as beta                as beta                  as beta
shape        x                      1                        0 to 1, projected
===========  =====================  =======================  ==========================

The bounds only keep a wild step representable in float32; a fit that ends on one is reported as undetermined.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from services.core.errors import SettingsError
from services.fit.coordinates.instrument_errors import NO_ERRORS, InstrumentErrors
from services.transport.optics.parameters import MEDIUM_FIELDS, Medium, Mouth, Optics, Tissue

LN10 = math.log(10.0)

BOUNDS = {
    "sigma": (math.log(1e-3), math.log(1e3)),
    "alpha": (-math.log10(0.9), 7.0),
    "g1": (-3.85, 3.85),
    "cosine": (-0.55, 2.1),
    "g2": (-3.85, 3.85),
    "beta": (-7.4, 7.4),
    "reflectance": (-7.4, 7.4),
    "shape": (0.0, 1.0),
}
"""Lower and upper bound of the coordinate x of each kind of parameter."""
HELD_G = 0.8
"""Mean cosine of the similar medium whose sigma and alpha are coordinates where the mean cosine is a coordinate too;
elsewhere the mean cosine of a single lobe."""
STEP_SCALE = {
    "sigma": math.log(2.0),
    "alpha": 0.4,
    "g1": 0.35,
    "cosine": 0.35,
    "g2": 0.35,
    "beta": 1.0,
    "reflectance": 1.0,
    "shape": 0.25,
}
"""Length over which the image is roughly linear in each coordinate; a trust radius of 1 is one such length."""
UNITS = {
    "sigma": "1/mm",
    "alpha": "1",
    "g1": "1",
    "cosine": "1",
    "g2": "1",
    "beta": "1",
    "reflectance": "1",
    "shape": "1",
}
LOGISTIC = frozenset({"beta", "reflectance"})


def kind_of(name: str) -> str:
    """The kind of a parameter: the key into BOUNDS for ``enamel.sigma`` or ``3.enamel.sigma`` is ``sigma``, for
    ``shape.0`` it is ``shape``.

    Raises:
        SettingsError: a fit cannot change a parameter of this name.
    """
    part, _, leaf = name.rpartition(".")
    kind = "shape" if part.rpartition(".")[2] == "shape" else leaf
    if kind not in BOUNDS:
        raise SettingsError(f"Parameter {name} is not one a fit can change; choose from {', '.join(BOUNDS)}.")
    return kind


def to_dual(kind: str, value: float) -> float:
    """Coordinate x of a natural value, clipped to the bounds of its kind."""
    low, high = BOUNDS[kind]
    tiny = 1e-300
    if kind == "sigma":
        x = math.log(max(value, tiny))
    elif kind == "alpha":
        x = -math.log10(max(1.0 - value, tiny))
    elif kind in {"g1", "g2", "cosine"}:
        x = math.copysign(high, value) if abs(value) >= 1.0 else math.atanh(value)
    elif kind in LOGISTIC:
        x = math.log(max(value, tiny)) - math.log(max(1.0 - value, tiny))
    else:
        x = value
    return min(max(x, low), high)


def to_natural(kind: str, x: float) -> float:
    """Natural value of a coordinate; ``alpha`` uses expm1 and ``beta`` branches on the sign, so that nothing cancels or
    overflows.
    """
    if kind == "sigma":
        return math.exp(x)
    if kind == "alpha":
        return -math.expm1(-x * LN10)
    if kind in {"g1", "g2", "cosine"}:
        return math.tanh(x)
    if kind in LOGISTIC:
        return 1.0 / (1.0 + math.exp(-x)) if x >= 0 else math.exp(x) / (1.0 + math.exp(x))
    return x


def natural_derivative(kind: str, x: float) -> float:
    """Derivative of the natural value to x; 1 - g^2 as sech^2 x, never as 1 - tanh^2 x."""
    if kind == "sigma":
        return math.exp(x)
    if kind == "alpha":
        return LN10 * math.exp(-x * LN10)
    if kind in {"g1", "g2", "cosine"}:
        return 1.0 / math.cosh(x) ** 2
    if kind in LOGISTIC:
        decay = math.exp(-abs(x))
        return decay / (1.0 + decay) ** 2
    return 1.0


@dataclass(frozen=True)
class Coordinate:
    """One unbounded coordinate and the parameters that share its value: one parameter, or the same one of both
    media.
    """

    targets: tuple[str, ...]
    prior_mean: float | None = None
    """Centre of a Gaussian prior in this domain; None for a flat prior."""
    prior_sd: float = math.inf
    """Standard deviation of that prior."""

    @property
    def name(self) -> str:
        """Name of the coordinate: ``enamel.sigma``, or ``tooth.sigma`` where both media share it."""
        return self.targets[0] if len(self.targets) == 1 else f"tooth.{self.kind}"

    @property
    def kind(self) -> str:
        """Key into the tables of this module."""
        return kind_of(self.targets[0])

    @property
    def tooth(self) -> int | None:
        """Position in the jaw of the one tooth to which the coordinate belongs; None for any other coordinate."""
        owners = {target.partition(".")[0] for target in self.targets}
        return int(owner) if len(owners) == 1 and (owner := owners.pop()).isdigit() else None


@dataclass(frozen=True)
class Domain:
    """The coordinates of one fit; parameters that they do not name stay as in the tissue to which they are applied.

    A vector x (F,) holds the tissue's coordinates, then the instrument's errors.
    """

    coordinates: tuple[Coordinate, ...]
    """Coordinates of the tissue."""
    errors: InstrumentErrors = NO_ERRORS

    @property
    def names(self) -> tuple[str, ...]:
        """Coordinate names, the order of every vector x."""
        return tuple(c.name for c in self.coordinates) + self.errors.names

    @property
    def tissue_count(self) -> int:
        """Number of the tissue's coordinates."""
        return len(self.coordinates)

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the natural parameters, in the order in which the engine returns derivatives."""
        return tuple(target for c in self.coordinates for target in c.targets)

    @property
    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lower and upper bounds of x, both (F,)."""
        low, high = zip(*(BOUNDS[c.kind] for c in self.coordinates), *self.errors.bounds, strict=True)
        return np.array(low), np.array(high)

    @property
    def scale(self) -> NDArray[np.float64]:
        """Step scale of x, (F,)."""
        return np.array([STEP_SCALE[c.kind] for c in self.coordinates] + self.errors.scale.tolist())

    @property
    def prior(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Prior mean and precision 1/sd^2 of the coordinates, both (F,); precision 0 where the prior is flat, and for
        the instrument's errors, whose precision is a matrix.
        """
        none = [0.0] * len(self.errors.names)
        mean = np.array([0.0 if c.prior_mean is None else c.prior_mean for c in self.coordinates] + none)
        precision = np.array([0.0 if c.prior_mean is None else 1.0 / c.prior_sd**2 for c in self.coordinates] + none)
        return mean, precision

    @property
    def precision(self) -> NDArray[np.float64]:
        """Precision of the prior of all of x, (F, F), as a fit weighs it."""
        matrix = np.diag(self.prior[1])
        matrix[self.tissue_count :, self.tissue_count :] = self.errors.weight * self.errors.precision
        return matrix

    @property
    def prior_noise(self) -> NDArray[np.float64]:
        """Covariance (F, F) of the prior's part of the gradient by the error of the prior's mean."""
        matrix = self.precision
        matrix[self.tissue_count :, self.tissue_count :] *= self.errors.weight
        return matrix

    def prior_slope(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Slope of 1/2 (x - mean)' precision (x - mean) at x, (F,)."""
        mean, precision = self.prior
        slope = precision * (x - mean)
        slope[self.tissue_count :] = self.errors.weight * self.errors.precision @ x[self.tissue_count :]
        return slope

    def prior_change(self, x_old: NDArray[np.float64], x_new: NDArray[np.float64]) -> float:
        """Change of 1/2 (x - mean)' precision (x - mean) from one x to another."""
        mean, precision = self.prior
        change = 0.5 * float(precision @ ((x_new - mean) ** 2 - (x_old - mean) ** 2))
        if self.errors.names:
            old, new = x_old[self.tissue_count :], x_new[self.tissue_count :]
            change += 0.5 * self.errors.weight * float((new + old) @ self.errors.precision @ (new - old))
        return change

    def errors_at(self, x: NDArray[np.float64]) -> tuple[tuple[str, float], ...]:
        """The instrument's errors in x, by name."""
        return tuple(zip(self.errors.names, x[self.tissue_count :].tolist(), strict=True))

    @property
    def relation(self) -> NDArray[np.int_]:
        """Relation of every two coordinates, (F, F): 0 for two of one tooth, 1 where one belongs to gums, wall or all
        teeth, 2 for two of different teeth. All are 0 for a tooth alone.

        The instrument's errors add 3 (row of the tissue, column of an error), 4 (row of an error, column of the tissue)
        and 5 (both of errors).
        """
        tooth = np.array([-1 if c.tooth is None else c.tooth for c in self.coordinates])
        shared = (tooth < 0)[:, None] | (tooth < 0)
        alone = bool((tooth < 0).all())
        of_tissue = (
            np.zeros(shared.shape, int) if alone else np.where(shared, 1, np.where(tooth[:, None] == tooth, 0, 2))
        )
        errors = len(self.errors.names)
        across = np.full((len(tooth), errors), 3)
        return np.block([[of_tissue, across], [across.T + 1, np.full((errors, errors), 5)]])

    @property
    def cosines(self) -> tuple[str, ...]:
        """Parts whose mean cosine is a coordinate.

        Their sigma and alpha are coordinates of the similar medium at ``HELD_G``, so that the cosine changes neither
        reduced scattering nor absorption.
        """
        return tuple(target.rpartition(".")[0] for c in self.coordinates if c.kind == "cosine" for target in c.targets)

    def x_of(self, tissue: Optics, errors: Mapping[str, float] = MappingProxyType({})) -> NDArray[np.float64]:
        """Coordinates (F,) of a tissue; a shared coordinate takes its first parameter's value, an error that is not
        given is 0.
        """
        at_held_cosines = _at_cosines(tissue, dict.fromkeys(self.cosines, HELD_G))

        def value(name: str) -> float:
            part, _, leaf = name.rpartition(".")
            return tissue.medium(part).mean_cosine if leaf == "cosine" else at_held_cosines.value(name)

        own = [to_dual(c.kind, value(c.targets[0])) for c in self.coordinates]
        return np.array(own + [errors.get(name, 0.0) for name in self.errors.names])

    def tissue_at(self, x: Sequence[float] | NDArray[np.float64], base: Optics) -> Optics:
        """``base`` with this domain's parameters at x."""
        values = {
            target: to_natural(c.kind, float(v))
            for c, v in zip(self.coordinates, x[: self.tissue_count], strict=True)
            for target in c.targets
        }
        cosines = {part: values.pop(f"{part}.cosine") for part in self.cosines}
        return _at_cosines(_at_cosines(base, dict.fromkeys(cosines, HELD_G)).with_values(values), cosines)

    def chain(self, x: Sequence[float] | NDArray[np.float64]) -> NDArray[np.float64]:
        """Derivative of each parameter with respect to each of the tissue's coordinates, (P, F): it maps derivatives to
        natural parameters onto coordinates.

        Not valid for a domain with ``cosines``.
        """
        matrix = np.zeros((len(self.parameters), self.tissue_count))
        row = 0
        for column, (c, v) in enumerate(zip(self.coordinates, x[: self.tissue_count], strict=True)):
            for _ in c.targets:
                matrix[row, column] = natural_derivative(c.kind, float(v))
                row += 1
        return matrix


def similar_medium(medium: Medium, g: float) -> Medium:
    """The medium of mean cosine g with the same reduced scattering and absorption (similarity theory); bright and fast
    to render where g is low.
    """
    scattering, absorption = medium.sigma_s_reduced / (1 - g), (1 - medium.alpha) * medium.sigma
    sigma = scattering + absorption
    return Medium(sigma, scattering / sigma, g1=g)


def _at_cosines(tissue: Optics, cosines: Mapping[str, float]) -> Optics:
    # Replace the media of some parts by similar ones of the given mean cosines.
    for part, cosine in cosines.items():
        medium = similar_medium(tissue.medium(part), cosine)
        tissue = tissue.with_values({f"{part}.{leaf}": getattr(medium, leaf) for leaf in MEDIUM_FIELDS})
    return tissue


def similar_tissue(tissue: Optics, g: float) -> Optics:
    """The tissue with all media replaced by similar ones of mean cosine g; shapes, stains and the wall's reflectance
    stay.
    """
    gums = None if tissue.gums is None else similar_medium(tissue.gums, g)
    if isinstance(tissue, Tissue):
        enamel, dentin = similar_medium(tissue.enamel, g), similar_medium(tissue.dentin, g)
        return replace(tissue, enamel=enamel, dentin=dentin, gums=gums)
    return Mouth(tuple(similar_tissue(tooth, g) for tooth in tissue.teeth), gums, tissue.reflectance)
