"""Misfits of real teeth registered by ``dentine register``: a patient's own, their mirror image, and another person's.

python -m tests.benchmarks.registration_real --json FILE      about a minute of processor time a draw of clicks

Five photographs of one patient, each alone, with the scan of a jaw that it shows: eight own pairs. The same photographs
with the mirror image of the patient's teeth are eight pairs of other teeth, and four of the upper jaw with a scan of
another person. Clicks have errors of 0.3 mm, drawn anew for each pair. The command runs with a limit that refuses
nothing by its misfit, and its record states the misfit; a pair that it refuses by the landmarks or the edges counts as
refused.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from services.anatomy.scans.scan import read_scan
from services.calibrate.registration.contours import tooth_contours
from services.calibrate.registration.register import MAX_MISFIT_MM
from services.core.files.meshes import read_mesh, read_teeth
from services.core.raw.registration import REGISTRATION
from tests.support.command_line import dentine
from tests.support.patient_folders import (
    CAMERA_FROM_JAW,
    Landmarked,
    landmarked,
    mirrored,
    patients_scan,
    write_patient_folder,
)
from tests.support.patient_photos import FOCAL_PX, camera, distance_to_edges_px

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"
NO_LIMIT_MM = "9"


def scans(shared: Path) -> Mapping[tuple[str, str], Landmarked]:
    """Landmarked scans by whose they are and by their jaw."""
    found = {}
    for jaw in ("upper", "lower"):
        own = patients_scan(shared / "intraoral-photos", jaw)
        found["own", jaw], found["mirrored", jaw] = landmarked(own), landmarked(mirrored(own))
    found["other", "upper"] = landmarked(read_scan(shared / "intraoral-arch" / "Example_01.vtp"))
    return found


def registered(
    shared: Path, known: Mapping[tuple[str, str], Landmarked], whose: str, jaw: Any, view: str, seed: int
) -> Any:
    """The misfit in mm that the command states, or the sentence with which it refuses."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_patient_folder(folder, shared / "intraoral-photos", jaw, view, known["own", jaw], known[whose, jaw], seed)
        ended = dentine("register", str(folder), "--max-misfit-mm", NO_LIMIT_MM)
        if ended.returncode:
            return ended.stderr.strip().replace(f"{folder}/", "")
        misfit_mm = round(float(json.loads((folder / REGISTRATION).read_text())["misfit_mm"]), 3)
        if whose == "own" and view in FOCAL_PX:
            # Outlines of the command's teeth against the hand-labelled edges, at a width of 800 pixels.
            teeth = [tooth.outer for tooth in read_teeth(folder, verify=False)]
            contour, _ = tooth_contours(camera(view), teeth, [read_mesh(folder / "gums.ply")])
            off_px = distance_to_edges_px(shared / "intraoral-photos", view, contour.pixels)
            print(f"{jaw} jaw, {view}: {np.median(off_px):.2f} px from the labelled edges in the median", flush=True)
        return misfit_mm


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--json", type=Path)
    parser.add_argument("--shared", type=Path, default=SHARED)
    parser.add_argument("--draws", type=int, default=1)
    parser.add_argument("--own-alone", action="store_true", help="leave out the pairs of other teeth")
    given = parser.parse_args()
    known, rows = scans(given.shared), []
    for draw in range(given.draws):
        for number, (jaw, view) in enumerate(CAMERA_FROM_JAW):
            for whose in ("own", "mirrored", "other"):
                if (whose, jaw) not in known or (given.own_alone and whose != "own"):
                    continue
                found = registered(given.shared, known, whose, jaw, view, 1000 * draw + number)
                rows.append({"whose": whose, "jaw": jaw, "photograph": view, "draw": draw, "misfit_mm": found})
                print(rows[-1], flush=True)
    for whose in ("own", "mirrored", "other"):
        found = [row["misfit_mm"] for row in rows if row["whose"] == whose]
        accepted = sum(not isinstance(one, str) and one <= MAX_MISFIT_MM for one in found)
        print(f"{whose}: {accepted} of {len(found)} accepted by the default limit of {MAX_MISFIT_MM:g} mm")
    if given.json:
        given.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
