"""Fits of the micro-CT incisor with its scan in place and aside, as JSON: unseen images, parameters, pose found.

python -m tests.benchmarks.moved_scan --folder moved-scan --json moved_scan.json
python -m tests.benchmarks.moved_scan --folder moved-scan --json drawn.json --offsets drawn --seeds 11-20

The photographs are stock Mitsuba's (``shared/data/tooth-ur1-truth``, 3 cameras, 8 lights, pixels of 0.5 mm), with
sensor noise, and with gains and flares drawn from what the capture states of them: 1 % a gain, 0.3 % a flare. The scan
is moved by ``--offsets`` mm in one direction, where 0.1 mm and 0.1 degrees are stated; ``drawn`` draws its pose and the
dome's as stated. Fits run in this process on one thread, for some minutes of a core each; fits that the folder holds
already are not run again.
"""

from __future__ import annotations

import argparse
import json
import shutil
import time
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.bench.fits.tooth_capture import photograph, real_tooth
from services.core.calibration.uncertainty import TWIST
from services.core.errors import SettingsError
from services.core.files.meshes import read_mesh, write_mesh
from services.core.geometry import Mesh
from services.core.records import JobSpec
from services.core.results import FitReport
from services.core.stage import LocalContext
from services.core.store import is_published, open_stage, write_atomic
from services.fit.coordinates.instrument_errors import DEFAULT_SE
from services.fit.stage import run
from services.preprocess.stage import run as prepare
from services.transport.platform import prepare_device
from services.transport.scene.rigid_moves import rigid

Array = NDArray[np.float64]

SCAN_SE = np.array([np.radians(0.1)] * 3 + [0.1] * 3)
DOME_SE = np.array([np.radians(0.1)] * 3 + [2.0] * 3)
"""Stated standard errors of the poses of scan and dome, rad and mm."""
DIRECTION = np.array([0.6, -0.62, 0.5])
"""Direction of the offset in the world; every camera sees most of it."""
QUANTITIES = ("enamel.sigma_s_reduced", "enamel.sigma_a", "dentin.sigma_s_reduced", "dentin.sigma_a")
OPTIONS = {"boundary": "matched", "dentin": "known", "advise": False, "image_tolerance": 0.01}


def write_capture(source: Path, target: Path, offset: str, seed: int) -> None:
    """Write the incisor's capture with an instrument's errors.

    Args:
        source: folder of stock Mitsuba's images.
        target: folder of the new capture.
        offset: length in mm of the scan's offset, or ``drawn`` for poses of scan and dome as stated.
        seed: of the sensor's noise and of all that is drawn.
    """
    random = np.random.default_rng([62, seed])
    shutil.copytree(source, target, ignore=shutil.ignore_patterns("*.npy"), dirs_exist_ok=True)
    for path in target.rglob("*"):
        path.chmod(0o755 if path.is_dir() else 0o644)
    target.chmod(0o755)
    described = json.loads((source / "capture.json").read_text())
    lights, cameras = ([one["name"] for one in described[key]] for key in ("lights", "cameras"))
    gains = dict(zip(lights, DEFAULT_SE["light_gain"] * random.standard_normal(len(lights)), strict=True))
    flares = dict(zip(cameras, DEFAULT_SE["flare"] * random.standard_normal(len(cameras)), strict=True))
    gain = DEFAULT_SE["gain"] * random.standard_normal()
    drawn = rigid(SCAN_SE * random.standard_normal(6), np.zeros(3)), DOME_SE * random.standard_normal(6)
    true = {one["file"]: np.load(source / one["file"]).astype(np.float64) for one in described["images"]}
    brightest = {
        name: max(true[one["file"]].max() for one in described["images"] if one["camera"] == name) for name in cameras
    }
    for one in described["images"]:
        variance = np.load(source / one["variance_file"]).astype(np.float64)
        scale = 1 + gain + gains[one["light"]]
        taken, noise = photograph(
            scale * true[one["file"]] + flares[one["camera"]] * brightest[one["camera"]], scale**2 * variance, random
        )
        np.save(target / one["file"], taken)
        np.save(target / one["variance_file"], noise)

    move = np.eye(4)
    if offset == "drawn":
        move = drawn[0]
        places_mm = np.array([one["position_mm"] for one in described["lights"]])
        dome = rigid(drawn[1], places_mm.mean(axis=0))
        for one, place_mm in zip(described["lights"], places_mm @ dome[:3, :3].T + dome[:3, 3], strict=True):
            one["position_mm"] = place_mm.tolist()
    else:
        move[:3, 3] = float(offset) * DIRECTION / np.linalg.norm(DIRECTION)
    for path in (target / "teeth").rglob("*.ply"):
        mesh = read_mesh(path)
        write_mesh(path, Mesh(mesh.vertices_mm @ move[:3, :3].T + move[:3, 3], mesh.faces))
    names = [f"{body}.{axis}" for body in ("teeth", "dome") for axis in TWIST]
    described["uncertainty"] = {
        "names": names,
        "covariance": np.diag(np.concatenate([SCAN_SE, DOME_SE]) ** 2).tolist(),
    }
    (target / "capture.json").write_text(json.dumps(described))


