"""A stained incisor rendered by stock Mitsuba and fitted end to end: every stage of Fig. 9 of the teeth paper of 2018
lowers the loss, and the texture also explains held-out lights.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from services.anatomy.job_dentin import dentin_shape
from services.assets.stage import export
from services.bench.fits.tooth_capture import prepared_tooth, tissue_of
from services.core.files.meshes import read_mesh
from services.core.records import JobSpec
from services.core.stage import LocalContext, StageEvent
from services.fit.coordinates.domain import similar_tissue
from services.fit.measurements.observations import channel_scene
from services.fit.stage import run
from services.fit.stages.tooth.schedule import SIMILAR_G
from services.phantom.stain_paint import TEXEL_MM, painted_depth
from services.phantom.tooth import write_phantom
from services.preprocess.stage import run as prepare
from services.transport.engine import Engine
from services.transport.scene.stain_uv import read_stains, stain_layout, texel_edge_mm

PIXEL_MM, SEED = 0.8, 4
MIN_GAIN = 0.2
"""Least relative reduction of the loss by each stage."""
JUDGE_SAMPLES = 2048
"""Paths per pixel of the renders that judge the fit. Held-out errors of 13 and 6 % then have Monte Carlo errors of 0.4
and 0.9 %; those of the fit's own steps, with at most 512 paths, have 3 to 9 %."""
CERTAINTY = 3.0
"""Number of standard errors by which the texture must lower the error of held-out images beyond the least reduction;
one false alarm in 700 runs."""


@pytest.mark.slow
def test_each_stage_lowers_the_loss_and_the_texture_is_the_painted_one(tmp_path: Path) -> None:
    capture = tmp_path / "capture"
    write_phantom(
        capture, pixel_mm=PIXEL_MM, cameras=2, lights=12, renderer="mitsuba", samples=256, stains=True, seed=SEED
    )
    spec = JobSpec(
        capture=capture, boundary="matched", dentin="known", stains=True,
        samples_per_pixel=128, max_samples_per_pixel=512, search_candidates=5000, max_steps=6,
    )  # fmt: skip
    events: list[StageEvent] = []
    prepare(spec, LocalContext(tmp_path))
    report = run(spec, LocalContext(tmp_path, 1, events.append), engine="services.transport.engine:Engine")
    found = read_stains(tmp_path / "fit")
    assert found is not None

    # Judge the results of all stages in the same way: the homogeneous stage, the stage of both media, and the report.
    ends = {event.data["stage"]: tissue_of(event.data["parameters"]) for event in events if event.kind == "step"}
    reported = tissue_of({name: estimate.value for name, estimate in report.parameters["green"].items()})
    tooth = prepared_tooth(tmp_path, spec)
    (scanned,) = tooth.observations.teeth
    dentin = dentin_shape(scanned, tooth.observations.manifest.cameras, spec)
    judge = replace(tooth, engine=Engine(channel_scene(tooth.observations, "green", [dentin], spec, found.corners_uv)))
    tissues = (
        similar_tissue(ends["homogeneous"], SIMILAR_G),
        ends["exact"],
        replace(reported, stain=found.textures["green"]),
    )
    fitted, held_out = zip(*(judge.errors(tissue, samples=JUDGE_SAMPLES, seed=SEED) for tissue in tissues), strict=True)
    homogeneous, media, stained = (sums.loss for sums in fitted)
    assert media < (1 - MIN_GAIN) * homogeneous
    assert stained < (1 - MIN_GAIN) * media
    (before, before_se), (after, after_se) = ((sums.error, sums.error_se) for sums in held_out[1:])
    assert after + CERTAINTY * np.hypot(after_se, before_se) < (1 - MIN_GAIN) * before

    # Compare the texture to the painted one where light passed through it, up to a common depth that the media can
    # explain.
    painted = stain_layout(read_mesh(capture / "teeth" / "11" / "outer.ply"), TEXEL_MM)
    fitted_texels = stain_layout(
        read_mesh(tmp_path / "prepared" / "teeth" / "11" / "outer.ply"), texel_edge_mm(PIXEL_MM)
    )
    ours = fitted_texels.depths(found.textures["green"])
    true = painted_depth(painted, SEED)[cKDTree(painted.points_mm).query(fitted_texels.points_mm)[1]]
    # Texels' errors have the stated size: 95 % lie within two standard errors, correlated over some ten texels, so that
    # of 568 texels the share has a standard deviation of 3 %.
    texture, touched = found.textures["green"], fitted_texels.index >= 0
    assert texture.se is not None
    pulls = (ours - true) / (texture.se / texture.transmittance)[touched]
    assert (np.abs(pulls) < 2).mean() > 0.86
    assert np.sqrt(np.mean(pulls**2)) > 0.5
    seen = ours > 0.01
    assert seen.sum() > 50
    assert np.corrcoef(ours[seen], true[seen])[0, 1] > 0.5
    assert "teeth/11/stain_green.png" in export(spec, LocalContext(tmp_path, 2)).files
