"""The reflectance of enamel on dentin that textures are baked with, against path tracing of the layers."""

from __future__ import annotations

import math

import numpy as np
import pytest

from services.slab.simulate import Layer, simulate_slab
from services.transport.optics.half_space import half_space_reflectance
from services.transport.optics.layer_reflectance import layer_reflectance
from services.transport.optics.parameters import Medium


@pytest.mark.parametrize(
    ("enamel", "dentin", "thickness_mm"),
    [
        (Medium(5.0, 0.99, g1=0.7), Medium(12.0, 0.98, g1=0.75), 0.5),
        (Medium(3.0, 0.95, g1=0.6), Medium(13.0, 0.95, g1=0.75), 1.0),
    ],
)
def test_a_layer_reflects_as_much_as_paths_do(enamel: Medium, dentin: Medium, thickness_mm: float) -> None:
    layers = (
        Layer(sigma=enamel.sigma, alpha=enamel.alpha, g1=enamel.g1, thickness_mm=thickness_mm),
        Layer(sigma=dentin.sigma, alpha=dentin.alpha, g1=dentin.g1, thickness_mm=math.inf),
    )
    traced = simulate_slab(layers, source="diffuse", rel_error=2e-3)
    (found,) = layer_reflectance(enamel, np.array([thickness_mm]), half_space_reflectance(dentin))
    # The formula's own error is at most 0.003; layers differ from either medium alone by 0.02 and more.
    assert abs(found - traced.R) < 0.003 + 3 * traced.R_se
    for alone in (enamel, dentin):
        assert abs(half_space_reflectance(alone) - traced.R) > 0.015
