"""The integrator plug-in compared to stock Mitsuba and to the project's own engine.

Images are compared in blocks of pixels by the rule of ``tests.support.pictures``; a correct integrator fails one run of
such a comparison in 500. Seeds are fixed.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from services.anatomy.dentin_shape import DentinShape
from services.assets.mitsuba.scene import load_scene, nested_scene, sensor_dict
from services.core.errors import DentineError, InputError, MeshError, PlatformError
from services.core.files.meshes import write_mesh
from services.core.geometry import Mesh
from services.core.records import Boundary
from services.transport.engine import Engine
from services.transport.optics.parameters import Medium, Tissue
from services.transport.platform import prepare_device
from services.transport.scene.recipe import single_tooth
from tests.support.mitsuba_variants import variant
from tests.support.pictures import BATCHES, pixel_scores, require_same_pictures
from tests.support.small_tooth import INTENSITY, LIGHTS_MM, SEMI_AXES_MM, camera_at, dentin_shape, ellipsoid, whole_view

Array = NDArray[np.float64]
SceneDict = dict[str, Any]

TISSUE = Tissue(Medium(1.5, 0.95, 0.8, 0.6, -0.3), Medium(4.0, 0.85, 1.0, 0.5))
SIZE, BLOCK = 16, 2
CAMERA = camera_at((0.2, 1, 0.1), size=SIZE, span_mm=9.0)
OUTER, SHAPE = ellipsoid(SEMI_AXES_MM), dentin_shape()
CORE = Mesh(SHAPE.vertices_mm((0.5, 0.4)), OUTER.faces)
STOCK = {"type": "prbvolpath", "max_depth": 5000, "rr_depth": 100}
LAMP = {
    "type": "rectangle",
    # The lamp is 8 mm wide, 12 mm towards the camera and above the tooth, and faces it.
    "to_world": np.array([[4.0, 0, 0, -6], [0, 0, -1, 12], [0, 4, 0, 6], [0, 0, 0, 1]]),
    "emitter": {"type": "area", "radiance": 8.0},
}
SKY = {"type": "constant", "radiance": 0.3}


def table(height_mm: float, reflectance: float | SceneDict) -> SceneDict:
    place = np.diag([40.0, 40.0, 1.0, 1.0])
    place[2, 3] = height_mm
    return {"type": "rectangle", "to_world": place, "bsdf": {"type": "diffuse", "reflectance": reflectance}}


def write_tooth(folder: Path) -> Path:
    """Write the small tooth's two surfaces into a folder, and register the plug-in."""
    prepare_device()
    from services.transport.plugin.integrator import register_integrator

    register_integrator()
    write_mesh(folder / "outer.ply", OUTER)
    write_mesh(folder / "dentin.ply", CORE)
    return folder


