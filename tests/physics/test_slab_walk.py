"""The walk of the slab's fit: energy, totals compared to the table, scores compared to differences, and single
scattering.
"""

from __future__ import annotations

import csv
import math
from typing import Any

import numpy as np
import pytest

from services.core.slab.folder import Light
from services.slab.cell.dictionary import KNOTS, Material, henyey_greenstein
from services.slab.cell.forward import PathBlock, render, run_block
from services.slab.cell.interface import Interface, fresnel
from services.slab.cell.single import single_scattering
from services.slab.solve.normal import derivative_rows
from tests.support.shared_data import shared_path
from tests.support.small_slab import small_rig
from tests.support.z_scores import require_unbiased, student_to_normal

NORMAL_LIGHT = [{"name": "l0", "side": "front", "angle_deg": 0.0}]


def totals(
    material: Material, index: float, *, blocks: int, paths: int, glass: float | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """R and T (2,) at normal incidence over all orders of scattering, and their standard errors; index 1 stands for a
    matched boundary.
    """
    walls = None if glass is None else {"index": glass, "thickness_mm": 1.0}
    cell = {
        "width_mm": 1.0,
        "index": index,
        "index_outside": 1.0,
        "boundary": "smooth" if index > 1 else "matched",
        "glass": walls,
    }
    rig = small_rig(lights=NORMAL_LIGHT, cell=cell)
    sums = np.stack(
        [run_block(PathBlock(rig, 0, material, 7, (0, number), paths, False)).totals for number in range(blocks)]
    )
    assert (sums[:, 2] == 0).all()
    # Unscattered light is reflected to and fro between the faces.
    reflected = 1 - rig.interface.transmittance(0.0)
    through = math.exp(-material.extinction_per_mm)
    passed = (1 - reflected) ** 2 * through / (1 - (reflected * through) ** 2)
    unscattered = np.array([reflected + passed * reflected * through, passed])
    return sums[:, :2].mean(axis=0) + unscattered, sums[:, :2].std(axis=0, ddof=1) / math.sqrt(blocks)


@pytest.mark.parametrize(("index", "glass"), [(1.0, None), (1.33, None), (1.33, 1.52)])
def test_white_cells_return_all_light(index: float, glass: float | None) -> None:
    # |R + T - 1| < 1e-3 at albedo 1 and sigma_t w = 10. All paths leave the cell, so the sum's only noise is that of
    # the random cosines.
    got, _ = totals(henyey_greenstein(10.0, 0.8, 0.0), index, blocks=4, paths=5000, glass=glass)
    assert abs(got.sum() - 1) < 1e-3


@pytest.mark.parametrize(("max_error", "paths"), [(1.5e-3, 9000), pytest.param(1e-3, 12000, marks=pytest.mark.slow)])
def test_totals_agree_with_adding_doubling(max_error: float, paths: int) -> None:
    with shared_path("reference/slab_totals.csv").open() as file:
        rows = [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)]
    scores = []
    for row in rows:
        # Deeper slabs need thousands of scattering events per path; simulate_slab is tested on them.
        if not (0.01 <= row["tau"] <= 10 and abs(row["g"]) <= 0.9):
            continue
        sigma = row["tau"]
        got, error = totals(
            henyey_greenstein(sigma * row["a"], row["g"], sigma * (1 - row["a"])), row["n"], blocks=16, paths=paths
        )
        truth = np.array([row["R_normal"], row["T_normal"]])
        # The tolerance is three standard errors. Linear interpolation of HG between knots 0.9 degrees apart changes
        # totals by 1e-5.
        assert (error <= max_error).all(), row
        scores.append(student_to_normal((got - truth) / error, 15))
    assert len(scores) >= 6
    require_unbiased(np.concatenate(scores), independent=len(scores))


def test_a_beam_that_is_never_scattered_twice_agrees_with_quadrature_by_hand() -> None:
    # For isotropic scattering, matched faces, a normal beam and a camera behind at 0 degrees, the image's sum is
    # T p sigma_s w exp(-sigma_t w).
    rig = small_rig(
        cell={"width_mm": 1.0, "index": None, "boundary": "matched"},
        lights=NORMAL_LIGHT,
        cameras=[{"name": "b0", "side": "back", "angle_deg": 0.0}],
    )
    material = henyey_greenstein(0.7, 0.0, 0.2)
    images, rows = single_scattering(rig, material, scores=True)
    assert images.sum() * rig.grid.area_mm2 == pytest.approx(0.7 / (4 * math.pi) * math.exp(-0.9), rel=1e-6)
    # All light scatters at one angle, on paths of 1 mm.
    np.testing.assert_allclose(rows[..., :KNOTS].sum(axis=-1), images)
    np.testing.assert_allclose(rows[..., KNOTS], images, rtol=1e-9)


@pytest.mark.parametrize("profile", ["gaussian", "disc"])
def test_single_scattering_has_its_derivatives(profile: str) -> None:
    size = {"sigma_mm": 0.3} if profile == "gaussian" else {"radius_mm": 0.5}
    rig = small_rig(beam={"profile": profile, **size})
    material = henyey_greenstein(1.0, 0.6, 0.3)
    _, rows = single_scattering(rig, material, scores=True)
    jacobian = derivative_rows(rows, material)
    small = 1e-5
    for direction in np.eye(KNOTS + 1)[[3, 17, 40, 199, 200]]:
        sides = [single_scattering(rig, moved(material, sign * small * direction), scores=False)[0] for sign in (1, -1)]
        np.testing.assert_allclose(jacobian @ direction, (sides[0] - sides[1]) / (2 * small), atol=1e-9)


