"""Painted stains: plausible, repeatable, and visible in the images of a phantom."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from services.anatomy.templates.incisor import build_incisor
from services.phantom.stain_paint import STRENGTH, painted_depth, painted_stains
from services.phantom.tooth import write_phantom
from services.transport.scene.stain_uv import read_stains, stain_layout


def test_painted_stains_are_plausible() -> None:
    layout = stain_layout(build_incisor().outer, 0.75)
    depth = painted_depth(layout, seed=1)
    assert (depth >= 0).all()
    assert depth.max() < 1.5
    low = layout.points_mm[:, 2] < np.quantile(layout.points_mm[:, 2], 0.2)
    assert depth[low].mean() > depth[~low].mean()
    np.testing.assert_array_equal(painted_depth(layout, 1), depth)
    np.testing.assert_allclose(painted_depth(layout, 1, strength=0.5), 0.5 * depth)
    assert (painted_depth(layout, 2) != depth).any()


def test_channels_differ_in_strength_alone() -> None:
    stains = painted_stains(build_incisor().outer, ("red", "blue"), seed=1)
    red, blue = (np.log(stains.textures[name].transmittance) for name in ("red", "blue"))
    np.testing.assert_allclose(blue, red * STRENGTH["blue"] / STRENGTH["red"], atol=1e-12)


def test_a_phantom_shows_its_stains(tmp_path: Path) -> None:
    totals = {}
    for stains in (False, True):
        out = tmp_path / str(stains)
        write_phantom(out, pixel_mm=2.0, cameras=1, lights=2, samples=256, seed=3, stains=stains)
        totals[stains] = sum(float(np.load(out / f"c0_l{k}.npy").sum()) for k in range(2))
        assert json.loads((out / "truth.json").read_text())["stains"] is stains
    kept = read_stains(tmp_path / "True")
    assert kept is not None
    assert read_stains(tmp_path / "False") is None
    # Light crosses the surface twice, though not at average places: within a factor of two of twice the mean depth.
    dimmed = np.log(totals[False] / totals[True])
    texture = kept.textures["green"].transmittance
    depth = float(-np.log(texture[texture < 1]).mean())
    assert 0.5 * 2 * depth < dimmed < 2 * 2 * depth