@pytest.fixture(scope="module")
def tooth(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the small tooth's two surfaces; the plug-in is registered."""
    return write_tooth(tmp_path_factory.mktemp("tooth"))


def properties(*tissues: Tissue, **others: Any) -> SceneDict:
    """Description of the integrator for tissues of one or three channels, with matched boundaries unless ``others``
    says otherwise.
    """
    from services.transport.plugin.integrator import medium_properties

    media = {
        k: v
        for part in ("enamel", "dentin")
        for k, v in medium_properties(part, tuple(getattr(t, part) for t in tissues or (TISSUE,))).items()
    }
    return {"type": "dentine", "enamel": "outer_11", "dentin": "dentin_11", "boundary": "matched"} | media | others


def scene_dict(folder: Path, **shapes: SceneDict) -> SceneDict:
    """Scene of the tooth in stock media under a point light, with further shapes, which stock integrators and ours can
    both render.
    """
    return (
        nested_scene({"11": (folder / "outer.ply", folder / "dentin.ply")}, TISSUE, (CAMERA,), LIGHTS_MM[0], INTENSITY)
        | shapes
    )


def render(scene: Any, integrator: SceneDict, samples: int, seed: int) -> tuple[Array, Array]:
    """Mean image and variance of the mean, both (H, W) or (H, W, 3), from independent batches."""
    import mitsuba as mi

    chosen = mi.load_dict(integrator)
    stack = np.stack(
        [
            np.array(
                mi.render(scene, integrator=chosen, spp=samples // BATCHES, seed=1009 * seed + b), dtype=np.float64
            )
            for b in range(BATCHES)
        ]
    )
    return stack.mean(axis=0).squeeze(), (stack.var(axis=0, ddof=1) / BATCHES).squeeze()


def engine_images(
    tissue: Tissue,
    light: int,
    seed: int,
    boundary: Boundary = "matched",
    intensity: float = INTENSITY,
    *,
    layered: bool = True,
) -> tuple[Array, Array]:
    """Mean image (H, W) by the project's own engine, and variance of the mean."""
    dentin = DentinShape.known(CORE) if layered else None
    engine = Engine(single_tooth(OUTER, dentin, LIGHTS_MM[[light]], np.array([intensity]), boundary))
    image = engine.images(tissue, whole_view(CAMERA), samples=512, seed=seed, batches=BATCHES)
    return image.mean[0].reshape(SIZE, SIZE), image.variance[0].reshape(SIZE, SIZE)


def compare(ours: tuple[Array, Array], truth: tuple[Array, Array], least: int = 35) -> None:
    require_same_pictures(pixel_scores([ours[0], truth[0]], [ours[1], truth[1]], BLOCK), least)


def test_teeth_among_other_things_look_as_in_mitsuba(tooth: Path) -> None:
    # The scene has connections through two teeth, lights that paths hit by chance, and light that the table reflects.
    surroundings: SceneDict = {"table": table(-4.05, 0.5), "lamp": LAMP, "sky": SKY}
    scene = scene_dict(tooth, **surroundings)
    for surface in ("outer", "dentin"):
        beside = np.eye(4)
        beside[0, 3] = -6.5
        scene[f"{surface}_12"] = scene[f"{surface}_11"] | {"to_world": beside}
    loaded = load_scene(scene)
    ours = render(loaded, properties(enamel="outer_11, outer_12", dentin="dentin_11, dentin_12"), 256, 1)
    compare(ours, render(loaded, STOCK, 256, 2), least=50)


@pytest.mark.parametrize(("boundary", "layered"), [("thin", True), ("matched", False)])
def test_point_lights_give_the_engines_images(tooth: Path, boundary: Boundary, layered: bool) -> None:
    scene = scene_dict(tooth, second={"type": "point", "position": LIGHTS_MM[3].tolist(), "intensity": INTENSITY})
    ours = properties(boundary=boundary)
    if not layered:
        ours = {name: value for name, value in ours.items() if not name.startswith("dentin")}
        del scene["dentin_11"]
    # One run per light, so that the variances add.
    runs = [engine_images(TISSUE, light, 30 + light, boundary, layered=layered) for light in (0, 3)]
    compare(render(load_scene(scene), ours, 512, 4), (runs[0][0] + runs[1][0], runs[0][1] + runs[1][1]))


def test_without_a_tooth_in_sight_it_is_a_path_tracer(tooth: Path) -> None:
    # The tooth lies below the table; on the table are a ball of rough glass and one of metal.
    sensor = sensor_dict(CAMERA)
    sensor["to_world"][2, 3] += 6.3
    ball = {"type": "sphere", "radius": 1.2}
    surroundings = {
        "table": table(5.0, {"type": "checkerboard", "color0": 0.2, "color1": 0.7}),
        "glass": ball | {"center": [-1.5, 0, 6.3], "bsdf": {"type": "roughdielectric", "alpha": 0.2}},
        "metal": ball | {"center": [1.5, 0, 6.3], "bsdf": {"type": "roughconductor", "alpha": 0.3}},
        "lamp": LAMP,
        "sky": SKY,
        "camera_c0": sensor,
    }
    scene = load_scene(scene_dict(tooth, **surroundings))
    compare(render(scene, properties(), 512, 5), render(scene, {"type": "path", "max_depth": -1}, 512, 6), least=50)


def test_each_colour_has_its_own_media(tooth: Path) -> None:
    # Compare each channel to the engine, which renders one channel at a time.
    from services.transport.plugin.integrator import register_integrator

    tissues = (
        TISSUE,
        Tissue(Medium(0.8, 0.99, g1=0.3), Medium(6.0, 0.5, g1=0.1)),
        Tissue(Medium(3.0, 0.6, g1=-0.4), Medium(1.0, 0.99, 0.5, 0.7, -0.2)),
    )
    scene = scene_dict(tooth)
    scene["camera_c0"]["film"]["pixel_format"] = "rgb"
    scene["light"]["intensity"] = {"type": "rgb", "value": [INTENSITY, 2 * INTENSITY, 3 * INTENSITY]}
    with variant("llvm_ad_rgb"):
        register_integrator()
        mean, variance = render(load_scene(scene), properties(*tissues), 768, 7)
    for channel, tissue in enumerate(tissues):
        truth = engine_images(tissue, light=0, seed=40 + channel, intensity=(channel + 1) * INTENSITY)
        compare((mean[..., channel], variance[..., channel]), truth)


def white(tissue: Tissue) -> Tissue:
    return Tissue(replace(tissue.enamel, alpha=1.0), replace(tissue.dentin, alpha=1.0))


def test_a_white_tooth_vanishes_in_a_uniform_room(tooth: Path) -> None:
    scene = load_scene(scene_dict(tooth, light={"type": "constant"}))
    mean, variance = render(scene, properties(white(TISSUE)), 512, 8)
    compare((mean, variance), (np.ones_like(mean), np.zeros_like(mean)))


def test_a_thin_face_gives_back_what_it_keeps_out(tooth: Path) -> None:
    # With its mirror reflection the white tooth is invisible again, except for the energy that a model of single
    # bounces between facets loses, here far below 0.5 %; without the reflection it is darker. In sparse media much
    # light is reflected inside and leaves without another scattering.
    sparse = Tissue(Medium(0.2, 1.0, g1=0.3), Medium(0.4, 1.0))
    scene = load_scene(scene_dict(tooth, light={"type": "constant"}))
    brightness = []
    for roughness in ({"roughness": 0.02}, {}):
        mean, variance = render(scene, properties(sparse, boundary="thin", **roughness), 1024, 9)
        seen = variance > 0
        assert np.sqrt(variance[seen].sum()) / seen.sum() < 0.005 / 3
        brightness.append(mean[seen].mean())
    assert abs(brightness[0] - 1) < 0.005
    # At any angle to the viewer the face reflects at least as much as at normal incidence.
    assert brightness[1] < 1 - ((1.631 - 1) / (1.631 + 1)) ** 2 + 0.005


def test_a_mirror_image_is_that_of_rough_plastic(tooth: Path) -> None:
    # Compare a tooth so dense and dark that only its outer face is visible to stock plastic without a diffuse base.
    scene = scene_dict(tooth, table=table(-4.05, 0.5), lamp=LAMP, sky=SKY)
    dark = properties(Tissue(Medium(50.0, 0.0), Medium(50.0, 0.0)), boundary="thin", roughness=0.3)
    ours = render(load_scene(scene), dark, 256, 11)
    plastic = {
        "type": "roughplastic",
        "distribution": "ggx",
        "alpha": 0.3,
        "int_ior": 1.631,
        "ext_ior": 1.0,
        "diffuse_reflectance": 0.0,
    }
    del scene["dentin_11"]
    scene["outer_11"] = {"type": "ply", "filename": str(tooth / "outer.ply"), "face_normals": True, "bsdf": plastic}
    compare(ours, render(load_scene(scene), {"type": "path", "max_depth": -1}, 256, 12), least=50)


def test_a_moved_tooth_is_seen_where_it_is(tooth: Path) -> None:
    import mitsuba as mi

    scene = load_scene(scene_dict(tooth))
    integrator = mi.load_dict(properties())
    before = np.array(mi.render(scene, integrator=integrator, spp=64, seed=1))[..., 0]
    arrays = mi.traverse(scene)
    for shape in ("outer_11", "dentin_11"):
        vertices = arrays[f"{shape}.vertex_positions"].numpy().reshape(-1, 3)
        arrays[f"{shape}.vertex_positions"] = mi.Float((vertices + np.array([0, 0, 1.5], dtype=np.float32)).reshape(-1))
    arrays.update()
    after = np.array(mi.render(scene, integrator=integrator, spp=64, seed=1))[..., 0]
    fresh = np.array(mi.render(scene, integrator=mi.load_dict(properties()), spp=64, seed=1))[..., 0]
    np.testing.assert_array_equal(after, fresh)
    assert not np.array_equal(after, before)


def sentence(problem: BaseException) -> str:
    """Message of the project's error inside an exception of Mitsuba, which keeps an error while rendering as the cause
    and puts an error while loading into its text.
    """
    while problem.__cause__ is not None and not isinstance(problem, DentineError):
        problem = problem.__cause__
    return str(problem)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"enamel_alpha": 1.2}, "enamel.alpha = 1.2 must lie in 0 to 1; correct it."),
        ({"dentin_sigma": 0.0}, "dentin.sigma = 0 must be positive"),
        ({"enamel_g1": [0.1, 0.2, 0.3]}, "enamel_g1 has 3 values"),
        ({"enamel_sigma": "thick"}, "enamel_sigma = thick is no number"),
        ({"enamel": ""}, "needs 'enamel'"),
        ({"dentin": ""}, "is given but no dentin surface"),
        ({"enamel_sigmas": 1.0}, "no property 'enamel_sigmas'"),
        ({"boundary": "rough"}, "boundary = rough must be"),
        ({"roughness": 0.1}, "no mirror image"),
        ({"boundary": "thin", "roughness": 3.0}, "roughness = 3.0 must lie in 0.001 to 1"),
        ({"ior": 0.5}, "ior = 0.5 must be at least 1"),
        ({"max_depth": 0}, "max_depth = 0 must be"),
    ],
)
def test_impossible_properties_are_refused(tooth: Path, given: SceneDict, words: str) -> None:
    import mitsuba as mi

    from services.transport.plugin.integrator import read_properties

    wrong = {name: value for name, value in (properties() | given).items() if name != "type"}
    with pytest.raises(InputError) as refused:
        read_properties(wrong, channels=1)
    assert words in str(refused.value)
    with pytest.raises(RuntimeError, match="InputError") as loading:
        mi.load_dict({"type": "dentine"} | wrong)
    assert str(loading.value).rstrip().endswith(str(refused.value))


