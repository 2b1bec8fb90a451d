"""Effect of a calibration on a fit: a tooth rendered by stock Mitsuba is fitted with the calibration that a random
session gave, as JSON.

python -m tests.benchmarks.calibration_to_fit --sessions 4 --json calibration_to_fit.json

The three cameras and eight lights of the stored central incisor are calibrated by a virtual session as in
``calibrate_sessions``: boards of 0.1 px, a mirror sphere in ten places, a white sphere in three. The fit receives the
session's results: cameras, lights, intensities, radiance per count, and the record's covariance. Such a session
measures neither flare nor the scan's pose, and the white sphere's reflectance to no better than 1 %. The fit assumes
defaults for these errors, and they are drawn from the same defaults. All poses are in the frame of the session's first
board, so mesh, lights and cameras of ``capture.json`` move and no image is rendered again. Session 0 is a perfect
calibration whose record states almost no errors.

Fits run in this process, on one thread, and take some minutes of processor time each. ``rows`` holds each value's error
over its ±, and the ± over that of the perfect calibration.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.bench.fits.tooth_capture import prepared_tooth
from services.calibrate.cameras.lens import Lens
from services.calibrate.cameras.rotations import pose_matrix, pose_vector
from services.calibrate.lights.mirror import PosedCamera
from services.calibrate.session.boards import CamerasStep
from services.calibrate.session.record import REFLECTANCE_SE, uncertainty_of
from services.calibrate.session.spheres import IntensityStep, LightsStep
from services.core.calibration.uncertainty import CalibrationUncertainty
from services.core.files.meshes import read_mesh, write_mesh
from services.core.geometry import Mesh
from services.core.raw.records import RawFolder
from services.core.records import JobSpec
from services.core.results import FitReport
from services.core.stage import LocalContext
from services.core.store import open_stage
from services.fit.coordinates.instrument_errors import DEFAULT_MOVE_SE, DEFAULT_SE
from services.fit.stage import run
from services.transport.platform import prepare_device
from services.transport.scene.rigid_moves import rigid
from tests.benchmarks.calibrate_sessions import COUNTS, N_PLACES, found_rig, photographed_spheres, posed_cameras_of
from tests.support.board_sessions import in_first_frame, tilted_places
from tests.support.truths import SIDE_LIGHTS, Truth, read, write_capture

Floats = NDArray[np.float64]
SUBJECT, CHANNEL = "central-incisor", "green"
QUANTITIES = ("enamel.sigma_s_reduced", "enamel.sigma_a", "dentin.sigma_s_reduced", "dentin.sigma_a")
OPTIONS: dict[str, Any] = {"boundary": "matched", "dentin": "known", "advise": False, "held_out_lights": SIDE_LIGHTS}
FINER = 4
"""Pixels of the calibrated camera along the side of one pixel of the stored images; one is 0.125 mm wide at a metre."""
SIZE = (1600, 1200)
PERFECT_SE = 1e-5
"""Standard error that the perfect calibration states for every quantity; relative, rad or mm."""
MAX_Z, MAX_SE_RATIO = 3.0, 2.0


@dataclass(frozen=True)
class Drawn:
    """Results of a calibration session in the frame of its first board, as the fit receives them.

    Attributes:
        board_from_world: true pose of the stored tooth (4, 4).
        cameras: K (3, 3) of the stored images and camera_from_world (4, 4), by camera.
        lights_mm: positions of the lights (L, 3).
        intensity: intensities (L,) over the mean of the true ones.
        radiance: radiance per count (K,) by camera, over the true one.
        uncertainty: uncertainty of the calibration record.
    """

    board_from_world: Floats
    cameras: list[tuple[Floats, Floats]]
    lights_mm: Floats
    intensity: Floats
    radiance: Floats
    uncertainty: CalibrationUncertainty


def perfect(truth: Truth) -> Drawn:
    """A calibration without errors whose stated standard errors are ``PERFECT_SE``."""
    cameras = [(np.array(one["K"]), np.array(one["camera_from_world"])) for one in truth.description["cameras"]]
    lights = truth.description["lights"]
    names = [f"gain.{CHANNEL}", *(f"light_gain.{light['name']}" for light in lights)]
    names += [f"light.{light['name']}.{axis}" for light in lights for axis in "xyz"]
    names += [f"dome.{axis}" for axis in ("rx", "ry", "rz", "tx", "ty", "tz")]
    stated = {"names": names, "covariance": (PERFECT_SE**2 * np.eye(len(names))).tolist()}
    bright = np.array([light["intensity"][0] for light in lights])
    where = np.array([light["position_mm"] for light in lights])
    told = CalibrationUncertainty.model_validate(stated)
    return Drawn(np.eye(4), cameras, where, bright / bright.mean(), np.ones(len(cameras)), told)


def session(truth: Truth, seed: int) -> Drawn:
    """Draw one calibration session of the stored rig, and calibrate it."""
    random, description = np.random.default_rng(7000 + seed), truth.description
    names, lamps = [one["name"] for one in description["cameras"]], [one["name"] for one in description["lights"]]
    poses = [pose_vector(np.array(one["camera_from_world"])) for one in description["cameras"]]
    lenses = [_lens(np.array(one["K"]), random) for one in description["cameras"]]
    towards = _turn_to(
        np.mean([PosedCamera(lens, pose).centre_mm for lens, pose in zip(lenses, poses, strict=True)], axis=0)
    )
    places = tilted_places(random, N_PLACES, towards)
    rig = in_first_frame(tuple(lenses), poses, places)
    board_from_world: Floats = np.asarray(np.linalg.inv(places[0]), dtype=np.float64)
    teeth = board_from_world[:3, 3]
    fit, views = found_rig(random, rig, names)
    cameras = CamerasStep(tuple(names), fit, {}, tuple(views), ())
    lights = _moved(board_from_world, np.array([one["position_mm"] for one in description["lights"]]))
    bright = np.array([one["intensity"] for one in description["lights"]])
    true, bright = posed_cameras_of(rig), bright / bright.mean()
    off = random.normal(0, REFLECTANCE_SE)
    spheres = photographed_spheres(
        random, true, cameras.posed_cameras, cameras.camera_covariance, lights, teeth, lamps, bright, off
    )
    found, white = spheres.fit, spheres.intensity
    folder = RawFolder.model_validate(
        {
            "units": "mm",
            "camera": [{"name": name, "size": SIZE, "bits": 12, "channels": [CHANNEL]} for name in names],
            "light": [{"name": name} for name in lamps],
            "frame": [{"camera": names[0], "file": "black.npy", "kind": "black", "exposure_s": 1.0}],
        }
    )
    stated = uncertainty_of(
        folder,
        cameras,
        LightsStep(found, tuple(spheres.views), (), None, ()),
        IntensityStep(white, tuple(spheres.photos), spheres.white_mm.mean(axis=0)),
    )
    points = _moved(board_from_world, truth.meshes["outer"].vertices_mm)
    seen = [
        (_pinhole(own, camera, guess, points), pose_matrix(guess.pose))
        for own, camera, guess in zip(description["cameras"], true, found.cameras, strict=True)
    ]
    radiance = white.radiance_per_count[:, 0] * COUNTS
    return Drawn(board_from_world, seen, found.positions_mm, white.intensity[:, 0], radiance, stated)


def _lens(stored: Floats, random: np.random.Generator) -> Lens:
    distortion = np.array([-0.12, 0.08, 0.0006, -0.0004]) * random.uniform(0.7, 1.3, 4)
    return Lens(SIZE, np.array([FINER * stored[0, 0], FINER * stored[1, 1], 805.0, 590.0, *distortion]))


def _turn_to(away: Floats) -> Floats:
    """A rotation (3, 3) that brings +z to a direction."""
    z = away / np.linalg.norm(away)
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def _pinhole(stored: dict[str, Any], true: PosedCamera, found: PosedCamera, points_mm: Floats) -> Floats:
    """K (3, 3) that maps the rays of the fitted lens to the pixels of the stored image, without distortion.

    The stored image is that of the true camera without its distortion. A laboratory removes the distortion that it
    fitted; over the tooth, the rest is an affine map of pixels to within a thousandth of a pixel.
    """
    import cv2

    local = points_mm @ true.rotation.T + true.pose[3:]
    pixels = local[:, :2] / local[:, 2:] * np.diag(np.array(stored["K"]))[:2] + np.array(stored["K"])[:2, 2]
    raw = true.project(points_mm)
    rays = cv2.undistortPoints(raw[:, None], found.lens.matrix, found.lens.distortion)[:, 0]
    one = np.ones((len(rays), 1))
    across, down = (
        np.linalg.lstsq(columns, pixels[:, axis], rcond=None)[0]
        for axis, columns in enumerate((np.hstack([rays, one]), np.hstack([rays[:, 1:], one])))
    )
    return np.array([across, [0.0, *down], [0.0, 0.0, 1.0]])


def _moved(move: Floats, points_mm: Floats) -> Floats:
    return np.asarray(points_mm @ move[:3, :3].T + move[:3, 3])


def write(folder: Path, truth: Truth, drawn: Drawn, random: np.random.Generator | None) -> None:
    """Change a written capture into that of the drawn instrument, with random flare and a random error of the scan's
    pose.

    Args:
        random: generator of these two errors; None for a perfect instrument.
    """
    description = json.loads((folder / "capture.json").read_text())
    for camera, (matrix, pose) in zip(description["cameras"], drawn.cameras, strict=True):
        camera |= {"K": matrix.tolist(), "camera_from_world": pose.tolist()}
    mean = np.mean([light["intensity"] for light in description["lights"]])
    for light, where, bright in zip(description["lights"], drawn.lights_mm, drawn.intensity, strict=True):
        light |= {"position_mm": where.tolist(), "intensity": [float(bright * mean)]}
    uncertainty = json.loads(drawn.uncertainty.model_dump_json())
    (folder / "capture.json").write_text(json.dumps(description | {"uncertainty": uncertainty}))

    names = [camera["name"] for camera in description["cameras"]]
    flare = np.zeros(len(names)) if random is None else random.normal(0, DEFAULT_SE["flare"], len(names))
    for number, name in enumerate(names):
        brightest = float(truth.mean[name].max())
        for one in (one for one in description["images"] if one["camera"] == name):
            image, variance = (np.load(folder / one[key]) for key in ("file", "variance_file"))
            scale = drawn.radiance[number]
            np.save(folder / one["file"], (scale * (image + flare[number] * brightest)).astype(np.float32))
            np.save(folder / one["variance_file"], (scale**2 * variance).astype(np.float32))

    centre = _moved(drawn.board_from_world, truth.meshes["outer"].vertices_mm).mean(axis=0)
    twist = np.zeros(6) if random is None else random.normal(0, DEFAULT_MOVE_SE["teeth"])
    for path in (folder / "teeth").rglob("*.ply"):
        mesh = read_mesh(path)
        placed = _moved(rigid(twist, centre) @ drawn.board_from_world, mesh.vertices_mm)
        write_mesh(path, Mesh(placed, mesh.faces))


def fit(folder: Path, number: int, options: dict[str, Any]) -> dict[str, Any]:
    """Run one fit; returns values with their ± and parts of these, and the session's errors. Session 0 is perfect."""
    truth = write_capture(SUBJECT, folder / "capture", seed=max(number, 1))
    drawn = session(truth, number) if number else perfect(truth)
    write(folder / "capture", truth, drawn, np.random.default_rng(8000 + number) if number else None)
    spec = JobSpec.model_validate(OPTIONS | {"capture": folder / "capture"} | options)
    began = time.process_time()
    prepared_tooth(folder / "job", spec)
    run(spec, LocalContext(folder / "job"))
    _, report = open_stage(folder / "job", "fit", FitReport)
    table = report.parameters[CHANNEL]
    return {
        "session": number,
        "off": _off(truth, drawn),
        "values": {name: table[name].model_dump() for name in QUANTITIES},
        "faults": report.instrument_faults.get(CHANNEL, ()),
        "advice": report.advice,
        "assumed": report.assumed,
        "held_out_error": report.held_out_error,
        "converged": report.converged,
        "steps": report.steps,
        "seconds": time.process_time() - began,
    }


