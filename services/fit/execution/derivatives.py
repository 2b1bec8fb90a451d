"""How a stage's images are differentiated: by scores of the same walks, or as differences of images of changed media.

A difference costs two images for each coordinate, which a jaw has by the hundred. But a tooth changes what is seen of
itself and of its neighbours, and hardly anything beyond: so the same coordinate of every third tooth is moved at once,
and each one's derivative is read where its own tooth is the nearest of those moved (a sparse Jacobian by groups of
columns: Curtis, Powell and Reid 1974).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from services.fit.execution.blocks import BlockTask, PixelParts
from services.fit.execution.engine_host import EngineHost
from services.fit.jaw.neighbours import Neighbours
from services.fit.optics.domain import Domain, kind_of, natural_derivative, similar_tissue, to_natural
from services.fit.optics.parameters import Mouth, Optics, Tissue
from services.fit.transport.scene.recipe import JacobianEstimate, View

Array = NDArray[np.float64]

WITHOUT_SCORES = frozenset({"shape", "cosine"})
"""Kinds of coordinates whose derivatives are always differences."""
SCORES_SHARE = 4
"""Scores that are left where others became differences are quiet: they get so many times fewer paths."""


@dataclass(frozen=True)
class Reach:
    """How far from a coordinate's value the images lie whose difference gives its derivative, and their share of a
    task's paths, one part in so many.
    """

    below: float
    above: float
    share: int


REACH: Mapping[str, Reach] = MappingProxyType(
    {"shape": Reach(0.2, 0.2, 1), "sigma": Reach(0.7, 0.7, 4), "cosine": Reach(1.0, 0.0, 8)}
)
"""By kind of coordinate. The wider, the quieter, in proportion; the zero of J'Wr, and so the answer, hardly minds that
a wide difference is no derivative."""

SLOPE_REACH = Reach(0.35, 0.35, 4)
"""Of a cosine in the closing measurement, where the derivative itself is wanted."""


@dataclass(frozen=True)
class Secant:
    """The derivatives to one coordinate, or to several of teeth that stand apart, as a difference of two images:
    quieter than border terms or scores.
    """

    coordinates: tuple[int, ...]
    low: Tissue | Mouth
    high: Tissue | Mouth
    widths: tuple[float, ...]
    """Of each coordinate, between both ends."""
    share: int
    teeth: tuple[int, ...] | None = None
    """In whose pixels, and their neighbours', each coordinate's derivative is read; None where there is one coordinate,
    for all pixels."""


@dataclass(frozen=True)
class Differentiation:
    """How a stage's images are differentiated: scores of some natural parameters, mapped to the coordinates, and
    secants.
    """

    parameters: tuple[str, ...]
    chain: Array
    """d parameter / d x, (P, F)."""
    secants: tuple[Secant, ...] = ()
    share: int = 1
    """Of the task's paths that scores get, one part in so many."""
    neighbours: Neighbours | None = None
    """Of a jaw's teeth."""
    errors: tuple[str, ...] = ()
    """The instrument's errors: derivatives that follow these and are not rendered, see ``instrument.columns``."""

    def render(
        self, host: EngineHost, task: BlockTask, view: View, seeds: Sequence[int], parts: PixelParts | None = None
    ) -> tuple[Array, ...]:
        """Derivatives (F, L N) to the tissue's coordinates by each of the seeds; scores are of the task's media.

        All seeds see a surface before it is moved again.

        Args:
            parts: what the view's pixels show, of a jaw.
        """
        images: dict[tuple[int, int], list[Array]] = {}

        def rendered(tissue: Tissue | Mouth, samples: int) -> list[Array]:
            # What several secants share is rendered once; (L, N) by seed.
            key = id(tissue), samples
            if key not in images:
                stacks = [host.call("images", task.recipe, tissue, view, samples=samples, seed=seed) for seed in seeds]
                images[key] = [np.asarray(stack.mean, dtype=np.float64) for stack in stacks]
            return images[key]

        slopes: list[dict[int, Array]] = [{} for _ in seeds]
        for secant in self.secants:
            samples = max(task.samples // secant.share, 1)
            for found, low, high in zip(
                slopes, rendered(secant.low, samples), rendered(secant.high, samples), strict=True
            ):
                for coordinate, width, seen in zip(
                    secant.coordinates, secant.widths, self._seen(secant, parts), strict=True
                ):
                    found[coordinate] = ((high - low) * seen / width).reshape(-1)

        every = []
        for seed, found in zip(seeds, slopes, strict=True):
            if self.parameters:
                samples = max(task.samples // self.share, 1)
                estimate: JacobianEstimate = host.call(
                    "jacobian", task.recipe, task.tissue, view, self.parameters, samples=samples, seed=seed
                )
                rows = np.asarray(
                    self.chain.T @ np.asarray(estimate.jacobian, dtype=np.float64).reshape(len(self.parameters), -1)
                )
            else:
                rows = np.zeros((self.chain.shape[1], next(iter(found.values())).size))
            for coordinate, slope in found.items():
                rows[coordinate] = slope
            every.append(rows)
        return tuple(every)

    def _seen(self, secant: Secant, parts: PixelParts | None) -> Sequence[NDArray[np.bool_] | float]:
        # By coordinate, the pixels (N,) in which it is read.
        if secant.teeth is None:
            return [1.0]
        assert self.neighbours is not None
        assert parts is not None
        return [self.neighbours.pixels(tooth, parts) for tooth in secant.teeth]


def differentiation(
    domain: Domain, x: Array, base: Optics, jacobian_g: float | None, neighbours: Neighbours | None = None
) -> Differentiation:
    """How to differentiate a stage's images at x (F,).

    Args:
        jacobian_g: mean cosine of the similar media in which it is done; None for the images' own.
        neighbours: of a jaw's teeth.
    """
    x, tissue = x[: domain.tissue_count], domain.tissue_at(x, base)
    # Scores of extinction are noisy, but in a jaw they are of all teeth at once; and the images' own media are the
    # closing measurement's, which wants slopes.
    differing = WITHOUT_SCORES if jacobian_g is None or isinstance(base, Mouth) else WITHOUT_SCORES | {"sigma"}
    is_secant = [c.kind in differing for c in domain.coordinates]
    own = tuple(
        target for c, differs in zip(domain.coordinates, is_secant, strict=True) if not differs for target in c.targets
    )
    names = own if jacobian_g is None else tuple(dict.fromkeys(n for p in own for n in _similar_parameters(p)))
    groups = _groups(domain, np.flatnonzero(is_secant), neighbours)
    secants = [
        _secant(domain, x, group, base, tissue, jacobian_g, REACH[domain.coordinates[group[0]].kind])
        for group in groups
    ]
    share = SCORES_SHARE if any(domain.coordinates[one.coordinates[0]].kind == "sigma" for one in secants) else 1
    chain = _chain(domain, x, base, names, jacobian_g)
    return Differentiation(names, chain, tuple(secants), share, neighbours, domain.errors.names)


def slopes(domain: Domain, x: Array, base: Optics, neighbours: Neighbours | None = None) -> Differentiation:
    """How to differentiate the images' own media at x (F,), except to blend weights."""
    x = x[: domain.tissue_count]
    tissue, cosines = domain.tissue_at(x, base), [k for k, c in enumerate(domain.coordinates) if c.kind == "cosine"]
    scored = _scored_parameters(domain)
    secants = tuple(
        _secant(domain, x, group, base, tissue, None, SLOPE_REACH) for group in _groups(domain, cosines, neighbours)
    )
    chain = _chain(domain, x, base, scored, None)
    return Differentiation(scored, chain, secants, neighbours=neighbours, errors=domain.errors.names)


def _scored_parameters(domain: Domain) -> tuple[str, ...]:
    # Those whose derivatives can be scores.
    return tuple(name for name in domain.parameters if kind_of(name) not in WITHOUT_SCORES)


def _chain(domain: Domain, x: Array, base: Optics, names: tuple[str, ...], g: float | None) -> Array:
    # Derivatives (P, F) of natural parameters to x, those of similar media of mean cosine g where it is given.
    if g is None and not domain.cosines:
        return domain.chain(x)[[domain.parameters.index(name) for name in names]]

    # The map is smooth and closed, so central differences of it are exact to rounding.
    def values(at: Array) -> Array:
        tissue = domain.tissue_at(at, base)
        seen = tissue if g is None else similar_tissue(tissue, g)
        return np.array([seen.value(name) for name in names])

    shifts = 1e-5 * np.eye(len(x))
    return np.stack([(values(x + s) - values(x - s)) / 2e-5 for s in shifts], axis=1)


def _similar_parameters(name: str) -> tuple[str, ...]:
    part, _, leaf = name.rpartition(".")
    return (f"{part}.sigma", f"{part}.alpha") if leaf in {"sigma", "alpha"} else (name,)


def _groups(
    domain: Domain, chosen: Sequence[int] | NDArray[np.int_], neighbours: Neighbours | None
) -> list[tuple[int, ...]]:
    # Coordinates that are moved at once: the same one of all teeth of one colour; any other alone.
    groups: dict[tuple[str, int], list[int]] = {}
    for k in chosen:
        tooth, leaf = _owner(domain, int(k))
        key = (
            (domain.coordinates[k].name, -1)
            if tooth is None or neighbours is None
            else (leaf, neighbours.colour(tooth))
        )
        groups.setdefault(key, []).append(int(k))
    return [tuple(group) for group in groups.values()]


def _owner(domain: Domain, k: int) -> tuple[int | None, str]:
    # The tooth of a jaw that a coordinate belongs to, None for any other, and the rest of its name.
    coordinate = domain.coordinates[k]
    return coordinate.tooth, coordinate.targets[0].partition(".")[2]


def _secant(
    domain: Domain,
    x: Array,
    group: tuple[int, ...],
    base: Optics,
    tissue: Optics,
    jacobian_g: float | None,
    reach: Reach,
) -> Secant:
    # One-sided where a bound is near. A cosine's media are the images' own, as it is what similar media do not have.
    own = list(group)
    kind, (lower, upper) = domain.coordinates[own[0]].kind, (bound[own] for bound in domain.bounds)
    low = np.clip(x[own] - reach.below, lower, upper)
    high = np.maximum(np.clip(x[own] + reach.above, lower, upper), low + 0.5 * (reach.below + reach.above))

    def media(ends: Array) -> Optics:
        moved = x.copy()
        moved[own] = ends
        there = tissue if np.array_equal(moved, x) else domain.tissue_at(moved, base)
        return there if kind == "cosine" or jacobian_g is None else similar_tissue(there, jacobian_g)

    # Images are linear in the cosine itself farther than in its coordinate.
    widths = high - low
    if kind == "cosine":
        natural = [
            (to_natural(kind, b) - to_natural(kind, a)) / natural_derivative(kind, at)
            for a, b, at in zip(low, high, x[own], strict=True)
        ]
        widths = np.array(natural)
    teeth = tuple(tooth for k in own if (tooth := domain.coordinates[k].tooth) is not None)
    return Secant(group, media(low), media(high), tuple(widths.tolist()), reach.share, teeth or None)
