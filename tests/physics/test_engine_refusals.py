"""The engine and the slab refuse impossible input before any kernel runs, with a sentence that names parameter and
value.
"""

from __future__ import annotations

import math
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from services.core.errors import DentineError, InputError, MeshError, NonFiniteError, PlatformError
from services.core.geometry import Mesh
from services.slab.simulate import Layer, simulate_slab
from services.transport.engine import Engine
from services.transport.optics.parameters import Medium, Mouth, Tissue
from services.transport.platform import require_llvm
from services.transport.scene.recipe import SceneRecipe, ToothSurfaces, View, single_tooth
from tests.support.small_mouth import MOUTH, mouth_recipe, wall
from tests.support.small_tooth import LIGHTS_MM, SEMI_AXES_MM, camera_at, dentin_shape, ellipsoid, recipe, whole_view

TISSUE = Tissue(Medium(2, 0.9, 0.9, 0.6, -0.2), Medium(4, 0.8), (0.5, 0.4))

FORBIDDEN = [
    ("sigma", 0.0, "0"), ("sigma", -3.0, "-3"), ("sigma", math.inf, "inf"), ("sigma", math.nan, "nan"),
    ("sigma", 1e39, "1e+39"), ("sigma", 1e-50, "1e-50"), ("g1", 0.999999999, "0.999999999"),
    ("g2", -0.999999999, "-0.999999999"), ("alpha", -0.1, "-0.1"), ("alpha", 1.001, "1.001"),
    ("alpha", math.nan, "nan"), ("beta", -0.2, "-0.2"), ("beta", 1.5, "1.5"),
    ("g1", 1.0, "1"), ("g1", -1.0, "-1"), ("g2", 1.7, "1.7"), ("g2", -math.inf, "-inf"),
]  # fmt: skip


@pytest.fixture(scope="module")
def engine() -> Engine:
    return Engine(recipe())


@pytest.fixture
def no_kernel(monkeypatch: pytest.MonkeyPatch, engine: Engine) -> None:
    """Make the test fail if a walk is traced."""
    from services.transport.paths.walk import Walk

    def refuse(*_: Any) -> None:
        raise AssertionError("a kernel ran")

    monkeypatch.setattr(Walk, "run", refuse)


def require_sentence(error: DentineError, *parts: str) -> None:
    """Assert that an error's message is on one line, ends with a full stop and contains the parts."""
    assert all(part in error.message for part in parts), error.message
    assert error.message.endswith(".")
    assert "\n" not in error.message


@pytest.mark.parametrize(("field", "value", "shown"), FORBIDDEN)
@pytest.mark.parametrize("part", ["enamel", "dentin"])
def test_a_tissue_out_of_range_is_refused(
    engine: Engine, no_kernel: None, part: str, field: str, value: float, shown: str
) -> None:
    tissue = TISSUE.with_values({f"{part}.{field}": value})
    view = whole_view(camera_at((0, 1, 0)))
    for call in (
        lambda: engine.images(tissue, view, samples=1, seed=1),
        lambda: engine.jacobian(tissue, view, ("enamel.sigma",), samples=1, seed=1),
    ):
        with pytest.raises(InputError) as caught:
            call()
        require_sentence(caught.value, f"{part}.{field} = {shown} ")


@pytest.mark.parametrize("shape", [(), (0.5,), (0.5, math.nan), (-0.5, 0.5), (0.2, 1.01), (math.inf, 0.0)])
def test_blend_weights_that_do_not_fit_are_refused(engine: Engine, no_kernel: None, shape: tuple[float, ...]) -> None:
    with pytest.raises(InputError) as caught:
        engine.images(replace(TISSUE, shape=shape), whole_view(camera_at((0, 1, 0))), samples=1, seed=1)
    require_sentence(caught.value, "shape", str(shape))


def test_an_empty_pixel_list_is_refused(engine: Engine, no_kernel: None) -> None:
    view = View(camera_at((0, 1, 0)), np.zeros((0, 2), dtype=np.int32))
    with pytest.raises(InputError) as caught:
        engine.images(TISSUE, view, samples=1, seed=1)
    require_sentence(caught.value, "c0", "no pixel")


@pytest.mark.parametrize("pixel", [(8, 0), (0, 8), (-1, 3)])
def test_a_pixel_outside_the_image_is_refused(engine: Engine, no_kernel: None, pixel: tuple[int, int]) -> None:
    view = View(camera_at((0, 1, 0)), np.array([(2, 2), pixel], dtype=np.int32))
    with pytest.raises(InputError) as caught:
        engine.images(TISSUE, view, samples=1, seed=1)
    require_sentence(caught.value, "c0", str(pixel), "8 x 8")