def fitted(source: Path, folder: Path, offset: str, seed: int, options: dict[str, Any]) -> dict[str, Any]:
    """Write, prepare and fit one capture; its result as a row."""
    own = folder / f"{offset}-{seed}"
    kept = own / "row.json"
    if kept.is_file():
        row: dict[str, Any] = json.loads(kept.read_text())
        return row
    if not (own / "capture" / "capture.json").is_file():
        write_capture(source, own / "capture", offset, seed)
    spec = JobSpec.model_validate(OPTIONS | {"capture": own / "capture", "seed": seed} | options)
    context = LocalContext(own / "job")
    if not is_published(own / "job", "prepared"):
        prepare(spec, context)
    began_s = time.process_time()
    run(spec, context)
    seconds = time.process_time() - began_s
    report = open_stage(own / "job", "fit", FitReport)[1]
    truth = json.loads((source / "truth.json").read_text())
    (channel,) = report.parameters
    table = report.parameters[channel]
    values = {}
    for name in QUANTITIES:
        part, leaf = name.split(".")
        media, found = truth[part], table[name]
        true = media["sigma_s_reduced"] if leaf == "sigma_s_reduced" else (1 - media["albedo"]) * media["sigma_t"]
        assert found.se is not None
        values[name] = {
            "value": found.value,
            "se": found.se,
            "off_percent": round(100 * (found.value / true - 1), 2),
            "off_over_se": round((found.value - true) / found.se, 2),
            "parts": {part: round(100 * se / true, 2) for part, se in found.se_parts.items()},
        }
    row = {
        "offset": offset,
        "seed": seed,
        "held_out_error": report.held_out_error[channel],
        "held_out_error_se": report.held_out_error_se[channel],
        "fit_error": report.fit_error[channel],
        "converged": report.converged,
        "doubtful": report.doubtful,
        "steps": report.steps,
        "values": values,
        "instrument": {name: (one.value, one.se) for name, one in report.instrument.get(channel, {}).items()},
        "told": report.instrument_told,
        "advice": report.advice,
        "seconds": round(seconds, 1),
    }
    write_atomic(kept, json.dumps(row, indent=1).encode())
    return row


def main() -> None:
    """Run the fits asked for, write the file after each, and print the rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, required=True, help="kept, and gone on with")
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--offsets", default="0,0.33", help="mm, or drawn")
    parser.add_argument("--seeds", type=_seeds, default=(1,), help="3 for 1 to 3, or 11-20")
    parser.add_argument("--options", type=json.loads, default={}, help="further options of the job, as JSON")
    given = parser.parse_args()
    source = real_tooth()
    if source is None:
        raise SettingsError("The micro-CT incisor does not lie beside the checkout; put it at ../shared/data.")
    prepare_device(1)
    rows = []
    for seed, offset in product(given.seeds, given.offsets.split(",")):
        rows.append(fitted(source, given.folder, offset, seed, given.options))
        write_atomic(given.json, json.dumps(rows, indent=1).encode())
        print(json.dumps(rows[-1]), flush=True)


def _seeds(text: str) -> tuple[int, ...]:
    first, dash, last = text.partition("-")
    return tuple(range(int(first), int(last) + 1)) if dash else tuple(range(1, int(first) + 1))


if __name__ == "__main__":
    main()
