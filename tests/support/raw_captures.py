"""A raw folder, as a laboratory would record it, made from a folder capture by a known sensor."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from services.core.calibration.record import Calibration
from services.core.records import FolderCapture
from services.core.store import read_record
from tests.support.raw_folders import Tree, write_toml
from tests.support.raw_sensor import Sensor

FULL_AT = 0.8
"""Share of the range above black that the brightest pixel of all images reaches in the reference exposure, which is the
second longest (or the only one)."""


def write_raw_capture(
    root: Path,
    source: Path,
    sensor: Sensor,
    exposures_s: Sequence[float] = (0.05,),
    *,
    tracking: int = 4,
    flats: int = 2,
    blacks: int = 4,
    seed: int = 1,
) -> Tree:
    """Write ``raw.toml``, frames as .npy, ``calibration.json`` and ``teeth/``; returns the description's tree.

    Args:
        source: folder capture whose images are the radiance that the sensor records.
        exposures_s: exposure times of every light, ascending.
        tracking: number of frames per camera with all lights on, spread among the lights.
        flats: number of frames per camera of a uniform source.
        blacks: number of black frames per camera and exposure.
    """
    rng = np.random.default_rng(seed)
    description = read_record(source / "capture.json", FolderCapture)
    root.mkdir(parents=True, exist_ok=True)
    shutil.copytree(source / "teeth", root / "teeth")
    images = {(one.camera, one.light): np.load(source / one.file).astype(float) for one in description.images}
    images = {key: image if image.ndim == 3 else image[..., None] for key, image in images.items()}
    brightest = max(image.max() for image in images.values())
    reference_s = exposures_s[max(len(exposures_s) - 2, 0)]
    per_radiance = FULL_AT * (sensor.full - sensor.black) / (brightest * reference_s)
    sensor = replace(sensor, counts_per_radiance=per_radiance)
    _write_calibration(root / "calibration.json", description, per_radiance)

    frames: list[dict[str, Any]] = []

    def shoot(camera: str, name: str, radiance: np.ndarray, exposure_s: float, **told: Any) -> None:
        file = f"{camera}_{name}.npy"
        np.save(root / file, sensor.counts(radiance, exposure_s, rng))
        frames.append({"camera": camera, "file": file, "exposure_s": exposure_s, **told})

    lights = [light.name for light in description.lights]
    for camera in (one.name for one in description.cameras):
        shape = images[camera, lights[0]].shape
        every = np.sum([images[camera, light] for light in lights], axis=0) / len(lights)
        for exposure_s in exposures_s:
            for k in range(blacks):
                shoot(camera, f"black{k}_{exposure_s:g}", np.zeros(shape), exposure_s, kind="black")
        for k in range(flats):
            shoot(camera, f"flat{k}", np.full(shape, 0.7 * brightest), reference_s, kind="flat")
        at = set(np.linspace(0, len(lights), tracking).astype(int).tolist()) if tracking else set()
        for j in range(len(lights) + 1):
            if j in at:
                told = {"kind": "tracking", "level": round(1 / len(lights), 6)}
                shoot(camera, f"all{j}", every, reference_s, **told)
            if j < len(lights):
                for exposure_s in exposures_s:
                    told = {"kind": "light", "light": lights[j]}
                    shoot(camera, f"{lights[j]}_{exposure_s:g}", images[camera, lights[j]], exposure_s, **told)
    cameras = [
        {"name": one.name, "size": list(one.size), "bits": sensor.bits, "mosaic": sensor.mosaic}
        | ({} if sensor.mosaic != "none" else {"channels": list(description.channels)})
        for one in description.cameras
    ]
    tree: Tree = {"units": "mm", "calibration": {"file": "calibration.json"}, "camera": cameras}
    tree |= {"light": [{"name": name} for name in lights], "frame": frames}
    write_toml(root, tree)
    return tree


def _write_calibration(path: Path, description: FolderCapture, per_radiance: float) -> None:
    told = Calibration.of_capture(description)
    scale = (1 / per_radiance,) * len(description.channels)
    cameras = tuple(camera.model_copy(update={"radiance_per_count": scale}) for camera in told.cameras)
    path.write_text(told.model_copy(update={"cameras": cameras}).model_dump_json())