def test_a_camera_in_metres_is_refused(engine: Engine, no_kernel: None) -> None:
    view = whole_view(camera_at((0, 1, 0), distance_mm=0.6))
    with pytest.raises(InputError) as caught:
        engine.images(TISSUE, view, samples=1, seed=1)
    require_sentence(caught.value, "c0", "(0, 0.6, 0) mm", "in millimetres")


@pytest.mark.parametrize("lights", [(), (5,), (-1,), (2, 2)])
def test_lights_that_do_not_exist_are_refused(engine: Engine, no_kernel: None, lights: tuple[int, ...]) -> None:
    view = replace(whole_view(camera_at((0, 1, 0))), lights=lights)
    with pytest.raises(InputError) as caught:
        engine.images(TISSUE, view, samples=1, seed=1)
    require_sentence(caught.value, "c0", f"lights = {lights}")


@pytest.mark.parametrize("counts", [{"samples": 0}, {"samples": -4}, {"samples": 8, "batches": 0}])
def test_counts_of_paths_that_are_not_positive_are_refused(
    engine: Engine, no_kernel: None, counts: dict[str, int]
) -> None:
    with pytest.raises(InputError) as caught:
        engine.images(TISSUE, whole_view(camera_at((0, 1, 0))), seed=1, **counts)
    require_sentence(caught.value, *(f"{name} = {value}" for name, value in counts.items()))


def test_an_unknown_parameter_is_refused(engine: Engine, no_kernel: None) -> None:
    with pytest.raises(InputError) as caught:
        engine.jacobian(TISSUE, whole_view(camera_at((0, 1, 0))), ("dentin.roughness",), samples=1, seed=1)
    require_sentence(caught.value, "dentin.roughness", "dentin.sigma", "shape.1")


def with_light(
    number: int, *, intensity: float = 1.0, position: tuple[float, float, float] = (0.0, 600.0, 0.0)
) -> SceneRecipe:
    """The small tooth with one light replaced."""
    positions, intensities = LIGHTS_MM.copy(), np.ones(len(LIGHTS_MM))
    positions[number], intensities[number] = position, intensity
    return replace(recipe(), light_positions_mm=positions, light_intensities=intensities)


def with_dentin(mesh: Mesh) -> SceneRecipe:
    """The small tooth with another surface as its dentin's base."""
    return replace(recipe(), teeth=(ToothSurfaces(ellipsoid(SEMI_AXES_MM), replace(dentin_shape(), base=mesh)),))


def test_dentin_that_breaks_through_the_enamel_is_refused() -> None:
    base = dentin_shape().base
    aside, larger = Mesh(base.vertices_mm + np.array([1.0, 0, 0]), base.faces), Mesh(base.vertices_mm * 1.2, base.faces)
    # One cusp of an otherwise nested surface breaks through.
    top = np.argmax(base.vertices_mm[:, 2])
    spike = Mesh(base.vertices_mm + 0.5 * np.eye(3)[2] * (np.arange(len(base.vertices_mm)) == top)[:, None], base.faces)
    for mesh in (aside, larger, spike):
        with pytest.raises(MeshError) as caught:
            Engine(with_dentin(mesh))
        require_sentence(caught.value, "dentin surface", "outer surface", "mm")


def test_lights_that_give_no_light_are_refused() -> None:
    scene = recipe()
    dark = replace(scene, light_positions_mm=np.zeros((0, 3)), light_intensities=np.zeros(0))
    for wrong, part in (
        (dark, "no light"),
        (with_light(3, intensity=-1.0), "Light 3 has intensity = -1,"),
        (with_light(2, intensity=0.0), "Light 2 has intensity = 0,"),
        (with_light(4, intensity=math.nan), "Light 4 has intensity = nan,"),
        (with_light(1, position=(0.0, math.inf, 0.0)), "Light 1 has position_mm = [0.0, inf, 0.0]"),
        (with_light(0, position=(0.0, 1.0, 0.5)), "Light 0 at position_mm = [0.0, 1.0, 0.5]"),
        (replace(scene, light_positions_mm=LIGHTS_MM * 1e-3), "in millimetres"),
        (replace(scene, ior=0.7), "ior = 0.7"),
        (replace(scene, ior=math.nan), "ior = nan"),
    ):
        with pytest.raises(InputError) as caught:
            Engine(wrong)
        require_sentence(caught.value, part)