def _off(truth: Truth, drawn: Drawn) -> dict[str, float]:
    """Errors of a session: the lights' positions (rms, mm), their intensities (relative, rms), and the mean relative
    error of all radiances.
    """
    lights = truth.description["lights"]
    where = _moved(drawn.board_from_world, np.array([one["position_mm"] for one in lights]))
    bright = np.array([one["intensity"][0] for one in lights])
    return {
        "lights_mm": math.sqrt(float(((drawn.lights_mm - where) ** 2).sum(axis=1).mean())),
        "intensity": float(np.std(np.log(drawn.intensity / bright))),
        "radiance": float(np.log(drawn.radiance).mean()),
    }


def rows(fits: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """One row per session: each quantity's error over its ±, the ± in per cent of the truth, and the ± over that of the
    perfect calibration where session 0 was fitted.
    """
    truth = read(SUBJECT)
    media = {part: truth.medium(part) for part in ("enamel", "dentin")}
    true = {f"{part}.sigma_s_reduced": one["sigma_s_reduced"] for part, one in media.items()}
    true |= {f"{part}.sigma_a": (1 - one["alpha"]) * one["sigma"] for part, one in media.items()}
    best = next((one["values"] for one in fits if not one["session"]), None)
    return [
        {
            "session": one["session"],
            "seconds": round(one["seconds"]),
            "faults": one["faults"],
            **{
                name: {
                    "z": round((own["value"] - true[name]) / own["se"], 2),
                    "se_percent": round(100 * own["se"] / true[name], 1),
                    "se_over_perfect": None if best is None else round(own["se"] / best[name]["se"], 2),
                }
                for name, own in one["values"].items()
            },
        }
        for one in fits
    ]


def main() -> None:
    """Run the sessions that are missing, write the file after each, and print the largest figures with their limits."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=True, help="where results go; sessions in it are not run again")
    parser.add_argument("--sessions", type=int, default=4)
    parser.add_argument("--pixel-step", type=int, default=2)
    parser.add_argument("--options", type=json.loads, default={}, help="further options of the job, as JSON")
    given = parser.parse_args()
    prepare_device(1)
    fits = json.loads(given.json.read_text())["fits"] if given.json.is_file() else []
    for number in range(given.sessions + 1):
        if all(one["session"] != number for one in fits):
            with tempfile.TemporaryDirectory() as folder:
                fits.append(fit(Path(folder), number, {"pixel_step": given.pixel_step} | given.options))
            given.json.write_text(json.dumps({"rows": rows(fits), "fits": fits}, indent=1))
            print(json.dumps(rows(fits)[-1]), flush=True)
    drawn = [row[name] for row in rows(fits) if row["session"] for name in QUANTITIES]
    if drawn:
        z, ratio = (max(abs(one[key]) for one in drawn) for key in ("z", "se_over_perfect"))
        print(
            f"largest |z| {z} of {len(drawn)} (at most {MAX_Z}); largest ± over perfect {ratio} (at most"
            f" {MAX_SE_RATIO})"
        )


if __name__ == "__main__":
    main()
