"""Calibration of a raw folder's frames, and its files ``calibration.json`` and ``residuals.json``."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from services.calibrate.lights.mirror import PosedCamera
from services.calibrate.session.boards import CamerasStep, calibrate_cameras
from services.calibrate.session.charts import ColourStep, calibrate_colours
from services.calibrate.session.flats import measure_vignetting
from services.calibrate.session.judge import Judgement, judge
from services.calibrate.session.photos import Photos
from services.calibrate.session.record import light_positions, record_of
from services.calibrate.session.spheres import IntensityStep, LightsStep, find_lights, measure_intensity
from services.core.calibration.record import CALIBRATION_FILE, Calibration
from services.core.raw.folder import DESCRIPTION, read_raw_folder
from services.core.store import write_atomic, write_record

VALID_DAYS = 30.0
"""Default validity of a calibration: a rig in a dental practice is touched within a month."""
CALIBRATION, RESIDUALS, PREVIOUS = CALIBRATION_FILE, "residuals.json", "calibration.previous.json"


@dataclass(frozen=True)
class Session:
    """Results of all steps of the calibration of a raw folder, and the judgement on them."""

    record: Calibration
    cameras: CamerasStep
    lights: LightsStep | None
    intensity: IntensityStep | None
    colours: ColourStep | None
    judgement: Judgement

    @property
    def posed_cameras(self) -> Sequence[PosedCamera]:
        """The cameras of the record: as boards have them, or as boards and mirror spheres together."""
        return self.cameras.posed_cameras if self.lights is None else self.lights.fit.cameras


def calibrate(
    root: Path, report_step: Callable[[str], None] = lambda _: None, valid_days: float = VALID_DAYS
) -> Session:
    """Calibrate cameras, lights and colours from the frames of a raw folder.

    Args:
        root: folder with ``raw.toml``.
        report_step: called with a description of each step as it begins.
        valid_days: validity in days that the record states.

    Raises:
        CaptureInputError: names the frame, board, sphere or camera that cannot be used, and the remedy.
    """
    folder = read_raw_folder(root)
    photos = Photos(root, folder)
    report_step("cameras: boards, lenses, poses")
    cameras = calibrate_cameras(photos)
    report_step("lights: mirror spheres")
    lights = find_lights(photos, cameras.posed_cameras, cameras.camera_covariance, cameras.distance_mm)
    posed_cameras = cameras.posed_cameras if lights is None else lights.fit.cameras
    report_step("intensities: white spheres")
    positions = np.full((len(folder.light), 3), np.nan)
    for number, where in light_positions(folder, lights).items():
        positions[number] = where
    vignettings = {
        name: vignetting
        for name, camera in zip(cameras.names, posed_cameras, strict=True)
        if (vignetting := measure_vignetting(photos, name, camera.lens.values[2:4])) is not None
    }
    intensity = measure_intensity(photos, posed_cameras, positions, cameras.distance_mm, vignettings)
    report_step("colours: charts")
    colours = calibrate_colours(photos)
    used = [root / DESCRIPTION, *(root / frame.file for frame in folder.frame if _is_used(frame.kind))]
    used += [
        root / chart.reference for chart in folder.chart if any(frame.chart == chart.name for frame in folder.frame)
    ]
    inputs = {path.relative_to(root).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in used}
    made = datetime.now(UTC).isoformat(timespec="seconds")
    record = record_of(folder, photos.black, vignettings, cameras, lights, intensity, colours, made, valid_days, inputs)
    judgement = judge(folder, cameras, lights, intensity, colours, record.uncertainty, photos.black, inputs)
    record = record.model_copy(update={"limits": judgement.recorded})
    return Session(record, cameras, lights, intensity, colours, judgement)


def write_session(session: Session, out: Path) -> None:
    """Write ``calibration.json`` and ``residuals.json`` into a folder; a record that is there is kept as
    ``calibration.previous.json``.
    """
    out.mkdir(parents=True, exist_ok=True)
    if (out / CALIBRATION).is_file():
        write_atomic(out / PREVIOUS, (out / CALIBRATION).read_bytes())
    write_atomic(out / RESIDUALS, (json.dumps(_residuals(session), indent=1) + "\n").encode())
    write_record(out / CALIBRATION, session.record)


def _is_used(kind: str) -> bool:
    return kind in {"black", "flat", "board", "mirror-sphere", "white-sphere", "chart"}


def _residuals(session: Session) -> dict[str, Any]:
    """Return the residuals of each step, by photograph."""
    fit = session.cameras.fit
    residuals: dict[str, Any] = {
        "corners": [
            {
                "file": view.name,
                "ids": view.ids.tolist(),
                "seen_px": np.round(view.pixels, 4).tolist(),
                "seen_minus_drawn_px": np.round(fit.residuals_px[fit.corners.view == number], 4).tolist(),
                "used": fit.inliers[fit.corners.view == number].tolist(),
            }
            for number, view in enumerate(session.cameras.views)
        ]
    }
    if session.lights is not None:
        first = 0
        residuals["highlights"] = []
        for name, view in zip(session.lights.view_names, session.lights.views, strict=True):
            off = session.lights.fit.highlight_errors_px[first : first + len(view.lights)]
            first += len(view.lights)
            residuals["highlights"].append(
                {"of": name, "lights": view.lights.tolist(), "seen_minus_drawn_px": np.round(off, 4).tolist()}
            )
    if session.intensity is not None:
        residuals["white_spheres"] = np.round(session.intensity.fit.residuals, 6).tolist()
    if session.colours is not None:
        residuals["patches_delta_e_2000"] = {name: one.fitted.tolist() for name, one in session.colours.fits.items()}
    return residuals
