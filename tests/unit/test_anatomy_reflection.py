"""The enamel's reflection: compared with Mitsuba's rough dielectric, and its energy."""

from __future__ import annotations

import numpy as np
import pytest

from services.anatomy.templates.incisor import build_incisor
from services.phantom.dome_rig import dome_cameras, dome_lights
from services.phantom.reflection import ggx_reflection, reflect
from services.transport.optics.ggx_albedo import fresnel_reflectance
from services.transport.platform import prepare_device
from services.transport.rays import RayScene

NORMAL = np.array([0.0, 0.0, 1.0])


def hemisphere(count: int, seed: int) -> np.ndarray:
    """Uniform directions on the hemisphere about the normal."""
    random = np.random.default_rng(seed)
    cosine, turn = random.uniform(0.02, 1, count), random.uniform(0, 2 * np.pi, count)
    sine = np.sqrt(1 - cosine**2)
    return np.stack([sine * np.cos(turn), sine * np.sin(turn), cosine], axis=-1)


@pytest.mark.parametrize("roughness", [0.12, 0.4])
def test_reflection_equals_mitsubas_rough_dielectric(roughness: float) -> None:
    prepare_device()
    import drjit as dr
    import mitsuba as mi

    to_light, to_eye = hemisphere(4000, 0), hemisphere(4000, 1)
    bsdf = mi.load_dict(
        {"type": "roughdielectric", "distribution": "ggx", "alpha": roughness, "int_ior": 1.631, "ext_ior": 1.0}
    )
    si = dr.zeros(mi.SurfaceInteraction3f, len(to_eye))
    si.wi = mi.Vector3f(to_eye.T.astype(np.float32))
    value = bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(to_light.T.astype(np.float32)))
    dr.eval(value)
    ours = ggx_reflection(np.broadcast_to(NORMAL, to_light.shape), to_light, to_eye, roughness, 1.631) * to_light[:, 2]
    # Single precision of the peer: 1e-7 times the peak's steepness, 1 / roughness^4.
    np.testing.assert_allclose(ours, np.array(value)[0], rtol=2e-3, atol=1e-5)


def test_normal_incidence_reflects_the_textbook_share() -> None:
    assert fresnel_reflectance(np.array([1.0]), 1.631)[0] == pytest.approx((0.631 / 2.631) ** 2)
    assert fresnel_reflectance(np.array([0.0]), 1.631)[0] == pytest.approx(1.0)


def test_pixels_off_the_tooth_reflect_nothing_and_shadow_side_is_dark() -> None:
    tooth = build_incisor()
    (camera,) = dome_cameras(1, 1.0, (tooth.outer,))
    lights = dome_lights(6, ("green",), seed=1)
    seen = reflect(tooth.outer, None, camera, lights, ("green",), 1.631)
    assert seen.highlight.shape == (6, *camera.size[::-1], 1)
    assert not seen.highlight[:, ~seen.enamel_pixels].any()
    assert (seen.enamel_share == 1).all()
    assert not seen.gums.any()
    # The last light stands behind the tooth's plane: its mirror direction never meets the frontal camera except at the
    # rim.
    assert seen.highlight[-1].sum() < 0.5 * seen.highlight[0].sum()


def test_gums_hide_the_root_and_scatter_diffusely() -> None:
    tooth = build_incisor()
    (camera,) = dome_cameras(1, 1.0, (tooth.outer,))
    lights = dome_lights(2, ("red", "green", "blue"), seed=1)
    seen = reflect(tooth.outer, tooth.gums, camera, lights, ("red", "green", "blue"), 1.631)
    rows = np.where(
        seen.enamel_pixels.any(axis=1),
        np.nanmin(np.where(seen.enamel_pixels, seen.enamel_share, np.nan), axis=1, initial=1),
        1,
    )
    # The root stub is the upper fifth of the picture, the incisal third is free.
    assert rows[2] == 0
    assert (rows[2 * len(rows) // 3 :] == 1).all()
    gums = seen.gums[0, 2, camera.size[0] // 2]
    assert gums[0] > gums[1] > gums[2] > 0
    # A Lambertian surface cannot send more than reflectance / pi of the irradiance of 1.1 at most.
    assert gums[0] < 1.1 * 0.5 / np.pi


def test_a_light_that_no_visible_point_faces_reflects_nothing() -> None:
    # As with a grazing light and a tooth that the gums almost cover: no shadow ray remains to be traced.
    incisor, (camera,), (light,) = (
        build_incisor(),
        dome_cameras(1, 1.0, (build_incisor().outer,)),
        dome_lights(1, ("green",), 1),
    )
    behind = light.model_copy(update={"position_mm": (0.0, -1000.0, 0.0)})
    seen = reflect(incisor.outer, None, camera, (behind,), ("green",), 1.631)
    assert seen.enamel_pixels.any()
    assert (
        seen.highlight.max() < 1e-3 * reflect(incisor.outer, None, camera, (light,), ("green",), 1.631).highlight.max()
    )


def test_no_ray_hits_nothing() -> None:
    hits = RayScene(build_incisor().outer).first_hits(np.zeros((0, 3)), np.zeros((0, 3)))
    assert hits.hit.shape == (0,)
    assert hits.normals.shape == (0, 3)
