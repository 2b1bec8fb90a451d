"""The mirror image of the surroundings in a thin outer face, spread by a GGX roughness. A fit masks it; a picture needs
it.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from services.transport.boundary.model import FlatBoundary


class Gloss:
    """Rough reflection off the outside of a face (Walter et al. 2007, Eq. 20, 23, 33, 34); light that is not reflected
    continues unbent.
    """

    def __init__(self, roughness: float, boundary: FlatBoundary) -> None:
        self.facets = mi.MicrofacetDistribution(mi.MicrofacetType.GGX, roughness)
        self.boundary = boundary

    def evaluate(self, si: mi.SurfaceInteraction3f, direction: mi.Vector3f) -> tuple[mi.Float, mi.Float]:
        """Reflected radiance times cosine, and the density of ``sample``, 1/sr, towards a world direction."""
        wo = si.to_local(direction)
        half = dr.normalize(si.wi + wo)
        above = (si.wi.z > 0) & (wo.z > 0) & (dr.dot(direction, si.n) > 0)
        share = self.boundary.reflectance(dr.abs(dr.dot(si.wi, half)))
        value = share * self.facets.eval(half) * self.facets.G(si.wi, wo, half) / (4 * si.wi.z)
        density = self.facets.pdf(si.wi, half) / (4 * dr.dot(wo, half))
        return dr.select(above, value, 0), dr.select(above, density, 0)

    def sample(self, si: mi.SurfaceInteraction3f, u: mi.Point2f) -> mi.Vector3f:
        """A reflected world direction, by a facet normal sampled among those that are visible from ``si.wi``."""
        half = mi.Vector3f(self.facets.sample(si.wi, u)[0])
        return si.to_world(mi.reflect(si.wi, half))