def test_impossible_scenes_are_refused(tooth: Path, tmp_path: Path) -> None:
    import mitsuba as mi

    write_mesh(tmp_path / "open.ply", Mesh(OUTER.vertices_mm, OUTER.faces[:-2]))
    write_mesh(tmp_path / "inverted.ply", Mesh(OUTER.vertices_mm, OUTER.faces[:, ::-1]))
    shapes: dict[str, SceneDict] = {
        "open": {"type": "ply", "filename": str(tmp_path / "open.ply")},
        "inverted": {"type": "ply", "filename": str(tmp_path / "inverted.ply")},
        "ball": {"type": "sphere"},
        "shining": {"type": "ply", "filename": str(tooth / "outer.ply"), "emitter": {"type": "area"}},
    }
    scene = load_scene(scene_dict(tooth, **shapes))
    for name, kind, words in (
        ("molar", InputError, "no shape 'molar' but ball, dentin_11"),
        ("open", MeshError, "is not watertight"),
        ("inverted", MeshError, "is inside out"),
        ("ball", InputError, "no triangle mesh"),
        ("shining", InputError, "is a light"),
    ):
        with pytest.raises(RuntimeError) as refused:
            mi.render(scene, integrator=mi.load_dict(properties(enamel=name)), spp=1)
        assert words in sentence(refused.value), kind


