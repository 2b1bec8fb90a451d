"""Connections aimed through a rough surface from scattering vertices: they give what walks that meet the surface by
chance give, with less noise.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from services.anatomy.dentin_shape import DentinShape
from services.core.geometry import Mesh
from services.transport.boundary.rough import Rough
from services.transport.engine import Engine
from services.transport.optics.parameters import Medium, Tissue
from services.transport.platform import prepare_device
from services.transport.scene.recipe import JacobianEstimate, SceneRecipe, StackEstimate, single_tooth
from tests.support.pictures import BATCHES, pixel_scores, require_same_pictures
from tests.support.rough_truths import scene_recipe
from tests.support.small_tooth import INTENSITY, LIGHTS_MM, SEMI_AXES_MM, camera_at, ellipsoid, sphere, whole_view
from tests.support.stained_tooth import stain, texture_coordinates
from tests.support.z_scores import require_unbiased, student_to_normal

LAYERED = Tissue(Medium(4.0, 0.99, 0.9, 0.7, -0.2), Medium(8.0, 0.98, g1=0.6))
CLEAR = Tissue(Medium(2.0, 0.9, 0.8, 0.6, -0.3), Medium(4.0, 0.8, g1=0.5))
"""Media in which few scatterings leave little noise in the scores."""
NAMES = ("enamel.sigma", "enamel.alpha", "enamel.g1", "enamel.beta", "dentin.sigma", "dentin.alpha", "roughness")


def recipe(roughness: float) -> SceneRecipe:
    """An ellipsoid of enamel around dentin, compensated, under five lights."""
    dentin = DentinShape.known(ellipsoid(SEMI_AXES_MM - 0.3))
    plain = single_tooth(ellipsoid(SEMI_AXES_MM), dentin, LIGHTS_MM, np.full(5, INTENSITY), "rough", 1.63)
    return replace(plain, roughness=roughness)


def by_walks_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Rough, "aims", lambda self, lights: False)  # noqa: ARG005


def images(roughness: float, seed: int, samples: int) -> StackEstimate:
    view = whole_view(camera_at((0.5, 1, 0.3)))
    return Engine(recipe(roughness), 2).images(LAYERED, view, samples=samples, seed=seed, batches=BATCHES)


@pytest.mark.parametrize(("roughness", "gain"), [(0.05, 5.0), (0.15, 4.0), (0.3, 2.0)])
def test_they_give_the_images_of_walks_alone_with_less_noise(
    monkeypatch: pytest.MonkeyPatch, roughness: float, gain: float
) -> None:
    aimed = images(roughness, 1, 512)
    by_walks_alone(monkeypatch)
    plain = images(roughness, 2, 4096)
    means, variances = (
        [getattr(one, name).reshape(-1, 8, 8) for one in (aimed, plain)] for name in ("mean", "variance")
    )
    require_same_pictures(pixel_scores(means, variances, block=2), least=40)
    # For the same number of paths; the noise of these variances is some 20 %.
    assert plain.variance.sum() * 8 > gain * aimed.variance.sum()


def test_they_give_the_derivatives_of_walks_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    view = whole_view(camera_at((0.5, 1, 0.3), size=4))

    def jacobian(seed: int, samples: int) -> JacobianEstimate:
        return Engine(recipe(0.15), 2).jacobian(CLEAR, view, NAMES, seed=seed, samples=samples, batches=BATCHES)

    aimed = jacobian(1, 4096)
    by_walks_alone(monkeypatch)
    plain = jacobian(2, 16384)
    difference = (aimed.jacobian - plain.jacobian).sum(axis=2)
    variances = [one.jacobian_variance.sum(axis=2) for one in (aimed, plain)]
    error = np.sqrt(variances[0] + variances[1])
    z = student_to_normal(difference / error, np.full(error.shape, 2.0 * (BATCHES - 1)))
    # Derivatives of one light's image have paths in common, and so have lights.
    require_unbiased(z, independent=len(NAMES))
    # Each derivative is far from zero under some light.
    assert np.max(np.abs(plain.jacobian.sum(axis=2)) / error, axis=1).min() > 2


def test_scenes_of_one_tooth_share_its_grid() -> None:
    from services.transport.scene.mesh_geometry import MeshGeometry

    prepare_device()
    one, other, ball = (MeshGeometry(scene) for scene in (recipe(0.1), recipe(0.3), scene_recipe(0.1, 1.5)))
    assert one._nearest_face is other._nearest_face
    assert one._nearest_face is not ball._nearest_face


def test_they_see_stains_and_count_scatterings_by_order(monkeypatch: pytest.MonkeyPatch) -> None:
    view = whole_view(camera_at((0.5, 1, 0.3), size=4))
    (tooth,) = recipe(0.3).teeth
    scene = replace(recipe(0.3), teeth=(replace(tooth, stain_uv=texture_coordinates()[tooth.outer.faces]),))
    tissue, edges = replace(CLEAR, stain=stain()), np.array([0, 2, 1000])

    def totals(seed: int, samples: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        engine = Engine(scene, 2)
        stained = engine.images(tissue, view, samples=samples, seed=seed, batches=BATCHES)
        orders = [
            engine.order_images(CLEAR, view, bin_edges=edges, samples=samples // 8, seed=seed + k)[0] for k in range(8)
        ]
        one = np.stack([order.sum() for order in orders])
        return (
            np.append(stained.mean.sum(axis=1), one.mean()),
            np.append(stained.variance.sum(axis=1), one.var(ddof=1) / 8),
        )

    aimed = totals(1, 4096)
    by_walks_alone(monkeypatch)
    plain = totals(11, 16384)
    z = (aimed[0] - plain[0]) / np.sqrt(aimed[1] + plain[1])
    # Student's t of few batches exceeds 5 about once in 1,000.
    assert np.abs(z).max() < 5
    # A stain is crossed twice and lets half of the light through, so that one crossing left out would be seen.
    assert (plain[0] / np.sqrt(aimed[1] + plain[1])).min() > 10


@pytest.mark.parametrize("cosine", [-0.3, 0.02, 0.2, 0.9])
@pytest.mark.parametrize("roughness", [0.05, 0.3])
def test_directions_have_the_density_that_is_stated(roughness: float, cosine: float) -> None:
    prepare_device()
    import drjit as dr
    import mitsuba as mi

    from services.transport.boundary import aiming

    count, rng = 2**18, mi.PCG32(size=2**18, initstate=3)
    normal, ior, width = mi.Vector3f(0.6, 0, 0.8), mi.Float(1.63), mi.Float(roughness)
    towards = aiming.lifted(mi.Frame3f(normal).to_world(mi.Vector3f(float(np.sqrt(1 - cosine**2)), 0, cosine)), normal)
    omega = aiming.sample(towards, normal, ior, width, rng.next_float32(), rng.next_float32())
    assert np.array(dr.norm(omega)) == pytest.approx(1, abs=1e-5)
    # The mean of 1 / density over a part of the sphere is that part's solid angle: here a cone about the bent light, as
    # far as facets bend light into it.
    axis, opening = aiming.bent(towards, normal, ior), 1 - np.cos(roughness / 3)
    around = mi.warp.square_to_uniform_cone(mi.Point2f(rng.next_float32(), rng.next_float32()), float(1 - opening))
    reached = np.array(aiming.density(mi.Frame3f(axis).to_world(around), towards, normal, ior, width)) > 0
    angle = 2 * np.pi * opening * reached.mean()
    inside = dr.dot(omega, axis) > 1 - opening
    values = np.array(dr.select(inside, 1 / aiming.density(omega, towards, normal, ior, width), 0), dtype=np.float64)
    error = np.hypot(values.std(), 2 * np.pi * opening * reached.std()) / np.sqrt(count)
    assert abs(values.mean() - angle) < 4 * error
    assert error < 0.02 * angle


def cube() -> Mesh:
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    return Mesh(corners, np.array([[q[0], q[a], q[b]] for q in quads for a, b in ((1, 2), (2, 3))], dtype=np.int32))


def nearest(mesh: Mesh, points_mm: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    prepare_device()
    import mitsuba as mi

    from services.transport.scene.nearest_face import NearestFace

    points = mi.Point3f(np.ascontiguousarray(points_mm.T, dtype=np.float32))
    normal, depth = NearestFace(mesh)(points, mi.Bool(True))
    return np.array(normal).T, np.array(depth)


def test_the_nearest_face_of_a_ball_and_of_a_cube() -> None:
    rng = np.random.default_rng(1)
    outward = rng.normal(size=(500, 3))
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    normal, depth = nearest(sphere(2.0), outward * rng.uniform(1.6, 1.95, (500, 1)))
    # From the middle, half the diagonal of a cell is seen under 0.17 / 1.6, half the distance between samples under
    # 0.15 / 2, and half a triangle under the same.
    assert np.einsum("nk,nk->n", normal, outward).min() > np.cos(0.11 + 0.08 + 0.08)
    assert normal == pytest.approx(normal / np.linalg.norm(normal, axis=1, keepdims=True), abs=1e-5)
    normal, depth = nearest(cube(), np.array([[0.85, 0.2, -0.1], [0.3, -0.55, 0.0], [0.1, 0.2, -0.999]]))
    assert normal == pytest.approx(np.array([[1, 0, 0], [0, -1, 0], [0, 0, -1]]), abs=1e-6)
    assert depth == pytest.approx([0.15, 0.45, 0.001], abs=1e-5)


@pytest.mark.parametrize(("roughness", "lights", "aims"), [(0.4, 54, True), (0.6, 54, False), (0.6, 8, True)])
def test_wide_lobes_leave_it_to_the_walks(roughness: float, lights: int, *, aims: bool) -> None:
    assert Rough(1.5, roughness, compensated=False).aims(lights) == aims
