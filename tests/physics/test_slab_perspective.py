"""Perspective cameras of a cell, compared to a plain photon walk that finds their directions in another way, and to
orthographic cameras, which they become at a large distance.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from services.bench.slab.plain_photons import BATCHES, plain_images
from services.core.slab.folder import SlabFolder
from services.slab.cell.dictionary import KNOTS, Material, henyey_greenstein, hg_values
from services.slab.cell.forward import render
from services.slab.cell.rig import rig_of
from services.slab.cell.single import single_scattering
from services.slab.solve.normal import derivative_rows
from tests.support.small_slab import WAVELENGTH_NM, description, small_rig
from tests.support.z_scores import require_unbiased, student_to_normal

G = 0.5
KERNEL_BATCHES = 8
BEAMS = ({"profile": "gaussian", "sigma_mm": 0.5}, {"profile": "disc", "radius_mm": 1.0})


def cameras(distance_mm: float | None) -> list[dict[str, Any]]:
    """The cameras of ``description``, in perspective where a distance is given."""
    told: list[dict[str, Any]] = description()["cameras"]
    lens = {} if distance_mm is None else {"kind": "perspective", "distance_mm": distance_mm}
    return [camera | lens for camera in told]


@pytest.mark.dear("Two walks are compared in every pixel, and one of them is compiled first.")
@pytest.mark.parametrize(
    "beam", [pytest.param(BEAMS[0], id="gaussian"), pytest.param(BEAMS[1], id="disc", marks=pytest.mark.slow)]
)
@pytest.mark.parametrize(("index", "photons"), [pytest.param(1.0, 160_000, marks=pytest.mark.slow), (1.5, 8_000)])
def test_both_walks_give_the_same_images(index: float, photons: int, beam: dict[str, Any]) -> None:
    cell = {"width_mm": 1.0, "index": index, "boundary": "smooth" if index > 1 else "matched"}
    # From 20 mm the direction changes by 8 degrees over the face, and by 3 over a pixel.
    pixels = {"x_mm": [-3.0, 3.0], "y_mm": [-3.0, 3.0], "columns": 6, "rows": 6}
    told = description(cell=cell, beam=beam, pixels=pixels, cameras=cameras(20.0))
    folder = SlabFolder.model_validate(told)
    images, variances = plain_images(folder, 2.2, 2.0 / 2.2, lambda angles: hg_values(G, angles), photons, seed=5)
    ours = render(
        rig_of(folder, WAVELENGTH_NM), henyey_greenstein(2.0, G, 0.2), seed=3, step=0, batches=KERNEL_BATCHES,
        paths=10_000, scores=False,
    ).images  # fmt: skip
    # Sum columns two by two over all rows: each sum then has enough photons for its noise to be normal.
    plain, of_plain = (array.sum(axis=1).reshape(4, 3, 2).sum(axis=2) for array in (images, variances))
    kernel = 2 * ours.reshape(KERNEL_BATCHES, 4, 3, 3, 2).sum(axis=(2, 4))
    error = np.sqrt(of_plain + kernel.var(axis=0, ddof=1) / KERNEL_BATCHES)
    assert (error < 0.04 * plain).all()
    scores = student_to_normal((kernel.mean(axis=0) - plain) / error, BATCHES - 1 + KERNEL_BATCHES - 1)
    require_unbiased(np.ravel(scores), independent=12)


@pytest.mark.parametrize("glass", [None, {"index": 1.52, "thickness_mm": 1.2}], ids=["bare", "glass"])
@pytest.mark.parametrize("beam", BEAMS, ids=["gaussian", "disc"])
def test_a_far_camera_is_orthographic(beam: dict[str, Any], glass: dict[str, float] | None) -> None:
    cell = description()["cell"] | {"glass": glass}
    material = henyey_greenstein(2.0, G, 0.2)
    both = [
        render(
            small_rig(cell=cell, beam=beam, cameras=cameras(distance_mm)), material, seed=3, step=0, batches=2,
            paths=2_000, scores=True,
        )
        for distance_mm in (None, 1e9)
    ]  # fmt: skip
    # Directions differ by 4e-9; rows are rounded to 32 bits.
    np.testing.assert_allclose(both[1].images, both[0].images, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(both[1].rows, both[0].rows, rtol=1e-5, atol=1e-9)


def test_derivatives_of_single_scattering_are_those_of_differences() -> None:
    rig, material = small_rig(cameras=cameras(30.0)), henyey_greenstein(1.0, 0.6, 0.3)
    _, rows = single_scattering(rig, material, scores=True)
    jacobian = derivative_rows(rows, material)
    small = 1e-5
    for direction in np.eye(KNOTS + 1)[[3, 17, 40, 199, 200]]:
        sides = [
            single_scattering(
                rig,
                Material(
                    material.scattering * np.exp(sign * small * direction[:KNOTS]),
                    material.absorption_per_mm + sign * small * float(direction[-1]),
                ),
                scores=False,
            )[0]
            for sign in (1, -1)
        ]
        np.testing.assert_allclose(jacobian @ direction, (sides[0] - sides[1]) / (2 * small), atol=1e-9)
