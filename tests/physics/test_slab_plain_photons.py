"""The plain photon walk that renders truths for the slab's fit, compared to the fit's own kernel, with which it shares
no code, and to stock Mitsuba.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from services.bench.slab.cell import near_beam_folder
from services.bench.slab.dispersions import COLOURS, DIAMETERS_NM, mie_truth, truths
from services.bench.slab.plain_photons import BATCHES, plain_images
from services.bench.slab.stock_cell import matched_folder, medium_of, scenes, turned
from services.core.slab.folder import SlabFolder
from services.slab.cell.dictionary import henyey_greenstein
from services.slab.cell.forward import render
from services.slab.cell.rig import rig_of
from services.transport.platform import prepare_device
from tests.support.slab_tables import rows_of
from tests.support.small_slab import WAVELENGTH_NM, description
from tests.support.z_scores import require_unbiased, student_to_normal

G = 0.5
KERNEL_BATCHES = 8
RENDERS = 8
"""Number of independent renders of an image by stock Mitsuba, whose scatter gives its variance."""


def henyey_greenstein_shape(angles_rad: np.ndarray) -> np.ndarray:
    return np.asarray((1 + G * G - 2 * G * np.cos(angles_rad)) ** -1.5)


@pytest.mark.parametrize("index", [1.0, 1.5])
def test_both_walks_give_the_same_images(index: float) -> None:
    cell = {"width_mm": 1.0, "index": index, "boundary": "smooth" if index > 1 else "matched"}
    # Two by two pixels receive all light, so that each collects enough photons for its noise to be normal.
    pixels = {"x_mm": [-40.0, 40.0], "y_mm": [-40.0, 40.0], "columns": 2, "rows": 2}
    folder = SlabFolder.model_validate(description(cell=cell, pixels=pixels))
    images, variances = plain_images(folder, 2.2, 2.0 / 2.2, henyey_greenstein_shape, photons=80_000, seed=5)
    rig = rig_of(folder, WAVELENGTH_NM)
    ours = render(
        rig, henyey_greenstein(2.0, G, 0.2), seed=3, step=0, batches=KERNEL_BATCHES, paths=10_000, scores=False
    ).images
    # The kernel's grid is folded at y = 0, so its expected value is that of both rows of the plain images.
    plain, of_plain = images.mean(axis=1), variances.sum(axis=1) / 4
    error = np.sqrt(of_plain + ours.var(axis=0, ddof=1) / KERNEL_BATCHES)
    assert (error < 0.02 * plain).all()
    scores = student_to_normal((ours.mean(axis=0) - plain) / error, BATCHES - 1 + KERNEL_BATCHES - 1)
    require_unbiased(scores, independent=4)


def test_dispersions_are_those_of_the_reference() -> None:
    folder = near_beam_folder()
    for row in rows_of("mie_dispersions.csv"):
        truth = mie_truth(float(row["diameter_nm"]), row["channel"], 1.0, folder)
        # The tolerances are the table's digits and, for g, the spacing of the dictionary's knots.
        assert truth.scattering_per_mm == pytest.approx(float(row["mu_s_per_mm"]), rel=1e-4)
        assert truth.material().mean_cosine == pytest.approx(float(row["g"]), abs=2e-4)


def test_every_dispersion_is_diluted_to_where_a_cell_tells_most() -> None:
    every = truths()
    assert len(every) == len(DIAMETERS_NM) * len(COLOURS) + 3
    assert all(abs(math.log(one.thickness / 2)) < math.log(1.5) for one in every[:9])
    assert [one.thickness > 5 for one in every[9:]] == [True] * 3


def stock_images(folder: SlabFolder, medium: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Images by stock Mitsuba in the folder's order, and their means' variances, both (images, rows, columns)."""
    prepare_device()
    import mitsuba as mi

    means, variances = [], []
    for number, (scene, front) in enumerate(scenes(folder, medium, "volpath")):
        renders = np.stack(
            [
                np.array(mi.render(scene, spp=2**16 // RENDERS, seed=1 + RENDERS * number + k))[..., 0]
                for k in range(RENDERS)
            ]
        ).astype(np.float64)
        means.append(turned(renders.mean(axis=0), front=front))
        variances.append(turned(renders.var(axis=0, ddof=1), front=front) / RENDERS)
    return np.stack(means), np.stack(variances)


@pytest.mark.slow
def test_images_of_a_matched_cell_agree_with_stock_mitsuba() -> None:
    told = matched_folder()
    # The cameras are on both faces; one of them looks 3 degrees beside the beam.
    folder = told.model_copy(update={"images": tuple(told.images[k] for k in (1, 3, 4))})
    plain, of_plain = plain_images(folder, 1.02, 1 / 1.02, henyey_greenstein_shape, photons=1_000_000, seed=5)
    stock, of_stock = stock_images(folder, medium_of(1.02, 1 / 1.02, henyey_greenstein_shape))
    # Whole images and parts of the rows through the beam's centre test scale, position and orientation.
    middle = slice(5, 7)
    parts = [(slice(None), slice(None)), (middle, slice(0, 4)), (middle, slice(4, 8)), (middle, slice(8, 12))]
    scores = []
    for rows, columns in parts:
        difference, variance = plain - stock, of_plain + of_stock
        part, spread = difference[:, rows, columns].sum(axis=(1, 2)), variance[:, rows, columns].sum(axis=(1, 2))
        assert (np.sqrt(spread) < 0.03 * plain[:, rows, columns].sum(axis=(1, 2))).all()
        scores.append(student_to_normal(part / np.sqrt(spread), RENDERS - 1))
    require_unbiased(np.ravel(scores), independent=3)
