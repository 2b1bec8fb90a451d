"""The state of a fit before each step of its last stages, stored so that a new attempt continues there to the same
digits.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.core.store import write_atomic
from services.slab.cell.dictionary import Material
from services.slab.solve.mixture import Mixture
from services.slab.solve.normal import DerivativeSums, ResidualSums

Array = NDArray[np.float64]

FILE = "steps.npz"


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
class CheckpointFile:
    """The file that stores the newest state of one wavelength's fit in a folder."""

    folder: Path
    fingerprint: str
    """Fingerprint of all that the result depends on; a state with another fingerprint is not read."""
    on_write: Callable[[Checkpoint], None] = lambda _: None
    """Called with each state that is stored."""

    def write(self, checkpoint: Checkpoint) -> None:
        """Store a state in place of the one before."""
        arrays: dict[str, Any] = {name: np.array(getattr(checkpoint, name)) for name in _NUMBERS}
        arrays |= _numbered("path_noise", checkpoint.path_noise) | {"multiple": checkpoint.multiple}
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
        stream = io.BytesIO()
        np.savez(stream, of=np.array(self.fingerprint), **arrays)
        self.folder.mkdir(parents=True, exist_ok=True)
        write_atomic(self.folder / FILE, stream.getvalue())
        self.on_write(checkpoint)

    def read(self) -> Checkpoint | None:
        """The newest state; None where the folder holds no whole state of this fit."""
        try:
            with np.load(io.BytesIO((self.folder / FILE).read_bytes()), allow_pickle=False) as content:
                arrays = dict(content)
        except (OSError, ValueError, EOFError, zipfile.BadZipFile):
            return None
        if str(arrays.pop("of", "")) != self.fingerprint:
            return None
        numbers: dict[str, Any] = {name: arrays[name].item() for name in _NUMBERS}
        noise = _of_numbered("path_noise", arrays)
        return Checkpoint(
            _material(arrays), path_noise=noise, multiple=arrays["multiple"], combined=_combined(arrays), **numbers
        )

    def remove(self) -> None:
        """Delete the file, because the fit is done."""
        (self.folder / FILE).unlink(missing_ok=True)


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
