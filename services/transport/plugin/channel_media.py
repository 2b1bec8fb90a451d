"""Media that differ per colour channel, for paths that carry all channels at once.

A path samples its flights and directions by the medium of one channel, the *leader*, picked at random, and has the
weight f_k / mean_c(pdf_c) for channel k: the balance heuristic over all channels that could have led the whole path
(Wilkie et al. 2014). Only ratios of the pdf_c enter, so they are carried relative to the largest. With one channel all
of this is absent from the kernel.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from services.transport.optics.parameters import Medium
from services.transport.scene.geometry import DENTIN
from services.transport.scene.media import Media, PhaseFunction


@dataclass(frozen=True)
class ToothOptics:
    """Optical parameters of teeth: one medium per colour channel, lengths in scene units (mm where the fit's values are
    used).
    """

    enamel: tuple[Medium, ...]
    dentin: tuple[Medium, ...]
    """Empty where no dentin surface is named."""
    boundary: str = "matched"
    """Name of the boundary model of the outer faces."""
    ior: float = 1.0
    """Index of refraction of the teeth."""
    roughness: float | None = None
    """GGX roughness of the outer face's mirror image; None leaves that image out, as a fit does."""


class ChannelMedia:
    """Enamel and dentin of every channel. A *part* is ENAMEL, DENTIN or 0 outside teeth."""

    def __init__(self, optics: ToothOptics) -> None:
        self.channels = len(optics.enamel)
        self._parts = DENTIN if optics.dentin else 1
        # Media are numbered channel by channel.
        pairs = (
            zip(optics.enamel, optics.dentin, strict=True) if optics.dentin else ((medium,) for medium in optics.enamel)
        )
        self._media = Media([medium for channel in pairs for medium in channel])
        self.two_lobes = self._media.two_lobes

    def _indices(self, part: mi.UInt32) -> list[mi.UInt32]:
        return [dr.select(part == 0, 0, part + self._parts * k) for k in range(self.channels)]

    def extinction(self, part: mi.UInt32) -> mi.Spectrum:
        """Sigma of each channel, 0 outside teeth."""
        return mi.Spectrum([self._media.extinction(index) for index in self._indices(part)])

    def albedo(self, part: mi.UInt32) -> mi.Spectrum:
        """Single-scattering albedo of each channel."""
        return mi.Spectrum([dr.exp(self._media.pick(self._media.log_alpha, index)) for index in self._indices(part)])

    def phase(self, part: mi.UInt32, omega: mi.Vector3f, omega_out: mi.Vector3f) -> mi.Spectrum:
        """Phase function of each channel, 1/sr."""
        return mi.Spectrum(
            [PhaseFunction(self._media, index).density(omega, omega_out) for index in self._indices(part)]
        )

    def sample_direction(
        self, part: mi.UInt32, leader: mi.UInt32, omega: mi.Vector3f, u_lobe: mi.Float | None, u: mi.Point2f
    ) -> mi.Vector3f:
        """A direction from the leader's phase function."""
        index = dr.select(part == 0, 0, part + self._parts * leader)
        return PhaseFunction(self._media, index).sample(omega, u_lobe, u.x, u.y)

    def pick_leader(self, u: mi.Float) -> mi.UInt32:
        """A random channel, each with equal probability."""
        return dr.minimum(mi.UInt32(u * self.channels), self.channels - 1) if self.channels > 1 else mi.UInt32(0)

    def of_leader(self, leader: mi.UInt32, values: mi.Spectrum) -> mi.Float:
        """The leader's value among those of all channels."""
        result = values[0]
        for k in range(1, self.channels):
            result = dr.select(leader == k, values[k], result)
        return result

    def multiply_densities(self, leader_densities: mi.Spectrum, density: mi.Spectrum, active: mi.Bool) -> mi.Spectrum:
        """Multiply the channels' relative densities ``leader_densities`` by those of one more choice, and scale the
        largest to 1.
        """
        if self.channels == 1:
            return leader_densities
        product = leader_densities * density
        return dr.select(active, product / dr.max(product), leader_densities)

    def channel_weights(self, leader_densities: mi.Spectrum) -> mi.Spectrum:
        """Weight of a path of unit throughput for each channel."""
        return leader_densities / dr.mean(leader_densities) if self.channels > 1 else mi.Spectrum(1)

    def mean_density(self, leader_densities: mi.Spectrum, values: mi.Spectrum) -> mi.Float:
        """Mean density over all possible leaders of a choice that each makes with density ``values``."""
        return dr.mean(self.channel_weights(leader_densities) * values)
