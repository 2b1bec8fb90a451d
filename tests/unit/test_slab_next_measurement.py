"""Advice on the next measurement: dilute a sample that is too thick, concentrate one that is too thin."""

from __future__ import annotations

import numpy as np
import pytest

from services.core.slab.folder import SlabFolder
from services.slab.cell.dictionary import henyey_greenstein
from services.slab.cell.forward import render
from services.slab.cell.rig import rig_of
from services.slab.design.next_measurement import BESIDE_DEG, candidates, next_measurement
from services.slab.read.images import Measurements, shot_noise
from tests.support.small_slab import WAVELENGTH_NM, description

INDEX = 1.33


def advice(thickness: float) -> str:
    folder = SlabFolder.model_validate(description())
    rig = rig_of(folder, WAVELENGTH_NM)
    material = henyey_greenstein(thickness / folder.cell.width_mm, 0.6, 0.0)
    images = render(rig, material, seed=5, step=0, batches=2, paths=2000, scores=False).mean
    variances = np.stack([shot_noise(image) for image in images]) / 2
    held_out = np.zeros(len(images), dtype=bool)
    measured = Measurements(images, variances, held_out, (("", ""),) * len(images), assumed_noise=False)
    return next_measurement(folder, WAVELENGTH_NM, INDEX, measured, material, 10.0, seed=1)


@pytest.mark.parametrize(
    ("thickness", "words"), [(8.0, ("dilute it", "a cell of 0.")), (0.15, ("concentrate it", "a cell of"))]
)
def test_a_cell_far_from_the_best_thickness_is_told_where_to_go(thickness: float, words: tuple[str, ...]) -> None:
    told = advice(thickness)
    assert told.startswith("What would help most: ")
    assert any(word in told for word in words), told
    sentence, _, instead = told.partition(" Nearly as much would come of this: ")
    if thickness > 1:  # a thinner cell and a diluted sample tell about the same
        assert any(word in instead for word in words), told
    before, after = sentence.rpartition("fall from ")[2].removesuffix(" %.").removeprefix("more than ").split(" to ")
    assert float(after.removeprefix("more than ")) < 0.8 * float(before.removesuffix(" %"))


def test_no_candidate_leaves_the_range_that_images_tell_of() -> None:
    folder = SlabFolder.model_validate(description())
    found = list(candidates(folder, WAVELENGTH_NM, henyey_greenstein(4.0 / folder.cell.width_mm, 0.6, 0.0)))
    assert found
    for one in found:
        thickness = one.dilution * one.folder.cell.width_mm * 4.0 / folder.cell.width_mm
        assert 0.1 <= thickness <= 10


def test_a_camera_beside_the_beam_is_tried_where_none_looks_there() -> None:
    told = description()
    for camera in told["cameras"]:
        camera["angle_deg"] = 60.0
    folder = SlabFolder.model_validate(told)
    material = henyey_greenstein(1.0, 0.6, 0.0)
    (beside,) = [one for one in candidates(folder, WAVELENGTH_NM, material) if "beside the beam" in one.description]
    angle = abs(beside.folder.cameras[-1].angle_deg - folder.lights[0].angle_deg)
    assert angle == pytest.approx(BESIDE_DEG)
    assert len(rig_of(beside.folder, WAVELENGTH_NM).lights) == len({image.light for image in folder.images})
