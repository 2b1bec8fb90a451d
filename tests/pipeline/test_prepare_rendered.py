"""Preparation of a rig capture with known motion and highlights: frames of a moving, glossy tooth by stock Mitsuba."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr

from services.core.errors import CorruptStoreError, JobCancelledError
from services.core.geometry import Camera, Light, Mesh
from services.core.records import JobSpec, MaskBit
from services.core.results import PreparedManifest
from services.core.stage import LocalContext, StageEvent
from services.core.store import open_stage, read_record
from services.preprocess.quality.images import QualityReport
from services.preprocess.stabilisation.stabilise import warp
from services.preprocess.stage import run
from services.preprocess.views.projection import Footprint, project
from tests.support.rig_capture import Rendered, write_capture

LIGHTS = 8
# A frame with all lights on comes before every third light and at the end: four, as a smooth motion needs.
ORDER = [light for k in range(LIGHTS) for light in ((-1, k) if k % 3 == 0 else (k,))] + [-1]
FRAMES = tuple((light, k / (len(ORDER) - 1)) for k, light in enumerate(ORDER))
AMPLITUDE_MM = 0.35


@pytest.fixture(scope="module")
def renders(tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, Any]:
    """Renders of two views with pixels of 0.09 mm, 8 lights and GGX roughness 0.1."""
    out = tmp_path_factory.mktemp("renders") / "tooth.npz"
    options = {
        "size": [124, 156],
        "pixel_mm": 0.09,
        "views_deg": [[0, 0], [30, 10]],
        "rings": 48,
        "spp": 6,
        "lights": LIGHTS,
        "frames": FRAMES,
        "amplitude_mm": AMPLITUDE_MM,
    }
    subprocess.run(
        [sys.executable, "-m", "tests.support.render_moving_tooth", str(out), json.dumps(options)], check=True
    )
    with np.load(out) as stored:
        return dict(stored)


def description(renders: Mapping[str, Any]) -> Rendered:
    height, width = renders["total"].shape[2:4]
    cameras = tuple(
        Camera(name=f"c{k}", size=(width, height), K=renders["K"].tolist(), camera_from_world=pose.tolist())
        for k, pose in enumerate(renders["camera_from_world"])
    )
    lights = tuple(
        Light(name=f"l{k}", position_mm=place.tolist(), intensity=renders["intensity"].tolist())
        for k, place in enumerate(renders["lights_mm"])
    )
    return Rendered(FRAMES, renders["total"], cameras, lights, Mesh(renders["vertices_mm"], renders["faces"]))


def true_displacement(rendered: Rendered, camera: Camera, footprint: Footprint, motion: np.ndarray) -> np.ndarray:
    """Displacement in pixels of each reference pixel's surface point in a frame; NaN beside the tooth."""
    points = footprint.points_mm(camera, slice(None)).reshape(-1, 3).astype(np.float64)
    image, _ = camera.project(points @ motion[:3, :3].T + motion[:3, 3])
    width, height = camera.size
    y, x = np.mgrid[0:height, 0:width]
    return image.reshape(height, width, 2) - np.stack([x + 0.5, y + 0.5], axis=-1)


@pytest.fixture(scope="module")
def moved(
    renders: Mapping[str, Any], tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, Rendered, PreparedManifest, list[StageEvent]]:
    root = tmp_path_factory.mktemp("moved")
    events: list[StageEvent] = []
    rendered = description(renders)
    write_capture(root, rendered)
    return root, rendered, run(JobSpec(capture=root), LocalContext(root, listener=events.append)), events


@pytest.mark.dear("It is the first to ask for the rendered frames.")
def test_residual_motion(
    moved: tuple[Path, Rendered, PreparedManifest, list[StageEvent]], renders: Mapping[str, Any]
) -> None:
    """After stabilisation the median residual motion is at most 0.2 px (acceptance); the motion is several pixels and
    includes a nod and a turn.
    """
    root, rendered, manifest, _ = moved
    folder, _ = open_stage(root, "prepared", PreparedManifest)
    motion = zarr.open_array(folder / "prepared.zarr" / "motion", mode="r")
    assert motion.attrs["step_px"] == 1
    before, after = [], []
    for k, camera in enumerate(rendered.cameras):
        footprint = project(camera, [rendered.mesh])
        for number, (light, _) in enumerate(FRAMES):
            if light >= 0:
                truth = true_displacement(rendered, camera, footprint, renders["motions"][number])
                before.append(np.linalg.norm(truth, axis=-1)[footprint.covered])
                after.append(np.linalg.norm(np.asarray(motion[k, light]) - truth, axis=-1)[footprint.covered])
    assert np.median(np.concatenate(before)) > 2
    assert np.median(np.concatenate(after)) <= 0.2
    assert max(float(np.median(frame)) for frame in after) <= 0.35
    assert manifest.median_motion_px == pytest.approx(np.median([np.median(frame) for frame in before]), abs=0.2)


