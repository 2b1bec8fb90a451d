"""Stains: images compared to stock Mitsuba, where a stain is a mask over black, and derivatives to texels compared to
central differences.

The rule for images is that of ``tests.support.pictures``; a correct engine fails one run in 500, and seeds are fixed.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from services.anatomy.dentin_shape import DentinShape
from services.assets.mitsuba.scene import load_scene, nested_scene, render_batches
from services.core.errors import InputError
from services.core.files.meshes import write_mesh
from services.core.geometry import Mesh
from services.core.records import Boundary
from services.transport.engine import Engine
from services.transport.optics.parameters import Medium, Stain, Tissue
from services.transport.platform import prepare_device
from tests.support.pictures import BATCHES, pixel_scores, require_same_pictures
from tests.support.small_tooth import INTENSITY, LIGHTS_MM, camera_at, recipe, whole_view
from tests.support.stained_tooth import WIDTH, stain, stained_recipe, texture_coordinates

TISSUE = Tissue(Medium(1.5, 0.95, 0.8, 0.6, -0.3), Medium(4.0, 0.85, 1.0, 0.5), (0.5, 0.4), stain())
SEEDS = 8
FALSE_ALARM = 1e-3
"""Chance that any of the t-tests of a test fails a correct engine (Bonferroni)."""


@pytest.mark.parametrize("size", [8, pytest.param(16, marks=pytest.mark.slow)])
def test_a_stained_tooth_looks_as_in_mitsuba(size: int, tmp_path: Path) -> None:
    import mitsuba as mi

    prepare_device()
    (tooth,) = stained_recipe("matched").teeth
    assert tooth.dentin is not None
    core = tooth.dentin.vertices_mm(TISSUE.shape)
    known = DentinShape.known(type(tooth.outer)(core, tooth.outer.faces))
    scene = replace(
        stained_recipe("matched"),
        teeth=(replace(tooth, dentin=known),),
        light_positions_mm=LIGHTS_MM[[1, 3]],
        light_intensities=np.full(2, INTENSITY),
    )
    camera = camera_at((0.2, 1, 0.1), size=size, span_mm=5.0)
    ours = Engine(scene).images(replace(TISSUE, shape=()), whole_view(camera), samples=2048, seed=21, batches=BATCHES)

    write_textured(tmp_path / "outer.obj", tooth.outer, texture_coordinates())
    write_mesh(tmp_path / "dentin.ply", known.base)
    assert TISSUE.stain is not None
    opacity = mi.Bitmap((1 - TISSUE.stain.transmittance[:, :, None]).astype(np.float32))
    texture = {"type": "bitmap", "bitmap": opacity, "raw": True, "filter_type": "bilinear", "wrap_mode": "clamp"}
    mask = {
        "type": "mask",
        "opacity": texture,
        "nested": {"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.0}},
    }
    scores = []
    for number, light in enumerate(scene.light_positions_mm):
        described = nested_scene(
            {"11": (tmp_path / "outer.obj", tmp_path / "dentin.ply")}, TISSUE, (camera,), light, INTENSITY
        )
        described["outer_11"] |= {"type": "obj", "bsdf": mask, "flip_tex_coords": False}
        stock = load_scene(described)
        mean, variance = render_batches(stock, 0, samples=2048, seed=31 + number, batches=BATCHES)
        scores.append(
            pixel_scores(
                [ours.mean[number].reshape(mean.shape), mean], [ours.variance[number].reshape(mean.shape), variance]
            )
        )
    require_same_pictures(np.stack(scores), least=2 * size**2 - 12)


def write_textured(path: Path, mesh: Mesh, uv: NDArray[np.float64]) -> None:
    """Write a Wavefront file with texture coordinates (V, 2) of the vertices."""
    lines = ["v {:.9g} {:.9g} {:.9g}".format(*vertex) for vertex in mesh.vertices_mm] + [
        "vt {:.9g} {:.9g}".format(*place) for place in uv
    ]
    path.write_text("\n".join(lines + ["f " + " ".join(f"{k}/{k}" for k in face) for face in mesh.faces + 1]) + "\n")


@pytest.mark.parametrize("boundary", ["matched", pytest.param("thin", marks=pytest.mark.slow)])
def test_texels_derivatives_are_those_of_the_images(boundary: Boundary) -> None:
    engine, view = Engine(stained_recipe(boundary)), whole_view(camera_at((0.2, 1, 0.1)), 1)
    cotangent = np.random.default_rng(5).uniform(-0.5, 1, (len(LIGHTS_MM), len(view)))
    gradients = np.stack(
        [
            texels(engine.stain_gradient(TISSUE, view, cotangent, seed=100 + seed, samples=512).gradient)
            for seed in range(SEEDS)
        ]
    )
    assert TISSUE.stain is not None
    middle = TISSUE.stain.transmittance
    strongest = np.argsort(-np.abs(gradients.mean(axis=0)).ravel())[:3]
    limit = stats.t.isf(FALSE_ALARM / (2 * len(strongest)), SEEDS - 1)
    for texel in strongest:
        row, column = divmod(int(texel), WIDTH)

        def projected(shift: float, seed: int, row: int = row, column: int = column) -> float:
            moved = middle.copy()
            moved[row, column] += shift
            image = engine.images(replace(TISSUE, stain=Stain(moved)), view, samples=320, seed=200 + seed).mean
            return float((image * cotangent).sum())

        # Nearly all paths cross the outer surface twice, so images are quadratic in a texel, and central differences
        # have no bias.
        differences = np.array([(projected(0.2, seed) - projected(-0.2, seed)) / 0.4 for seed in range(SEEDS)])
        gap = (gradients[:, row, column] - differences) / gradients[:, row, column].mean()
        error = gap.std(ddof=1) / np.sqrt(SEEDS)
        assert error <= 0.05
        assert abs(gap.mean()) <= limit * error


def texels(gradient: tuple[NDArray[np.float64] | None, ...]) -> NDArray[np.float64]:
    (only,) = gradient
    assert only is not None
    return only


def test_errors_of_the_gradient_are_honest() -> None:
    # Compare the variance of each strong texel over seeds to its stated variance by a chi-square test.
    engine, view = Engine(stained_recipe("matched")), whole_view(camera_at((0.2, 1, 0.1)), 1)
    cotangent = np.ones((len(LIGHTS_MM), len(view)))
    estimates = [engine.stain_gradient(TISSUE, view, cotangent, seed=seed, samples=256) for seed in range(24)]
    values, variances = (
        np.stack([texels(pair) for pair in parts])
        for parts in zip(*((e.gradient, e.variance) for e in estimates), strict=True)
    )
    strong = values.mean(axis=0) > 0.2 * values.mean(axis=0).max()
    ratio = values.var(axis=0, ddof=1)[strong] / variances.mean(axis=0)[strong]
    low, high = stats.chi2.ppf([5e-4 / strong.sum(), 1 - 5e-4 / strong.sum()], 23) / 23
    assert low < ratio.min()
    assert ratio.max() < high


def test_an_image_dims_with_the_square_of_a_common_stain() -> None:
    # With matched boundaries every path enters once and leaves once, so a_t = 0.6 everywhere dims each by 0.36.
    engine, view = Engine(stained_recipe("matched")), whole_view(camera_at((0.2, 1, 0.1)), 1)
    clean, dim = (
        engine.images(replace(TISSUE, stain=given), view, samples=1024, seed=3)
        for given in (Stain(np.ones((2, 3))), Stain(np.full((2, 3), 0.6)))
    )
    # Pixels are independent, but the lights of a pixel are not. The bound is four standard errors, computed as if the
    # two renders were independent.
    spread = np.sqrt(
        sum(scale**2 * (np.sqrt(image.variance).sum(axis=0) ** 2).sum() for scale, image in ((0.36, clean), (1, dim)))
    )
    assert spread <= 0.02 * dim.mean.sum()
    assert abs(dim.mean.sum() - 0.36 * clean.mean.sum()) <= 4 * spread


@pytest.mark.parametrize(
    ("given", "facts"),
    [
        (Stain(np.full((2, 2), 0.0)), ("stain[0, 0] = 0", "above 0", "4 texels")),
        (Stain(np.array([[1.0, 1.2]])), ("stain[0, 1] = 1.2", "1 texels")),
        (Stain(np.array([[np.nan]])), ("stain[0, 0] = nan",)),
        (Stain(np.ones((2, 2, 3))), ("shape (2, 2, 3)", "(H, W)")),
    ],
)
def test_stains_that_dim_nothing_or_everything_are_refused(given: Stain, facts: tuple[str, ...]) -> None:
    with pytest.raises(InputError) as caught:
        Engine(stained_recipe("matched")).images(
            replace(TISSUE, stain=given), whole_view(camera_at((0, 1, 0))), samples=1, seed=1
        )
    assert all(fact in caught.value.message for fact in facts), caught.value.message


def test_stains_without_a_place_and_gradients_without_stains_are_refused() -> None:
    view = whole_view(camera_at((0, 1, 0)))
    with pytest.raises(InputError, match="without texture coordinates"):
        Engine(recipe("matched")).images(TISSUE, view, samples=1, seed=1)
    engine, ones = Engine(stained_recipe("matched")), np.ones((len(LIGHTS_MM), len(view)))
    with pytest.raises(InputError, match="no stains"):
        engine.stain_gradient(replace(TISSUE, stain=None), view, ones, samples=1, seed=1)
    with pytest.raises(InputError, match=r"cotangent has shape \(5, 3\)"):
        engine.stain_gradient(TISSUE, view, ones[:, :3], samples=1, seed=1)
    with pytest.raises(InputError, match="inf at light 0 and pixel 6"):
        engine.stain_gradient(
            TISSUE, view, np.where(ones.cumsum().reshape(ones.shape) == 7, np.inf, 1), samples=1, seed=1
        )