def test_surfaces_that_bound_nothing_are_refused() -> None:
    scene = recipe()
    outer = scene.teeth[0].outer
    hole = Mesh(outer.vertices_mm, outer.faces[1:])
    flipped = Mesh(outer.vertices_mm, outer.faces[:, ::-1].copy())
    in_metres = Mesh(outer.vertices_mm * 1e-3, outer.faces)
    in_micrometres = Mesh(outer.vertices_mm * 1e3, outer.faces)
    broken = Mesh(np.where(outer.vertices_mm == outer.vertices_mm[0], np.nan, outer.vertices_mm), outer.faces)
    for mesh, part in (
        (hole, "3 edges"),
        (flipped, "inside out"),
        (in_metres, "millimetres"),
        (in_micrometres, "millimetres"),
        (broken, "non-finite"),
    ):
        with pytest.raises(MeshError) as caught:
            Engine(replace(scene, teeth=(ToothSurfaces(mesh, scene.teeth[0].dentin),)))
        require_sentence(caught.value, "outer surface", part)
        with pytest.raises(MeshError) as caught:
            Engine(with_dentin(mesh))
        require_sentence(caught.value, "dentin surface", part)


@pytest.mark.parametrize(
    ("version", "parts"),
    [
        ((-1, -1, -1), ("No libLLVM",)),
        ((13, 0, 0), ("13.0", "17")),
        ((15, 0, 7), ("15.0", "17")),
        ((16, 0, 6), ("16.0", "17")),
    ],
)
def test_a_libllvm_that_would_crash_is_refused(version: tuple[int, int, int], parts: tuple[str, ...]) -> None:
    with pytest.raises(PlatformError) as caught:
        require_llvm(version)
    require_sentence(caught.value, *parts, "libllvm19")
    assert caught.value.exit_status == 4


