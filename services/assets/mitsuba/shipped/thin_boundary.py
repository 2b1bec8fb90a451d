"""A thin dielectric boundary for Mitsuba 3: transmitted light does not bend; F is air-to-ior Fresnel at |cos| from both
sides (teeth 2018, Eq. 1 and 2).

A texture ``stain`` absorbs its share of the transmitted light and nothing of the reflected light.

Usage: ``mi.set_variant(...)``, then ``thin_boundary.register()``, then load the scene.
"""

from typing import Any

import drjit as dr
import mitsuba as mi


def register() -> None:
    """Register ``<bsdf type="thin_boundary">`` with Mitsuba's current variant."""

    class ThinBoundary(mi.BSDF):  # type: ignore[misc]  # mitsuba has no types
        def __init__(self, props):  # type: ignore[no-untyped-def]
            mi.BSDF.__init__(self, props)
            self.ior = props.get("ior", 1.631)
            self.stain = props.get("stain")
            sides = mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide
            self.m_components = [mi.BSDFFlags.DeltaReflection | sides, mi.BSDFFlags.Null | sides]
            self.m_flags = self.m_components[0] | self.m_components[1]

        def reflected(self, si: Any) -> Any:
            return mi.fresnel(dr.abs(mi.Frame3f.cos_theta(si.wi)), self.ior)[0]

        def passed(self, si: Any, active: Any) -> Any:
            return mi.Spectrum(1.0) if self.stain is None else 1 - self.stain.eval(si, active)

        def sample(self, ctx, si, sample1, sample2, active=True):  # type: ignore[no-untyped-def]  # noqa: ARG002
            share = self.reflected(si)
            mirror = active & (sample1 < share)
            found = mi.BSDFSample3f()
            found.wo = dr.select(mirror, mi.reflect(si.wi), -si.wi)
            found.pdf = dr.select(mirror, share, 1 - share)
            found.eta = 1.0
            found.sampled_component = dr.select(mirror, mi.UInt32(0), mi.UInt32(1))
            found.sampled_type = dr.select(
                mirror, mi.UInt32(+mi.BSDFFlags.DeltaReflection), mi.UInt32(+mi.BSDFFlags.Null)
            )
            return found, dr.select(mirror, mi.Spectrum(1.0), self.passed(si, active)) & active

        def eval(self, ctx, si, wo, active=True):  # type: ignore[no-untyped-def]  # noqa: ARG002
            return mi.Spectrum(0.0)

        def pdf(self, ctx, si, wo, active=True):  # type: ignore[no-untyped-def]  # noqa: ARG002
            return mi.Float(0.0)

        def eval_pdf(self, ctx, si, wo, active=True):  # type: ignore[no-untyped-def]  # noqa: ARG002
            return mi.Spectrum(0.0), mi.Float(0.0)

        def eval_null_transmission(self, si, active=True):  # type: ignore[no-untyped-def]
            return (1 - self.reflected(si)) * self.passed(si, active) & active

        def traverse(self, callback):  # type: ignore[no-untyped-def]
            pass

        def to_string(self):  # type: ignore[no-untyped-def]
            return f"ThinBoundary[ior={self.ior}]"

    mi.register_bsdf("thin_boundary", ThinBoundary)
