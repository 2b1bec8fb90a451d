"""Differentiation of a stage's images: by score functions along the same walks, or by differences of images of changed
media.

A difference costs two images for each coordinate, and a jaw has hundreds of coordinates. But a tooth changes the images
of itself and of its neighbours and hardly any others. So the same coordinate of every third tooth is changed at once,
and each tooth's derivative is read in the pixels where it is the nearest of the changed teeth (a sparse Jacobian by
groups of columns: Curtis, Powell and Reid 1974).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from services.fit.coordinates.domain import Domain, kind_of, natural_derivative, similar_tissue, to_natural
from services.fit.measurements.blocks import BlockTask, PixelParts
from services.fit.passes.neighbours import Neighbours
from services.tasks.engine_host import EngineHost
from services.transport.optics.parameters import Mouth, Optics, Tissue
from services.transport.scene.recipe import JacobianEstimate, View

Array = NDArray[np.float64]

WITHOUT_SCORES = frozenset({"shape", "cosine"})
"""Kinds of coordinates whose derivatives are always computed as differences."""
SCORES_DIVISOR = 4
"""Divisor of the paths for scores where the derivatives to sigma are differences: the remaining scores have little
noise."""


@dataclass(frozen=True)
class DifferenceStep:
    """Distances below and above a coordinate's value, in the unbounded domain, at which the two images of a difference
    are rendered, and the divisor of the task's paths for each image.
    """

    below: float
    above: float
    path_divisor: int


DIFFERENCE_STEPS: Mapping[str, DifferenceStep] = MappingProxyType(
    {"shape": DifferenceStep(0.2, 0.2, 1), "sigma": DifferenceStep(0.7, 0.7, 4), "cosine": DifferenceStep(1.0, 0.0, 8)}
)
"""Reach by kind of coordinate. The noise falls in proportion to the width. That a wide difference is not the exact
derivative hardly changes the zero of J'Wr, and so the solution."""

COSINE_STEP = DifferenceStep(0.35, 0.35, 4)
"""Reach of a cosine in the final uncertainty estimate, which needs the derivative itself."""


@dataclass(frozen=True)
class Secant:
    """Derivative with respect to one coordinate, or to several of teeth that are far apart, as a difference of two
    images; it has less noise than border terms or scores.
    """

    coordinates: tuple[int, ...]
    low: Tissue | Mouth
    high: Tissue | Mouth
    widths: tuple[float, ...]
    """Width of the difference for each coordinate: the distance between both ends."""
    path_divisor: int
    teeth: tuple[int, ...] | None = None
    """Teeth in whose pixels, and their neighbours' pixels, each coordinate's derivative is read; None where one
    coordinate applies to all pixels."""