def test_a_variant_without_arrays_is_refused(tooth: Path) -> None:
    from services.transport.plugin.integrator import register_integrator

    with variant("scalar_rgb"), pytest.raises(PlatformError, match="not scalar_rgb"):
        register_integrator()


def test_derivatives_are_refused(tooth: Path) -> None:
    import drjit as dr
    import mitsuba as mi

    scene = load_scene(scene_dict(tooth))
    values = mi.traverse(scene)
    dr.enable_grad(values["light.intensity.value"])
    image = mi.render(scene, params=values, integrator=mi.load_dict(properties()), spp=1)
    with pytest.raises(InputError, match="gives images only"):
        dr.backward(dr.sum(image))


def test_an_instance_beside_the_tooth_is_no_tooth(tooth: Path) -> None:
    # Shapes in a shape group are not among the scene's shapes.
    ball = {"type": "sphere", "radius": 1.0, "center": [2.5, 3.0, 3.5], "bsdf": {"type": "diffuse"}}
    group = {"type": "shapegroup", "ball": ball}
    scenes = ({"group": group, "copy": {"type": "instance", "group": {"type": "ref", "id": "group"}}}, {"ball": ball})
    instance, shape = (render(load_scene(scene_dict(tooth, **shapes)), properties(), 64, 10)[0] for shapes in scenes)
    np.testing.assert_allclose(instance, shape, rtol=1e-4)


