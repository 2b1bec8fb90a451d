"""An end-to-end fit with stains on the fake engine: the texture is recovered, kept when a fit resumes, and part of
asset and report.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from services.assets.stage import export
from services.core.files.meshes import read_mesh
from services.core.records import JobSpec
from services.core.results import FitReport
from services.core.stage import LocalContext, StageEvent
from services.fit.stage import run
from services.tasks.journal import read_entries
from services.transport.optics.parameters import Tissue
from services.transport.scene.recipe import ToothSurfaces, View, single_tooth
from services.transport.scene.stain_uv import StainLayout, read_stains, stain_layout, texel_edge_mm
from tests.support.fake_engine import FakeEngine
from tests.support.prepared import FAKE, SIZE, TRUTH, camera, sphere, without_time, write_prepared

RECIPE = single_tooth(sphere(4.0), None, np.array([[0.0, 300.0, -700.0]]), np.ones(1))
PIXEL_MM = 0.5
"""Pixel size at the tooth: the prepared stage's cameras are 500 mm away with a focal length of 1000 pixels."""


def layout_of(root: Path) -> StainLayout:
    # Compute the layout as the fit does, from the stored mesh.
    return stain_layout(read_mesh(root / "prepared" / "teeth" / "11" / "outer.ply"), texel_edge_mm(PIXEL_MM))


def stained_truth(root: Path) -> tuple[Tissue, StainLayout]:
    write_prepared(root / "shape")
    layout = layout_of(root / "shape")
    rng = np.random.default_rng(3)
    depth = np.where(rng.uniform(size=len(layout.points_mm)) < 0.5, 0.0, rng.uniform(0.1, 0.7, len(layout.points_mm)))
    return Tissue(TRUTH.enamel, TRUTH.dentin, (), layout.texture(depth)), layout


def spec_for(root: Path, **options: Any) -> JobSpec:
    values: dict[str, Any] = {
        "capture": root, "boundary": "matched", "dentin": "known", "stains": True,
        "samples_per_pixel": 64, "max_samples_per_pixel": 256, "max_steps": 6, "search_candidates": 500,
        # A gain of the instrument is like a uniform stain, so it is left out; here stains must explain the residual of
        # the media.
        "instrument": "off",
    }  # fmt: skip
    return JobSpec(**(values | options))


@pytest.fixture(scope="module")
def stained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, FitReport, list[StageEvent]]:
    root = tmp_path_factory.mktemp("stained")
    truth, layout = stained_truth(root)
    write_prepared(root, truth=truth, stain_uv=layout.corners_uv)
    events: list[StageEvent] = []
    return root, run(spec_for(root), LocalContext(root, 1, events.append), engine=FAKE), events


def test_the_texture_explains_what_media_cannot(stained: tuple[Path, FitReport, list[StageEvent]]) -> None:
    root, report, events = stained
    steps = [event.data for event in events if event.kind == "step"]
    last = {name: next(s for s in reversed(steps) if s["stage"] == name) for name in ("exact", "stained.2")}
    assert last["stained.2"]["loss"] < 0.5 * last["exact"]["loss"]
    assert last["stained.2"]["held_out_error"] < 0.5 * last["exact"]["held_out_error"]
    # The fake engine's noise at 256 paths is 6 % of a pixel and gives the texture an error of about 2 %.
    assert report.held_out_error["green"] < 0.03

    # Compare the part of the texture that pixels show, up to a common factor that the media can explain. Half of the
    # surface is clean, so the correlation is high only if clean and stained parts are both right.
    found = read_stains(root / "fit")
    truth, layout = stained_truth(root)
    assert found is not None
    assert truth.stain is not None
    errors = found.textures["green"].se
    assert errors is not None
    assert (errors[layout.index >= 0] > 0).all()
    assert not errors[layout.index < 0].any()
    engine = FakeEngine(replace(RECIPE, teeth=(ToothSurfaces(sphere(4.0), None, layout.corners_uv),)))
    view = View(camera("c0"), np.argwhere(np.ones(SIZE)).astype(np.int32))
    texels, shares = engine._texels(view, truth.stain)
    ours, true = (
        np.log((shares * stain.transmittance.reshape(-1)[texels]).sum(axis=1))
        for stain in (found.textures["green"], truth.stain)
    )
    assert np.corrcoef(ours, true)[0, 1] > 0.9


def test_an_interrupted_fit_ends_with_the_same_texture(
    stained: tuple[Path, FitReport, list[StageEvent]], tmp_path: Path
) -> None:
    root, report, _ = stained
    truth, layout = stained_truth(tmp_path)
    write_prepared(tmp_path, truth=truth, stain_uv=layout.corners_uv)

    class StoppedError(Exception):
        pass

    def stop(event: StageEvent) -> None:
        if event.kind == "step" and event.data["stage"] == "stain.1":
            raise StoppedError

    with pytest.raises(StoppedError):
        run(spec_for(tmp_path), LocalContext(tmp_path, 1, stop), engine=FAKE)
    again = run(spec_for(tmp_path), LocalContext(tmp_path, 2), engine=FAKE)
    assert without_time(again) == without_time(report)
    ours, other = read_stains(tmp_path / "fit"), read_stains(root / "fit")
    assert ours is not None
    assert other is not None
    np.testing.assert_array_equal(ours.textures["green"].transmittance, other.textures["green"].transmittance)


def test_asset_and_report_carry_the_texture(stained: tuple[Path, FitReport, list[StageEvent]]) -> None:
    root, _, _ = stained
    manifest = export(spec_for(root), LocalContext(root, 3))
    assert {"teeth/11/stain_green.npy", "teeth/11/stain_green.png", "teeth/11/outer.ply"} <= set(manifest.files)
    kept = read_stains(root / "fit")
    assert kept is not None
    np.testing.assert_allclose(
        np.load(root / "asset/teeth/11/stain_green.npy"), kept.textures["green"].transmittance, rtol=1e-6
    )
    assert "teeth/11/stain_green.png" in (root / "asset/scene_green.xml").read_text()
    # Reading the surface merges the vertices that the texture's seams split.
    assert len(read_mesh(root / "asset/teeth/11/outer.ply").vertices_mm) == len(sphere(4.0).vertices_mm)
    errors = kept.textures["green"].se
    assert errors is not None
    np.testing.assert_allclose(np.load(root / "asset/teeth/11/stain_green_se.npy"), errors, rtol=1e-6)
    page = (root / "report.html").read_text()
    assert "Channel green: its standard error, with the media as they were fitted" in page
    assert "<h2>Stains</h2>" in page
    assert "Channel green" in page


def test_a_clean_tooth_gets_no_texture(tmp_path: Path) -> None:
    write_prepared(tmp_path)
    plain = run(spec_for(tmp_path), LocalContext(tmp_path, 1), engine=FAKE)
    assert read_stains(tmp_path / "fit") is None
    compared = read_entries(tmp_path / "fit-checkpoint" / "journal.jsonl")["green/stain.compare"]
    assert compared["se"] > 0
    # Then the result is that of a fit without stains.
    write_prepared(tmp_path / "without")
    without = run(spec_for(tmp_path / "without", stains=False), LocalContext(tmp_path / "without", 1), engine=FAKE)
    assert plain.parameters == without.parameters
