"""Errors of a scan's pose after the landmarks and after the outlines, and whether the stated ± match them.

python -m tests.benchmarks.registration_steps --json steps.json [--draws 12] [--places 7]

A draw takes some 6 s of processor time.

Each draw is a different phantom subject in front of three cameras with pixels of 0.2 mm, clicks with errors of 0.3 mm,
and a scan with noise of 0.02 mm in its own frame that ends behind a given place from the midline. The photographs are
drawn (``tests.support.photographed_mouth``) and share neither outlines nor search with the registration. Draws that the
file holds already are not computed again.

Errors are twists about the teeth's centre from the estimated pose to the true one: the angle of the rotation in degrees
and the length of the translation in mm, as rms over the draws. Scores are the six components whitened by the step's own
covariance, as rms over six values per draw.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from services.anatomy.scans.scan import LabelledScan
from services.anatomy.scans.scanned_jaw import jaw_from_scan
from services.anatomy.templates.jaw import build_jaw
from services.calibrate.registration.outlines import outline_misfit_mm, pose_from_outlines
from services.calibrate.registration.photographs import crop_to_points
from services.calibrate.registration.pose import PoseStep, RigidPose
from services.calibrate.registration.register import REACH_MM
from services.core.geometry import Mesh
from services.phantom.lab.scan import scan_of
from tests.support.landmark_pose import pose_from_landmarks
from tests.support.photographed_mouth import Mouth, clicks_on, photographed_mouth

FIRST_SUBJECT = 2600
"""Number of the first subject. No threshold or constant was chosen with these subjects."""
PIXEL_MM = 0.2


def draw(number: int, places: int) -> dict[str, Any]:
    """Errors and scores of both steps for one subject."""
    jaw = build_jaw(FIRST_SUBJECT + number)
    mouth = photographed_mouth(None, FIRST_SUBJECT + number, PIXEL_MM, jaw)
    teeth, gums = _scanned(mouth, scan_of(jaw, seed=number, teeth_a_side=places))
    rng = np.random.default_rng([FIRST_SUBJECT, number])
    clicks = [one for one in clicks_on(mouth, rng) if int(one.name.split()[0]) % 10 <= places]
    vertices = np.concatenate([mesh.vertices_mm for mesh in teeth])
    centre = vertices.mean(axis=0)
    first = pose_from_landmarks(mouth.cameras, clicks, centre)
    views = [crop_to_points(view, first.pose.apply(vertices)) for view in mouth.views]
    reach_px = REACH_MM / min(view.camera.pixel_mm(first.pose.apply(centre[None])[0]) for view in views)
    second = pose_from_outlines(views, teeth, [gums], first, centre, reach_px)
    told: dict[str, dict[str, Any]] = {step.name: _judged(step, mouth, centre) for step in (first, second)}
    return {"number": number, **told, "misfit_mm": outline_misfit_mm(views, teeth, [gums], second.pose)}


def _scanned(mouth: Mouth, scan: LabelledScan) -> tuple[list[Mesh], Mesh]:
    # Build the solids of a scan in the scan's own frame.
    pose = mouth.rig_from_scan
    vertices = (scan.mesh.vertices_mm - pose.translation_mm) @ pose.rotation
    jaw = jaw_from_scan(LabelledScan(Mesh(vertices, scan.mesh.faces), scan.fdi), "whole")
    scan_from_arch = np.asarray(np.linalg.inv(jaw.arch_from_scan), dtype=np.float64)
    back = RigidPose(scan_from_arch[:3, :3], scan_from_arch[:3, 3])
    solids = [*(tooth.outer for tooth in jaw.teeth), jaw.gums]
    *teeth, gums = (Mesh(back.apply(mesh.vertices_mm), mesh.faces) for mesh in solids)
    return teeth, gums


def _judged(step: PoseStep, mouth: Mouth, centre: np.ndarray) -> dict[str, Any]:
    twist = step.pose.twist_to(mouth.rig_from_scan, step.pose.apply(centre[None])[0])
    spread = np.sqrt(np.diag(step.covariance))
    return {
        "turn_deg": float(np.degrees(np.linalg.norm(twist[:3]))),
        "move_mm": float(np.linalg.norm(twist[3:])),
        "turn_se_deg": float(np.degrees(np.linalg.norm(spread[:3]))),
        "move_se_mm": float(np.linalg.norm(spread[3:])),
        "scores": np.linalg.solve(np.linalg.cholesky(step.covariance), twist).tolist(),
    }


def table(draws: Sequence[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Rms errors, median standard errors and rms scores by step."""
    rows = {}
    for name in ("landmarks", "outlines"):
        steps = [one[name] for one in draws]
        rows[name] = {
            **{f"rms_{key}": _rms([step[key] for step in steps]) for key in ("turn_deg", "move_mm")},
            **{
                f"median_{key}": float(np.median([step[key] for step in steps]))
                for key in ("turn_se_deg", "move_se_mm")
            },
            "rms_score": _rms([score for step in steps for score in step["scores"]]),
            "scores": sum(len(step["scores"]) for step in steps),
        }
    return rows


def _rms(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def main() -> None:
    """Measure the missing draws and write JSON after each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=True, help="where the figures go")
    parser.add_argument("--draws", type=int, default=12)
    parser.add_argument(
        "--places", type=int, default=7, help="teeth from the midline that are scanned; 3: six front teeth"
    )
    options = parser.parse_args()
    held = json.loads(options.json.read_text()) if options.json.is_file() else {"places": options.places, "draws": []}
    if held["places"] != options.places:
        parser.error(f"{options.json} is of {held['places']} places; name another file")
    for number in range(len(held["draws"]), options.draws):
        held["draws"].append(draw(number, options.places))
        held["table"] = table(held["draws"])
        options.json.write_text(json.dumps(held, indent=1) + "\n")
        print(json.dumps(held["draws"][-1]), flush=True)
    print(json.dumps(held["table"], indent=1))


if __name__ == "__main__":
    main()
