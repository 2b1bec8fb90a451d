"""A stained incisor by stock Mitsuba, fitted end to end: every stage of teeth 2018 Fig. 9 lowers the loss, and the texture holds on lights it never saw."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from services.core.meshfiles import read_mesh
from services.core.records import JobSpec
from services.core.stage import LocalContext, StageEvent
from services.fit.anatomy.phantom import write_phantom
from services.fit.anatomy.stain_paint import TEXEL_MM, painted_depth
from services.fit.anatomy.stain_uv import stain_layout, texel_edge_mm
from services.fit.export.stains import kept_stains
from services.fit.stage import export, run
from services.preprocess.stage import run as prepare

PIXEL_MM, SEED = 0.8, 4
LEAST_GAIN = 0.2
"""Of the loss, by each stage."""


@pytest.mark.slow
def test_each_stage_lowers_the_loss_and_the_texture_is_the_painted_one(tmp_path: Path) -> None:
    capture = tmp_path / "capture"
    write_phantom(capture, pixel_mm=PIXEL_MM, cameras=2, lights=12, renderer="mitsuba", samples=256, stains=True, seed=SEED)
    spec = JobSpec(
        capture=capture, boundary="matched", dentin="known", stains=True,
        samples_per_pixel=128, max_samples_per_pixel=512, search_candidates=5000, max_steps=6,
    )  # fmt: skip
    events: list[StageEvent] = []
    prepare(spec, LocalContext(tmp_path))
    report = run(spec, LocalContext(tmp_path, 1, events.append), engine="services.fit.transport.engine:Engine")
    steps = [event.data for event in events if event.kind == "step"]
    last = [next(step for step in reversed(steps) if step["stage"] == stage) for stage in ("homogeneous", "exact", "stained.2")]
    losses = [step["loss"] for step in last]
    assert losses[1] < (1 - LEAST_GAIN) * losses[0]
    assert losses[2] < (1 - LEAST_GAIN) * losses[1]
    assert report.held_out_error["green"] < 0.8 * last[1]["held_out_error"]

    # The texture against the painted one where light came through it; the common depth is the media's to share.
    found = kept_stains(tmp_path / "fit")
    assert found is not None
    painted = stain_layout(read_mesh(capture / "teeth" / "11" / "outer.ply"), TEXEL_MM)
    fitted = stain_layout(read_mesh(tmp_path / "prepared" / "teeth" / "11" / "outer.ply"), texel_edge_mm(PIXEL_MM))
    ours = fitted.depths(found.textures["green"])
    true = painted_depth(painted, SEED)[cKDTree(painted.points_mm).query(fitted.points_mm)[1]]
    seen = ours > 0.01
    assert seen.sum() > 50
    assert np.corrcoef(ours[seen], true[seen])[0, 1] > 0.5
    assert "teeth/11/stain_green.png" in export(spec, LocalContext(tmp_path, 2)).files