def test_highlight_energy(
    moved: tuple[Path, Rendered, PreparedManifest, list[StageEvent]], renders: Mapping[str, Any]
) -> None:
    """At least 90 % of the reflected light is masked (acceptance; the goal is 95 %), and at most 3 % of the pixels that
    reflect less than the noise of 1 %.
    """
    root, rendered, _, _ = moved
    folder, _ = open_stage(root, "prepared", PreparedManifest)
    valid = zarr.open_array(folder / "prepared.zarr" / "valid", mode="r")
    masked = total = false = rest = 0.0
    for k, camera in enumerate(rendered.cameras):
        footprint = project(camera, [rendered.mesh])
        for number, (light, _) in enumerate(FRAMES):
            if light >= 0:
                truth = np.nan_to_num(
                    true_displacement(rendered, camera, footprint, renders["motions"][number])
                ).astype(np.float32)
                whole = warp(renders["total"][k, number].mean(axis=-1), truth)
                specular = (whole - warp(renders["diffuse"][k, number].mean(axis=-1), truth)) * footprint.covered
                highlight = (np.asarray(valid[k, light]) & (MaskBit.HIGHLIGHT | MaskBit.SATURATED)) > 0
                dull = footprint.covered & (specular < 0.01 * whole)
                masked, total = masked + specular[highlight].sum(), total + specular.sum()
                false, rest = false + np.count_nonzero(highlight & dull), rest + np.count_nonzero(dull)
    assert masked / total >= 0.9
    assert false / rest <= 0.03


def test_still_capture_keeps_radiance_and_variance(renders: Mapping[str, Any], tmp_path: Path) -> None:
    """Without motion a pixel is the rendered radiance plus the sensor's noise.

    For about 200,000 z-scores with the true variance, mean and mean square are tested to 5 standard errors (1e-6 false
    alarms each). The variance includes clipping and rounding. Black frames are shared within a camera, which correlates
    the images of a pixel and triples the error.
    """
    frozen = {**renders, "total": renders["total"].copy()}
    first = {light: number for number, (light, _) in enumerate(FRAMES) if light >= 0}
    rendered = description(frozen)
    # All frames with all lights on are copies of the first one, as if the subject held still.
    for number, (light, _) in enumerate(FRAMES):
        if light < 0:
            rendered.radiance[:, number] = rendered.radiance[:, 0]
    record = write_capture(tmp_path, rendered)
    manifest = run(JobSpec(capture=tmp_path), LocalContext(tmp_path))
    assert manifest.median_motion_px is not None
    assert manifest.median_motion_px < 0.1
    store = tmp_path / "prepared" / "prepared.zarr"
    radiance, variance, valid = (zarr.open_array(store / name, mode="r") for name in ("radiance", "variance", "valid"))
    gain = record.radiance_per_count / (0.5 * 0.05)
    scores, ratios = [], []
    for k in range(2):
        for light, number in first.items():
            used = np.asarray(valid[k, light]) == 0
            truth = rendered.radiance[k, number][used].astype(np.float64)
            expected = (0.01 * truth) ** 2 + gain**2 * ((0.002 * 4095) ** 2 + 1 / 12) * 1.5
            scores.append((np.asarray(radiance[k, light])[used] - truth) / np.sqrt(expected))
            ratios.append(np.asarray(variance[k, light])[used] / expected)
    z = np.concatenate(scores)
    assert abs(z.mean()) < 3 * 5 / np.sqrt(z.size)
    assert abs((z**2).mean() - 1) < 3 * 5 * np.sqrt(2 / z.size)
    assert np.concatenate(ratios).mean() == pytest.approx(1, abs=1e-3)


