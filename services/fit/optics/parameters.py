"""Medium parameters in physical units, their names, and the unbounded domain they are fitted in (optics.md; teeth 2018 Eq. 22, 24)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from services.core.errors import InputError
from services.fit.optics.phase_table import PhaseTable

MEDIUM_FIELDS = ("sigma", "alpha", "beta", "g1", "g2")


@dataclass(frozen=True)
class Medium:
    """A homogeneous scattering medium with the phase function beta HG(g1) + (1 - beta) HG(g2)."""

    sigma: float
    """Extinction, per mm."""
    alpha: float
    """Single-scattering albedo, 0 to 1."""
    beta: float = 1.0
    """Weight of the first lobe, 0 to 1."""
    g1: float = 0.0
    """Mean cosine of the first lobe."""
    g2: float = 0.0
    """Mean cosine of the second lobe."""
    table: PhaseTable | None = None
    """Phase function in place of the lobes."""

    def require_lobes(self, place: str) -> None:
        """Refuse a tabulated phase function where only lobes can be written.

        Raises:
            InputError: names the place.
        """
        if self.table is not None:
            raise InputError(f"{place} cannot hold a phase table; fit lobes to it first.")

    @property
    def mean_cosine(self) -> float:
        """First moment of the phase function."""
        if self.table is not None:
            return self.table.mean_cosine
        return self.beta * self.g1 + (1 - self.beta) * self.g2

    @property
    def sigma_s_reduced(self) -> float:
        """Reduced scattering (1 - g) alpha sigma, per mm."""
        return (1 - self.mean_cosine) * self.alpha * self.sigma

    @property
    def alpha_reduced(self) -> float:
        """Reduced albedo sigma_s' / (sigma_s' + sigma_a)."""
        absorption = (1 - self.alpha) * self.sigma
        total = self.sigma_s_reduced + absorption
        return self.sigma_s_reduced / total if total > 0 else 0.0


@dataclass(frozen=True)
class Tissue:
    """Everything a fit may change, for one colour channel. Names: ``enamel.sigma`` ... ``dentin.g2``, ``shape.0`` ... ``shape.2``."""

    enamel: Medium
    dentin: Medium
    shape: tuple[float, ...] = ()
    """Dentin blend weights c, 0 to 1, in the order of the anatomy's modes."""

    def value(self, name: str) -> float:
        """The parameter called ``name``."""
        part, leaf = name.split(".")
        return self.shape[int(leaf)] if part == "shape" else float(getattr(getattr(self, part), leaf))

    def with_values(self, values: dict[str, float]) -> Tissue:
        """A copy with some parameters replaced."""
        enamel, dentin, shape = self.enamel, self.dentin, list(self.shape)
        for name, value in values.items():
            part, leaf = name.split(".")
            change: dict[str, Any] = {leaf: value}
            if part == "shape":
                shape[int(leaf)] = value
            elif part == "enamel":
                enamel = replace(enamel, **change)
            else:
                dentin = replace(dentin, **change)
        return Tissue(enamel, dentin, tuple(shape))
