"""The state of a fit before each step of its last stages, stored so that a new attempt continues there to the same
digits.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.slab.cell.dictionary import Material
from services.slab.solve.mixture import Mixture
from services.slab.solve.normal import DerivativeSums, ResidualSums
from services.tasks.journal import Journal

Array = NDArray[np.float64]

STEP = "step"
"""Key of the state in the journal."""


@dataclass(frozen=True)
class CombinedRenders:
    """Renders of one stage whose derivatives are combined, and residuals of the last of them."""

    derivatives: DerivativeSums
    residuals: ResidualSums
    path_noise: tuple[Array, ...]
    """Noise from which their weights were made; see ``GaussNewton.path_noise``."""


@dataclass(frozen=True)
class Checkpoint:
    """The state on which a step of the last stages depends, beside the measurements and the options."""

    material: Material
    stage: int
    step: int
    """Number of the step within the stage, from 0."""
    steps: int
    """Number of steps taken so far, in the search and in the last stages."""
    is_converged: bool
    """Whether the search came as far as the noise of its paths allows."""
    renders: int
    paths: int
    path_noise: tuple[Array, ...]
    """See ``GaussNewton.path_noise``."""
    multiple: Array
    """See ``GaussNewton.multiple``."""
    combined: CombinedRenders | None


@dataclass(frozen=True)
class Checkpoints:
    """The newest state of one wavelength's fit, in the wavelength's journal."""

    journal: Journal
    on_write: Callable[[Checkpoint], None] = lambda _: None
    """Called with each state that is stored."""

    def write(self, checkpoint: Checkpoint) -> None:
        """Store a state in place of the one before."""
        arrays: dict[str, Any] = _numbered("path_noise", checkpoint.path_noise) | {"multiple": checkpoint.multiple}
        if (combined := checkpoint.combined) is not None:
            arrays |= _numbered("joined_noise", combined.path_noise)
            arrays |= {
                "halves": combined.derivatives.halves,
                "own": combined.derivatives.own,
                "counts": np.array(combined.derivatives.counts),
                **{
                    f"residuals_{field.name}": np.array(getattr(combined.residuals, field.name))
                    for field in fields(ResidualSums)
                },
            }
        for field in fields(checkpoint.material):
            arrays[f"material_{field.name}"] = np.asarray(getattr(checkpoint.material, field.name))
        self.journal.put(STEP, {name: np.asarray(getattr(checkpoint, name)).item() for name in _NUMBERS}, **arrays)
        self.on_write(checkpoint)

    def read(self) -> Checkpoint | None:
        """The newest state; None where the journal has none."""
        numbers: dict[str, Any] | None = self.journal.entries.get(STEP)
        if numbers is None:
            return None
        arrays: dict[str, Any] = self.journal.arrays(STEP)
        noise = _of_numbered("path_noise", arrays)
        return Checkpoint(
            _material(arrays), path_noise=noise, multiple=arrays["multiple"], combined=_combined(arrays), **numbers
        )


_NUMBERS = ("stage", "step", "steps", "is_converged", "renders", "paths")


def _material(arrays: dict[str, Array]) -> Material:
    scattering, absorption = arrays["material_scattering"], float(arrays["material_absorption_per_mm"])
    if "material_atom_weights" in arrays:
        return Mixture(scattering, absorption, arrays["material_atom_weights"])
    return Material(scattering, absorption)


def _combined(arrays: dict[str, Array]) -> CombinedRenders | None:
    if "counts" not in arrays:
        return None
    first, second = (int(count) for count in arrays["counts"])
    sums = DerivativeSums(arrays["halves"], arrays["own"], (first, second))
    total, products, count, place = (arrays[f"residuals_{field.name}"] for field in fields(ResidualSums))
    residuals = ResidualSums(total, products, int(count), place)
    return CombinedRenders(sums, residuals, _of_numbered("joined_noise", arrays))


def _numbered(name: str, values: tuple[Array, ...]) -> dict[str, Array]:
    return {f"{name}_{k}": one for k, one in enumerate(values)}


def _of_numbered(name: str, arrays: dict[str, Array]) -> tuple[Array, ...]:
    return tuple(arrays[f"{name}_{k}"] for k in range(sum(one.startswith(f"{name}_") for one in arrays)))