def test_events_quality_and_pictures(moved: tuple[Path, Rendered, PreparedManifest, list[StageEvent]]) -> None:
    root, rendered, manifest, events = moved
    told = [event.done for event in events if event.kind == "progress"]
    done = [one for one in told if one is not None]
    assert len(done) == len(told) == 2 * LIGHTS
    assert done == sorted(done)
    assert done[-1] == 1
    assert (events[0].kind, events[-1].kind) == ("started", "finished")
    report = read_record(root / "prepared" / "quality.json", QualityReport)
    assert sum(image.valid_by_tooth[11] for image in report.images) == manifest.tooth_pixels[0]
    # The motion is interpolated between four tracking frames, and its stated error is small.
    assert all(image.motion_error_px is not None and image.motion_error_px < 0.5 for image in report.images)
    assert len(report.images) == 2 * LIGHTS
    assert (
        sum(image.valid_pixels for image in report.images) / sum(image.tooth_pixels for image in report.images)
        == manifest.valid_fraction
    )
    assert all(
        (root / "prepared" / "quality" / f"{image.camera}_{image.light}.png").stat().st_size > 1000
        for image in report.images
    )
    # Optical flow does not use the scan. It shows the motion before stabilisation, and afterwards little more than its
    # own errors of some 0.2 px.
    assert [flow.camera for flow in report.flows] == [camera.name for camera in rendered.cameras]
    for flow in report.flows:
        assert flow.before_px[0] > 2
        assert flow.after_px[0] < 0.35
        for name in ("before", "after"):
            assert (root / "prepared" / "quality" / "flow" / f"{flow.camera}_{name}.png").stat().st_size > 1000
            assert f'src="flow/{flow.camera}_{name}.png"' in (root / "prepared" / "quality" / "index.html").read_text()
    # Neither the job nor the capture names held-out lights, so every fourth light is held out in all cameras.
    assert manifest.held_out == tuple((camera.name, f"l{k}") for camera in rendered.cameras for k in (3, 7))


def test_cancel_between_images_publishes_nothing(
    moved: tuple[Path, Rendered, PreparedManifest, list[StageEvent]], tmp_path: Path
) -> None:
    root = moved[0]

    def cancel_after_two(event: StageEvent) -> None:
        if event.kind == "progress" and (event.done or 0) * 2 * LIGHTS >= 2:
            (tmp_path / "cancel").touch()

    with pytest.raises(JobCancelledError):
        run(JobSpec(capture=root), LocalContext(tmp_path, listener=cancel_after_two))
    assert not (tmp_path / "prepared").exists()
    # The next attempt works in the same folder.
    (tmp_path / "cancel").unlink()
    with pytest.raises(JobCancelledError):
        run(JobSpec(capture=root), LocalContext(tmp_path, listener=cancel_after_two))


@pytest.mark.dear("It prepares four images, whose outlines are sought, after the rendered frames are there.")
def test_without_tracking_frames_the_operator_is_told_and_the_outline_tells_the_motion(
    renders: Mapping[str, Any], tmp_path: Path
) -> None:
    """The glossy tooth shifts, nods and turns by 3.7 and 2.5 px between two lights. Its translation is taken out to 0.5
    px, which is what the nod and the turn leave, as an outline is not asked for them.
    """
    whole = description(renders)
    numbers = [next(k for k, (light, _) in enumerate(FRAMES) if light == one) for one in (0, 5)]
    frames = tuple((light, FRAMES[number][1]) for light, number in enumerate(numbers))
    few = replace(whole, frames=frames, radiance=whole.radiance[:, numbers], lights=(whole.lights[0], whole.lights[5]))
    write_capture(tmp_path, few)
    events: list[StageEvent] = []
    manifest = run(JobSpec(capture=tmp_path, held_out_lights=("l5",)), LocalContext(tmp_path, listener=events.append))
    scarce, moved = [event.message for event in events if event.kind == "log"]
    assert scarce == (
        "Capture has 0 tracking frames, and 4 are needed to follow a smooth motion to 0.2 px; lower rig.tracking_every."
    )
    assert moved.startswith(
        "The subject moved since the first image in 2 of 4, as the outline of the teeth lies elsewhere"
    )
    assert manifest.held_out == (("c0", "l5"), ("c1", "l5"))
    folder, _ = open_stage(tmp_path, "prepared", PreparedManifest)
    motion = zarr.open_array(folder / "prepared.zarr" / "motion", mode="r")
    for k, camera in enumerate(few.cameras):
        footprint = project(camera, [few.mesh])
        first, last = (true_displacement(few, camera, footprint, renders["motions"][number]) for number in numbers)
        true = (last - first)[footprint.covered]
        assert np.median(np.linalg.norm(true, axis=-1)) > 2
        assert np.median(np.linalg.norm(np.asarray(motion[k, 1])[footprint.covered] - true, axis=-1)) < 0.5


def test_truncated_shard_is_named(renders: Mapping[str, Any], tmp_path: Path) -> None:
    write_capture(tmp_path, description(renders))
    shard = next(
        path
        for path in sorted((tmp_path / "capture" / "capture.zarr").rglob("*"))
        if path.is_file() and path.name != "zarr.json"
    )
    shard.write_bytes(shard.read_bytes()[:-100])
    with pytest.raises(CorruptStoreError, match=r"capture\.zarr.*truncated.*\.$"):
        run(JobSpec(capture=tmp_path), LocalContext(tmp_path))
