"""The rough surface at the corners of its parameters: one set in each lane of one kernel, on a mesh with sliver
triangles around dentin that almost touches it.
"""

from __future__ import annotations

import numpy as np

from services.anatomy.dentin_shape import DentinShape
from services.bench.stability.difficult_scenes import ellipsoid, with_slivers
from services.core.surface.rough import MIN_ROUGH_IOR, ROUGHNESS
from services.transport.optics.parameters import MEDIUM_FIELDS, Medium
from services.transport.platform import prepare_device
from services.transport.scene.recipe import single_tooth
from tests.support.small_tooth import INTENSITY, LIGHTS_MM, camera_at, whole_view

SEMI_AXES_MM = np.array([3.0, 2.0, 4.0])
BETWEEN_MM = 0.002
"""Thickness of the enamel, little more than two ray offsets."""


def test_every_corner_gives_numbers() -> None:
    prepare_device()
    import mitsuba as mi

    from services.transport.boundary.rough import Rough
    from services.transport.lighting.lights import PointLights
    from services.transport.lighting.lit_faces import LitFaces
    from services.transport.paths.scores import Plan
    from services.transport.paths.starts import CameraStart
    from services.transport.paths.walk import Walk
    from services.transport.scene.media import Media, Score
    from services.transport.scene.mesh_geometry import MeshGeometry

    edge = 101
    count, rng = edge**2, np.random.default_rng(11)

    def media() -> list[Medium]:
        # Clear and dense, white and black, narrow lobes forwards and backwards; whiter ones would only take longer.
        sigma = np.exp(rng.uniform(np.log(1e-4), np.log(1e3), count))
        alpha = 1 - np.exp(rng.uniform(np.log(2e-3), 0, count))
        sharp = 1 - np.exp(rng.uniform(np.log(1e-4), 0, (2, count)))
        g1, g2 = sharp * rng.choice([-1, 1], (2, count))
        return [Medium(*values) for values in zip(sigma, alpha, rng.random(count), g1, g2, strict=True)]

    # Indices go below that of air, as those of a bubble: total reflection is then outside.
    low, high = ROUGHNESS
    boundary = Rough(1.5, 0.3, compensated=False)
    ends = rng.choice([low, high, 0.05], count)
    boundary.roughness = mi.Float(np.where(rng.random(count) < 0.3, ends, rng.uniform(low, high, count)))
    index = rng.choice([1 / 2.5, 1 / MIN_ROUGH_IOR, MIN_ROUGH_IOR, 1.33, 1.63, 2.5], count)
    boundary.ior = mi.Float(index)

    outer, inner = with_slivers(ellipsoid(SEMI_AXES_MM)), with_slivers(ellipsoid(SEMI_AXES_MM - BETWEEN_MM))
    scene = single_tooth(outer, DentinShape.known(inner), LIGHTS_MM, np.full(5, INTENSITY))
    geometry = MeshGeometry(scene)
    faces = LitFaces(scene.light_positions_mm, scene.light_intensities, scene.vertices_mm())
    faces.trace(geometry, boundary)
    lights = PointLights(scene.light_positions_mm, scene.light_intensities, faces)
    # The outermost pixels graze the ellipsoid.
    start = CameraStart(whole_view(camera_at((1, 0.1, 0.1), size=edge, span_mm=4.5)), 1, seed=9, radius_mm=5.0)
    fields = (*((1, field) for field in MEDIUM_FIELDS), *((2, field) for field in MEDIUM_FIELDS), (0, "roughness"))
    plan = Plan(scores=tuple(Score(*pair) for pair in fields))
    sums, derivatives = Walk(geometry, Media([media(), media()]), lights, start, plan, boundary).run(8).arrays()
    assert np.isfinite(sums).all()
    assert all(np.isfinite(derivative).all() for derivative in derivatives)
    # Most lanes see light, and derivatives to the roughness.
    assert np.count_nonzero(sums.sum(axis=1)) > count / 3
    assert np.count_nonzero(derivatives[-1].sum(axis=1)) > count / 3