def png_pixels(path: Path) -> NDArray[np.uint8]:
    from PIL import Image

    with Image.open(path) as image:
        return np.asarray(image)


def test_the_gallery_shows_a_tooth_on_a_table(tooth: Path, tmp_path: Path) -> None:
    from services.bench.figures.gallery import main

    with variant("llvm_ad_rgb"):
        status = main(
            ["--out", str(tmp_path), "--views", "front", "backlit", "--surfaces", "thin", "--size", "20", "25",
             "--samples", "32"]
        )  # fmt: skip
    assert status == 0
    front, backlit = (png_pixels(tmp_path / f"{view}.png").astype(float) for view in ("front", "backlit"))
    assert front.shape == (25, 20, 3)
    tooth_region, corner = (slice(8, 17), slice(8, 12)), (slice(0, 4), slice(0, 4))
    assert front[tooth_region].mean() > 1.5 * front[corner].mean()
    # With light from behind, dentin is darker and yellower than the enamel of the edge above it.
    edge, core = backlit[6:8, 9:12].mean(axis=(0, 1)), backlit[14:18, 9:12].mean(axis=(0, 1))
    assert edge.mean() > 1.3 * core.mean()
    assert core[0] / core[2] > 1.1 * edge[0] / edge[2]


def test_the_gallery_renders_a_scene_of_ones_own(
    tooth: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from services.assets.mitsuba.scene_xml import write_scene
    from services.bench.figures.gallery import main

    scene = tmp_path / "scene.xml"
    write_scene(scene, scene_dict(tooth))
    arguments = ["--out", str(tmp_path), "--scene", str(scene), "--samples", "1", "--enamel"]
    with variant("llvm_ad_rgb"):
        assert main([*arguments, "outer_11", "--core", "dentin_11"]) == 0
        assert main([*arguments, "molar"]) == InputError.exit_status
    assert png_pixels(tmp_path / "camera_c0.png").std() > 0
    assert capsys.readouterr().err.startswith("gallery: The scene has no shape 'molar' but ")
