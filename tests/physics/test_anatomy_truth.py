"""The nested Mitsuba scene reproduces a stored capture of a real tooth."""

from __future__ import annotations

import json

import numpy as np

from services.assets.mitsuba.scene import load_scene, nested_scene, render_batches
from services.core.records import FolderCapture
from services.core.store import read_record
from services.transport.optics.parameters import Medium, Tissue
from services.transport.platform import prepare_device
from tests.support.shared_data import shared_path


def test_the_scanned_incisors_images_come_out_again() -> None:
    prepare_device()
    root = shared_path("data/tooth-ur1-truth")
    capture, truth = read_record(root / "capture.json", FolderCapture), json.loads((root / "truth.json").read_text())
    enamel, dentin = truth["enamel"], truth["dentin"]
    tissue = Tissue(
        Medium(enamel["sigma_t"], enamel["albedo"], enamel["beta"], enamel["g1"], enamel["g2"]),
        Medium(dentin["sigma_t"], dentin["albedo"], g1=dentin["g"]),
    )
    teeth = {"11": (root / "teeth/11/outer.ply", root / "teeth/11/dentin.ply")}
    scores = []
    for number, light in ((0, capture.lights[0]), (2, capture.lights[3])):
        scene = load_scene(nested_scene(teeth, tissue, capture.cameras, light.position_mm, light.intensity[0]))
        mean, variance = render_batches(scene, number, samples=64, seed=5)
        stem = f"{capture.cameras[number].name}_{light.name}"
        stored, stored_variance = (
            np.load(root / f"{name}.npy")[..., 0].astype(float) for name in (stem, f"{stem}_var")
        )
        # The pixels' noise is heavy-tailed; sums over blocks of four rows are nearly normal.
        for row in range(0, mean.shape[0], 4):
            part = slice(row, row + 4)
            noise = variance[part].sum() + stored_variance[part].sum()
            if stored[part].sum() > 0.02 * stored.sum():
                scores.append((mean[part] - stored[part]).sum() / np.sqrt(noise))
    # With about 15 values, |z| <= 4.5 fails one correct run in 10,000. An error of half a pixel in a camera, or a wrong
    # medium, gives |z| of 7 and more.
    assert len(scores) >= 12
    assert np.abs(scores).max() <= 4.5
    assert np.sqrt(np.mean(np.square(scores))) < 1.7