@dataclass(frozen=True)
class Differentiation:
    """Differentiation of a stage's images: scores of some natural parameters, mapped to the coordinates,
    and secants.
    """

    parameters: tuple[str, ...]
    chain: Array
    """Chain rule d parameter / d x, (P, F)."""
    secants: tuple[Secant, ...] = ()
    path_divisor: int = 1
    """Divisor of the task's paths for scores."""
    neighbours: Neighbours | None = None
    """Neighbourhood of a jaw's teeth; None for a single tooth."""
    errors: tuple[str, ...] = ()
    """The instrument's errors. Their derivatives follow from the images and are not rendered, see
    ``instrument.photographs``."""

    def render(
        self, host: EngineHost, task: BlockTask, view: View, seeds: Sequence[int], parts: PixelParts | None = None
    ) -> tuple[Array, ...]:
        """Derivatives (F, L N) with respect to the tissue's coordinates, for each of the seeds; scores use the task's
        media.

        Every surface is rendered with all seeds before it is moved again.

        Args:
            parts: for a jaw, the part of the scene that each pixel shows.
        """
        images: dict[tuple[int, int], list[Array]] = {}

        def rendered(tissue: Tissue | Mouth, samples: int) -> list[Array]:
            # Images (L, N) by seed; an end that several secants share is rendered once.
            key = id(tissue), samples
            if key not in images:
                stacks = [
                    host.call("images", task.recipe, tissue, view, samples=samples, seed=seed, batches=1)
                    for seed in seeds
                ]
                images[key] = [np.asarray(stack.mean, dtype=np.float64) for stack in stacks]
            return images[key]

        slopes: list[dict[int, Array]] = [{} for _ in seeds]
        for secant in self.secants:
            samples = max(task.samples // secant.path_divisor, 1)
            for found, low, high in zip(
                slopes, rendered(secant.low, samples), rendered(secant.high, samples), strict=True
            ):
                for coordinate, width, mask in zip(
                    secant.coordinates, secant.widths, self._pixel_masks(secant, parts), strict=True
                ):
                    found[coordinate] = ((high - low) * mask / width).reshape(-1)

        by_seed = []
        for seed, found in zip(seeds, slopes, strict=True):
            if self.parameters:
                samples = max(task.samples // self.path_divisor, 1)
                estimate: JacobianEstimate = host.call(
                    "jacobian", task.recipe, task.tissue, view, self.parameters, samples=samples, seed=seed, batches=1
                )
                rows = np.asarray(
                    self.chain.T @ np.asarray(estimate.jacobian, dtype=np.float64).reshape(len(self.parameters), -1)
                )
            else:
                rows = np.zeros((self.chain.shape[1], next(iter(found.values())).size))
            for coordinate, slope in found.items():
                rows[coordinate] = slope
            by_seed.append(rows)
        return tuple(by_seed)

    def _pixel_masks(self, secant: Secant, parts: PixelParts | None) -> Sequence[NDArray[np.bool_] | float]:
        # Mask (N,), by coordinate, of the pixels in which its derivative is read.
        if secant.teeth is None:
            return [1.0]
        assert self.neighbours is not None
        assert parts is not None
        return [self.neighbours.pixels(tooth, parts) for tooth in secant.teeth]


def differentiation(
    domain: Domain, x: Array, base: Optics, jacobian_g: float | None, neighbours: Neighbours | None = None
) -> Differentiation:
    """Differentiation of a stage's images at x (F,).

    Args:
        jacobian_g: mean cosine of the similar media in which derivatives are rendered; None for the images' own media.
        neighbours: neighbourhood of a jaw's teeth.
    """
    x, tissue = x[: domain.tissue_count], domain.tissue_at(x, base)
    # Scores of extinction are noisy, so a single tooth in similar media uses differences instead. A jaw keeps scores,
    # because one pass gives those of all teeth, and so do the images' own media, because the final uncertainty
    # estimate needs derivatives.
    differing = WITHOUT_SCORES if jacobian_g is None or isinstance(base, Mouth) else WITHOUT_SCORES | {"sigma"}
    is_secant = [c.kind in differing for c in domain.coordinates]
    own = tuple(
        target for c, differs in zip(domain.coordinates, is_secant, strict=True) if not differs for target in c.targets
    )
    names = own if jacobian_g is None else tuple(dict.fromkeys(n for p in own for n in _similar_parameters(p)))
    groups = _groups(domain, np.flatnonzero(is_secant), neighbours)
    secants = [
        _secant(domain, x, group, base, tissue, jacobian_g, DIFFERENCE_STEPS[domain.coordinates[group[0]].kind])
        for group in groups
    ]
    path_divisor = (
        SCORES_DIVISOR if any(domain.coordinates[one.coordinates[0]].kind == "sigma" for one in secants) else 1
    )
    chain = _chain(domain, x, base, names, jacobian_g)
    return Differentiation(names, chain, tuple(secants), path_divisor, neighbours, domain.errors.names)


def exact_differentiation(
    domain: Domain, x: Array, base: Optics, neighbours: Neighbours | None = None
) -> Differentiation:
    """Differentiation of the images in their own media at x (F,), without blend weights."""
    x = x[: domain.tissue_count]
    tissue, cosines = domain.tissue_at(x, base), [k for k, c in enumerate(domain.coordinates) if c.kind == "cosine"]
    scored = _scored_parameters(domain)
    secants = tuple(
        _secant(domain, x, group, base, tissue, None, COSINE_STEP) for group in _groups(domain, cosines, neighbours)
    )
    chain = _chain(domain, x, base, scored, None)
    return Differentiation(scored, chain, secants, neighbours=neighbours, errors=domain.errors.names)


def _scored_parameters(domain: Domain) -> tuple[str, ...]:
    # Parameters whose derivatives can be scores.
    return tuple(name for name in domain.parameters if kind_of(name) not in WITHOUT_SCORES)


def _chain(domain: Domain, x: Array, base: Optics, names: tuple[str, ...], g: float | None) -> Array:
    # Derivatives (P, F) of natural parameters with respect to x; of those of similar media where their mean cosine g is
    # given.
    if g is None and not domain.cosines:
        return domain.chain(x)[[domain.parameters.index(name) for name in names]]

    # The map is smooth and in closed form, so its central differences are accurate to rounding.
    def values(at: Array) -> Array:
        tissue = domain.tissue_at(at, base)
        media = tissue if g is None else similar_tissue(tissue, g)
        return np.array([media.value(name) for name in names])

    shifts = 1e-5 * np.eye(len(x))
    return np.stack([(values(x + s) - values(x - s)) / 2e-5 for s in shifts], axis=1)


def _similar_parameters(name: str) -> tuple[str, ...]:
    part, _, leaf = name.rpartition(".")
    return (f"{part}.sigma", f"{part}.alpha") if leaf in {"sigma", "alpha"} else (name,)


def _groups(
    domain: Domain, chosen: Sequence[int] | NDArray[np.int_], neighbours: Neighbours | None
) -> list[tuple[int, ...]]:
    # Groups of coordinates that are changed at once: the same coordinate of all teeth of one colour (graph colouring);
    # any other coordinate alone.
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
    # The tooth of a jaw that owns a coordinate, None where no tooth does, and the rest of the coordinate's name.
    coordinate = domain.coordinates[k]
    return coordinate.tooth, coordinate.targets[0].partition(".")[2]


def _secant(
    domain: Domain,
    x: Array,
    group: tuple[int, ...],
    base: Optics,
    tissue: Optics,
    jacobian_g: float | None,
    step: DifferenceStep,
) -> Secant:
    # Difference that is one-sided near a bound. A cosine's ends use the images' own media, because similar media fix
    # the cosine.
    own = list(group)
    kind, (lower, upper) = domain.coordinates[own[0]].kind, (bound[own] for bound in domain.bounds)
    low = np.clip(x[own] - step.below, lower, upper)
    high = np.maximum(np.clip(x[own] + step.above, lower, upper), low + 0.5 * (step.below + step.above))

    def media(ends: Array) -> Optics:
        moved = x.copy()
        moved[own] = ends
        tissue_there = tissue if np.array_equal(moved, x) else domain.tissue_at(moved, base)
        return tissue_there if kind == "cosine" or jacobian_g is None else similar_tissue(tissue_there, jacobian_g)

    # Measure a cosine's width in the cosine itself, in which images are linear over a longer range than in its
    # coordinate.
    widths = high - low
    if kind == "cosine":
        natural = [
            (to_natural(kind, b) - to_natural(kind, a)) / natural_derivative(kind, at)
            for a, b, at in zip(low, high, x[own], strict=True)
        ]
        widths = np.array(natural)
    teeth = tuple(tooth for k in own if (tooth := domain.coordinates[k].tooth) is not None)
    return Secant(group, media(low), media(high), tuple(widths.tolist()), step.path_divisor, teeth or None)