def moved(material: Material, change: np.ndarray) -> Material:
    """A material with changes added to ln f and to sigma_a."""
    return Material(material.scattering * np.exp(change[:KNOTS]), material.absorption_per_mm + float(change[-1]))


def test_back_lights_are_front_lights_of_the_mirrored_cell() -> None:
    mirrored = {"front": "back", "back": "front"}
    lights: list[dict[str, Any]] = [{"name": "l0", "side": "front", "angle_deg": 12.0}]
    cameras: list[dict[str, Any]] = [
        {"name": "a", "side": "front", "angle_deg": -20.0},
        {"name": "b", "side": "back", "angle_deg": 5.0},
    ]
    turned = [thing | {"side": mirrored[thing["side"]]} for thing in lights + cameras]
    material = henyey_greenstein(2.0, 0.5, 0.1)
    front, back = [
        render(small_rig(lights=light, cameras=c), material, seed=3, step=0, batches=2, paths=500, scores=False).images
        for light, c in ((lights, cameras), (turned[:1], turned[1:]))
    ]  # fmt: skip
    np.testing.assert_array_equal(front, back)


def test_blocks_repeat_and_may_run_in_any_order() -> None:
    material, rig = henyey_greenstein(1.0, 0.7, 0.1), small_rig()

    def backwards(task, blocks):  # type: ignore[no-untyped-def]
        return [task(block) for block in reversed(blocks)][::-1]

    first, second = (
        render(rig, material, seed=3, step=1, batches=2, paths=300, scores=True, blocks=blocks)
        for blocks in (map, backwards)
    )
    np.testing.assert_array_equal(first.images, second.images)
    np.testing.assert_array_equal(first.rows, second.rows)
    other = render(rig, material, seed=3, step=2, batches=2, paths=300, scores=False)
    assert (first.images != other.images).any()
    assert (first.images[0] != first.images[1]).any()


def test_glass_of_no_thickness_and_the_samples_index_changes_nothing() -> None:
    material = henyey_greenstein(1.0, 0.7, 0.1)
    cell = {"width_mm": 1.0, "index": 1.33, "boundary": "smooth"}
    plain, walled = (
        single_scattering(small_rig(cell=cell | extra), material, scores=False)[0]
        for extra in ({}, {"glass": {"index": 1.33, "thickness_mm": 1e-9}})
    )
    np.testing.assert_allclose(walled, plain, rtol=1e-6)


@pytest.mark.parametrize("thickness", [pytest.param(1.0, marks=pytest.mark.slow), 8.0])
def test_scores_agree_with_differences(thickness: float) -> None:
    """Compare scores to differences with common random numbers from other paths, for 12 atoms and 12 random directions.

    The functional is the sum of images divided by their own means, so that all pixels count equally. Changes are made
    in f itself, in which an image is nearly linear: +-0.4 of f at one knot, or with random signs at all knots.
    Absorption is changed by a tenth of that, because the longest paths are tens of millimetres.
    """
    rig = small_rig(pixels={"x_mm": [-4.0, 4.0], "y_mm": [-4.0, 4.0], "columns": 4, "rows": 4})
    material = henyey_greenstein(thickness, 0.6, 0.05)
    batches, paths = 16, int(1000 / thickness)
    estimate = render(rig, material, seed=11, step=0, batches=batches, paths=paths, scores=True)
    weights = 1 / estimate.mean
    gradients = np.stack([np.einsum("ip,ipn->n", weights, derivative_rows(rows, material)) for rows in estimate.rows])

    generator = np.random.default_rng(5)
    atoms = np.eye(KNOTS + 1)[[*np.linspace(4, 196, 11).astype(int), KNOTS]]
    directions = np.concatenate([atoms, generator.choice([-1.0, 1.0], size=(12, KNOTS + 1))])
    directions[:, -1] *= 0.1 * material.absorption_per_mm
    size, scores = 0.4, []
    for number, direction in enumerate(directions):
        sides = []
        for sign in (1, -1):
            change = sign * size * direction
            other = Material(material.scattering * (1 + change[:KNOTS]), material.absorption_per_mm + float(change[-1]))
            sides.append(
                render(rig, other, seed=13 + number, step=0, batches=batches, paths=paths, scores=False).images
            )
        slopes = np.einsum("ip,bip->b", weights, (sides[0] - sides[1]) / (2 * size))
        claimed = gradients @ direction
        error = math.hypot(slopes.std(ddof=1), claimed.std(ddof=1)) / math.sqrt(batches)
        scores.append((slopes.mean() - claimed.mean()) / error)
    require_unbiased(student_to_normal(scores, batches - 1), independent=12)


def test_a_light_meets_its_face_at_the_brewster_angle_without_parallel_loss() -> None:
    # At this angle only s-polarised light is reflected, so the reflectance is half of it: (n^2 - 1)^2 / (n^2 + 1)^2 /
    # 2.
    index = 1.5
    light = Light(name="l", side="front", angle_deg=math.degrees(math.atan(index)))
    face = Interface(index)
    expected = ((index**2 - 1) / (index**2 + 1)) ** 2 / 2
    assert 1 - face.transmittance(face.inside_sine(light.angle_deg)) == pytest.approx(expected)
    assert fresnel(math.cos(math.radians(light.angle_deg)), index) == pytest.approx(expected)
