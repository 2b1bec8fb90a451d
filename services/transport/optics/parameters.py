"""Media of teeth in physical units, and the names of their parameters."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from services.core.errors import InputError
from services.transport.optics.phase_table import PhaseTable

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
    """Tabulated phase function that replaces the lobes; None where the lobes hold."""

    def require_lobes(self, place: str) -> None:
        """Refuse a tabulated phase function where only lobes can be written.

        Raises:
            InputError: the medium has a table; names ``place``.
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


@dataclass(frozen=True, eq=False)
class Stain:
    """A texture on a tooth's outer surface that attenuates the light passing through it (teeth 2018 Eq. 1)."""

    transmittance: NDArray[np.float64]
    """a_t, (H, W), above 0 and at most 1; the first row's centre lies at v = 1 / 2H."""
    se: NDArray[np.float64] | None = None
    """Standard error (H, W) of a_t; None where none was computed."""


@dataclass(frozen=True)
class Tissue:
    """All parameters that a fit of one tooth may change, for one colour channel.

    Names: ``enamel.sigma`` ... ``dentin.g2``, ``shape.0`` ... ``shape.2``, ``gums.sigma`` ....
    """

    enamel: Medium
    dentin: Medium
    shape: tuple[float, ...] = ()
    """Dentin blend weights c, 0 to 1, in the order of the anatomy's modes."""
    stain: Stain | None = None
    """None for a surface without stains."""
    gums: Medium | None = None
    """Gums around the tooth, where the scene has any; None for a tooth of a ``Mouth``, which has its own."""

    def medium(self, part: str) -> Medium:
        """The medium of ``enamel``, ``dentin`` or ``gums``."""
        if part == "gums":
            assert self.gums is not None
            return self.gums
        return self.enamel if part == "enamel" else self.dentin

    def value(self, name: str) -> float:
        """The parameter called ``name``."""
        part, leaf = name.split(".")
        return self.shape[int(leaf)] if part == "shape" else float(getattr(self.medium(part), leaf))

    def with_values(self, values: dict[str, float]) -> Tissue:
        """A copy with some parameters replaced."""
        media: dict[str, dict[str, Any]] = {}
        shape = list(self.shape)
        for name, value in values.items():
            part, leaf = name.split(".")
            if part == "shape":
                shape[int(leaf)] = value
            else:
                media.setdefault(part, {})[leaf] = value
        changed: dict[str, Any] = {part: replace(self.medium(part), **leaves) for part, leaves in media.items()}
        return replace(self, shape=tuple(shape), **changed)


@dataclass(frozen=True)
class Mouth:
    """All parameters that a fit may change in a scene of several parts, for one colour channel.

    Names: ``0.enamel.sigma`` ... ``13.shape.2`` by tooth, ``gums.sigma`` ..., ``cavity.reflectance``.
    """

    teeth: tuple[Tissue, ...]
    gums: Medium | None = None
    reflectance: float | None = None
    """Diffuse reflectance of the cavity's wall, 0 to 1."""

    def medium(self, part: str) -> Medium:
        """The medium of ``0.enamel`` ... ``13.dentin`` or ``gums``."""
        if part == "gums":
            assert self.gums is not None
            return self.gums
        tooth, tissue = part.split(".")
        return self.teeth[int(tooth)].medium(tissue)

    def value(self, name: str) -> float:
        """The parameter called ``name``."""
        part, leaf = name.split(".", 1)
        if part == "gums":
            return float(getattr(self.gums, leaf))
        if part == "cavity":
            assert self.reflectance is not None
            return self.reflectance
        return self.teeth[int(part)].value(leaf)

    def with_values(self, values: dict[str, float]) -> Mouth:
        """A copy with some parameters replaced."""
        teeth, gums, reflectance = list(self.teeth), self.gums, self.reflectance
        parts: dict[str, dict[str, Any]] = {}
        for name, value in values.items():
            part, leaf = name.split(".", 1)
            parts.setdefault(part, {})[leaf] = value
        for part, leaves in parts.items():
            if part == "gums":
                assert gums is not None
                gums = replace(gums, **leaves)
            elif part == "cavity":
                reflectance = leaves["reflectance"]
            else:
                teeth[int(part)] = teeth[int(part)].with_values(leaves)
        return Mouth(tuple(teeth), gums, reflectance)


Optics = TypeVar("Optics", Tissue, Mouth)
"""The parameters that a fit changes: of one tooth alone, or of a whole mouth."""