@pytest.mark.parametrize(
    ("before", "sentence"),
    [
        ("pass", "No libLLVM was found"),
        ("import drjit; drjit.detail.llvm_version = lambda: (15, 0, 7)", "libLLVM 15.0 would crash the renderer"),
    ],
)
def test_an_unusable_libllvm_ends_with_a_sentence(tmp_path: Path, before: str, sentence: str) -> None:
    # Test the whole way in new processes: one cannot load the library, because the file is empty; the other reports an
    # old version.
    library = tmp_path / "libLLVM.so"
    library.touch()
    script = (
        f"{before}; from services.transport.engine import Engine; from tests.support.small_tooth import recipe;"
        " Engine(recipe())"
    )
    root = Path(__file__).resolve().parents[2]
    ended = subprocess.run(
        [sys.executable, "-c", script],
        cwd=root,
        env=os.environ | {"DRJIT_LIBLLVM_PATH": str(library)},
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert ended.returncode == 1
    last = ended.stderr.strip().splitlines()[-1]
    assert f"PlatformError: {sentence}" in last
    assert last.endswith("DRJIT_LIBLLVM_PATH to such a libLLVM.so.")


def test_libllvm_17_and_later_are_accepted() -> None:
    for major in (17, 18, 19, 22):
        require_llvm((major, 1, 0))


@pytest.mark.parametrize(("field", "value", "shown"), FORBIDDEN)
def test_a_layer_out_of_range_is_refused(no_kernel: None, field: str, value: float, shown: str) -> None:
    layer = Layer(sigma=1, alpha=0.5, thickness_mm=1)
    with pytest.raises(InputError) as caught:
        simulate_slab((layer, layer.model_copy(update={field: value})))
    require_sentence(caught.value, f"layer 2.{field} = {shown} ")


def test_slabs_that_make_no_sense_are_refused(no_kernel: None) -> None:
    layer = Layer(sigma=1, alpha=0.5, thickness_mm=1)
    deep, white = (
        layer.model_copy(update={"thickness_mm": math.inf}),
        layer.model_copy(update={"alpha": 1.0, "thickness_mm": math.inf}),
    )
    calls: list[tuple[tuple[Layer, ...], dict[str, Any], str]] = [
        ((), {}, "no layer"),
        ((layer.model_copy(update={"thickness_mm": 0.0}),), {}, "thickness_mm = 0"),
        ((layer.model_copy(update={"thickness_mm": -1.0}),), {}, "thickness_mm = -1"),
        ((deep, layer), {}, "layer 1.thickness_mm = inf"),
        ((white,), {}, "half space"),
        ((layer,), {"ior": 0.5}, "ior = 0.5"),
        ((layer,), {"ior": math.nan}, "ior = nan"),
        ((layer,), {"boundary": "glass"}, "boundary = glass"),
        ((layer,), {"source": "laser"}, "source = laser"),
        ((layer,), {"rel_error": 0.0}, "rel-error = 0"),
        ((layer,), {"mu_incident": 0.0}, "mu-incident = 0"),
        ((layer,), {"mu_incident": math.nan}, "mu-incident = nan"),
        ((layer,), {"mu_incident": 0.5, "source": "diffuse"}, "mu-incident = 0.5 is for a beam"),
        ((layer,), {"exit_cosines": (0.5, 1.5)}, "exit-cosines has 1.5"),
        ((layer,), {"ring_edges_mm": (0.5, 0.5)}, "ring-edges = 0.5, 0.5"),
        ((layer,), {"ring_edges_mm": (0.5, math.inf)}, "ring-edges = 0.5, inf"),
    ]
    for layers, options, part in calls:
        with pytest.raises(InputError) as caught:
            simulate_slab(layers, **options)
        require_sentence(caught.value, part)


@pytest.mark.parametrize("wrong", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("derivative", [False, True])
def test_a_result_that_is_not_finite_raises_with_its_pixels(
    engine: Engine, monkeypatch: pytest.MonkeyPatch, wrong: float, derivative: bool
) -> None:
    from services.transport.paths.tally import Tally

    view, broken = whole_view(camera_at((0, 1, 0))), [5, 11, 40, 63]
    honest = Tally.arrays

    def spoil(tally: Tally) -> tuple[NDArray[np.float64], list[NDArray[np.float64]]]:
        # One path of one light in the last batch of each of these pixels.
        sums, derivatives = honest(tally)
        table = derivatives[1] if derivative else sums
        table[[len(table) - len(view) + k for k in broken], 2] = wrong
        return sums, derivatives

    monkeypatch.setattr(Tally, "arrays", spoil)
    with pytest.raises(NonFiniteError) as caught:
        engine.jacobian(TISSUE, view, ("enamel.alpha", "dentin.sigma"), samples=4, seed=1)
    require_sentence(caught.value, "4 of 64 pixels", "c0", "(5, 0), (3, 1), (0, 5)")
    assert caught.value.exit_status == 6


def test_a_mesh_alone_knows_its_volume_and_edges() -> None:
    # The refusals above need the volume: that of an ellipsoid of 3, 2, 4 mm, less the part that flat facets cut off.
    mesh = ellipsoid(np.array([3.0, 2.0, 4.0]))
    assert mesh.signed_volume_mm3() == pytest.approx(4 / 3 * np.pi * 24, rel=0.02)
    assert (mesh.edge_counts() == 2).all()
    assert isinstance(single_tooth(mesh, None, LIGHTS_MM, np.ones(5)).teeth[0].outer, Mesh)


def mouth_scene(**changes: Any) -> SceneRecipe:
    return replace(mouth_recipe("thin"), **changes)


@pytest.fixture(scope="module")
def whole_mouth() -> Engine:
    return Engine(mouth_scene())


@pytest.mark.parametrize(
    ("changes", "facts"),
    [
        ({"teeth": ()}, ("0 teeth", "1 to 15")),
        ({"teeth": (ToothSurfaces(ellipsoid(SEMI_AXES_MM)),) * 16}, ("16 teeth", "1 to 15")),
        (
            {"teeth": (ToothSurfaces(ellipsoid(SEMI_AXES_MM)), ToothSurfaces(wall()))},
            ("outer surface of tooth 1", "not watertight"),
        ),
        ({"gums": wall()}, ("gums", "not watertight")),
        ({"cavity": Mesh(1e-3 * wall().vertices_mm, wall().faces)}, ("cavity", "0.016 units", "millimetres")),
        ({"cavity": Mesh(wall().vertices_mm, wall().faces[:0])}, ("cavity", "no faces")),
        ({"gums_ior": 0.9}, ("gums_ior = 0.9", "at least 1")),
    ],
)
def test_parts_that_no_mouth_has_are_refused(no_kernel: None, changes: dict[str, Any], facts: tuple[str, ...]) -> None:
    with pytest.raises(DentineError) as caught:
        Engine(mouth_scene(**changes))
    require_sentence(caught.value, *facts)


@pytest.mark.parametrize(
    ("mouth", "facts"),
    [
        (replace(MOUTH, teeth=MOUTH.teeth[:1]), ("1 teeth", "scene of 2")),
        (replace(MOUTH, gums=None), ("gums", "none")),
        (replace(MOUTH, gums=Medium(1, 1.5)), ("gums.alpha = 1.5", "0 to 1")),
        (replace(MOUTH, reflectance=None), ("cavity", "no reflectance")),
        (replace(MOUTH, reflectance=1.2), ("cavity.reflectance = 1.2", "0 to 1")),
        (
            replace(MOUTH, teeth=(MOUTH.teeth[0], Tissue(Medium(-1, 0.5), Medium(1, 0.5)))),
            ("1.enamel.sigma = -1", "positive"),
        ),
    ],
)
def test_media_that_do_not_belong_to_the_scene_are_refused(
    whole_mouth: Engine, no_kernel: None, mouth: Mouth, facts: tuple[str, ...]
) -> None:
    with pytest.raises(InputError) as caught:
        whole_mouth.images(mouth, whole_view(camera_at((0, 1, 0))), samples=1, seed=1)
    require_sentence(caught.value, *facts)
