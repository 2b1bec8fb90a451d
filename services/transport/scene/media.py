"""Media as kernel inputs: opaque numbers, so that new values reuse the compiled kernel."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from services.core.errors import InputError
from services.transport.optics import phase
from services.transport.optics.parameters import Medium
from services.transport.scene.phase_tables import PhaseTables

MAX_SELECTED = 3
"""Largest number of media among which kernels select by comparison; values of more media are gathered from a table."""


def require_medium(name: str, medium: Medium) -> None:
    """Refuse parameters outside their physical range, before any kernel; kernels compute in single precision, so the
    rounded values must lie inside it too.

    Raises:
        InputError: names parameter and value.
    """
    for field, low, high, rule in (
        ("sigma", 0.0, math.inf, "must be positive and finite in single precision, per mm"),
        ("alpha", 0.0, 1.0, "must lie in 0 to 1"),
        ("beta", 0.0, 1.0, "must lie in 0 to 1"),
        ("g1", -1.0, 1.0, "must lie between -1 and 1 in single precision, ends excluded"),
        ("g2", -1.0, 1.0, "must lie between -1 and 1 in single precision, ends excluded"),
    ):
        value = getattr(medium, field)
        closed = field in {"alpha", "beta"}
        with np.errstate(over="ignore"):
            rounded = float(np.float32(value))
        if not all(math.isfinite(v) and (low <= v <= high if closed else low < v < high) for v in (value, rounded)):
            raise InputError(f"{name}.{field} = {value:.10g} {rule}; correct it.")


@dataclass(frozen=True)
class Score:
    """One accumulated derivative: ``field`` of the medium numbered ``medium``."""

    medium: int
    field: str


class Media:
    """Parameters of media 1..M; index 0 is empty space."""

    def __init__(self, media: Sequence[Medium | Sequence[Medium]]) -> None:
        """Take each medium once for all lanes, or as a sequence of one per lane.

        Raises:
            InputError: media that differ from lane to lane have phase tables.
        """
        self.count = len(media)
        each = [[entry] if isinstance(entry, Medium) else entry for entry in media]
        self.two_lobes = any(m.beta < 1 for entry in each for m in entry)
        """Whether kernels evaluate the second lobe; a derivative to beta also needs it, as it gives what the lobe would
        contribute."""
        if any(m.table is not None for entry in each for m in entry if len(entry) > 1):
            raise InputError("Media that differ from lane to lane cannot have phase tables; give them lobes.")
        tables = [entry[0].table for entry in each]
        self.tabulated = tuple(table is not None for table in tables)
        self.tables = PhaseTables(tables) if any(self.tabulated) else None

        def opaque(value: Callable[[Medium], float]) -> list[mi.Float]:
            return [
                dr.opaque(mi.Float, value(entry))
                if isinstance(entry, Medium)
                else mi.Float(np.array([value(m) for m in entry], dtype=np.float32))
                for entry in media
            ]

        self.sigma = opaque(lambda m: m.sigma)
        self.sigma_s = opaque(lambda m: m.sigma * m.alpha)
        self.log_alpha = opaque(lambda m: math.log(max(m.alpha, 1e-30)))
        self.inverse_alpha = opaque(lambda m: 1 / max(m.alpha, 1e-30))
        self.beta = opaque(lambda m: m.beta)
        self.g1 = opaque(lambda m: m.g1)
        self.g2 = opaque(lambda m: m.g2)
        self._tables: dict[int, mi.Float] = {}
        if self.count > MAX_SELECTED:
            columns = (self.sigma, self.sigma_s, self.log_alpha, self.beta, self.g1, self.g2)
            self._tables = {id(column): dr.concat(column) for column in columns}
            dr.eval(self._tables)

    def pick(self, values: list[mi.Float], index: mi.UInt32) -> mi.Float:
        """Value of the medium with number ``index``; arbitrary in empty space."""
        if self._tables:
            return dr.gather(mi.Float, self._tables[id(values)], dr.maximum(index, 1) - 1)
        result = values[-1]
        for k in range(self.count - 2, -1, -1):
            result = dr.select(index == k + 1, values[k], result)
        return result

    def extinction(self, index: mi.UInt32) -> mi.Float:
        """Sigma of the medium, 0 in empty space."""
        return dr.select(index == 0, 0, self.pick(self.sigma, index))


class PhaseFunction:
    """The phase function of each lane's medium: one or two lobes or a table, as the scene needs."""

    def __init__(self, media: Media, index: mi.UInt32) -> None:
        self.index, self.tables, self.two_lobes = index, media.tables, media.two_lobes
        self.g1 = media.pick(media.g1, index)
        if self.two_lobes:
            self.g2 = media.pick(media.g2, index)
            self.beta = media.pick(media.beta, index)

    def density(self, omega: mi.Vector3f, omega_out: mi.Vector3f) -> mi.Float:
        """Value of the phase function, 1/sr."""
        value = self._density_of_lobes(omega, omega_out)
        if self.tables is None:
            return value
        return dr.select(self.tables.known(self.index), self.tables.density(self.index, omega, omega_out), value)

    def _density_of_lobes(self, omega: mi.Vector3f, omega_out: mi.Vector3f) -> mi.Float:
        f1 = phase.density(self.g1, phase.deviation(self.g1, omega, omega_out))
        if not self.two_lobes:
            return f1
        f2 = phase.density(self.g2, phase.deviation(self.g2, omega, omega_out))
        return dr.lerp(f2, f1, self.beta)

    def sample(self, omega: mi.Vector3f, u_lobe: mi.Float | None, u: mi.Float, v: mi.Float) -> mi.Vector3f:
        """Direction distributed as the phase function."""
        g = self.g1 if u_lobe is None else dr.select(u_lobe < self.beta, self.g1, self.g2)
        onward = phase.deflected(omega, g, phase.sample_deviation(g, u), v)
        if self.tables is None:
            return onward
        return dr.select(self.tables.known(self.index), self.tables.sample(self.index, omega, u, v), onward)

    def scores(self, fields: frozenset[str], omega: mi.Vector3f, omega_out: mi.Vector3f) -> dict[str, mi.Float]:
        """Derivatives d ln(density) / d(field) for those of ``fields`` that the lobes have (teeth 2018 Eq. 12, 13)."""
        m1 = phase.deviation(self.g1, omega, omega_out)
        if not self.two_lobes:
            return {"g1": phase.score_g(self.g1, m1)} if "g1" in fields else {}
        m2 = phase.deviation(self.g2, omega, omega_out)
        f1, f2 = phase.density(self.g1, m1), phase.density(self.g2, m2)
        inverse = dr.rcp(dr.lerp(f2, f1, self.beta))
        terms = {}
        if "beta" in fields:
            terms["beta"] = (f1 - f2) * inverse
        if "g1" in fields:
            terms["g1"] = self.beta * f1 * inverse * phase.score_g(self.g1, m1)
        if "g2" in fields:
            terms["g2"] = (1 - self.beta) * f2 * inverse * phase.score_g(self.g2, m2)
        return terms
