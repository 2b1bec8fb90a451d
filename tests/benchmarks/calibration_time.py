"""Duration of a whole calibration session, part by part, as JSON.

python -m tests.benchmarks.calibration_time --width 648 --cameras 3 --boards 30 --lights 54 --json time.json

The virtual laboratory photographs boards, one mirror and one white sphere under every light, and a chart. The steps of
``dentine calibrate`` are timed as they run, each without the steps inside it. The time per photograph grows with its
pixels and that of the fits does not, so the times for a third image size follow from two others, and a session of many
large images need not be written. Seconds are processor time of this process.
"""

from __future__ import annotations

import argparse
import importlib
import json
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from unittest.mock import patch

from services.calibrate.session.run import calibrate
from services.phantom.lab.rig import RigSize, true_rig
from services.phantom.lab.sensor import Sensor
from services.phantom.lab.session import write_session

FIELD_MM = 84.0
"""Width of an image's field of view at the teeth."""
STEPS = {
    "reading": ("photos.read_counts",),
    "boards found": ("boards._find",),
    "cameras' fit": ("boards.adjust_cameras",),
    "mirror spheres found": ("run.find_lights",),
    "lights' fit": ("spheres.place_lights",),
    "white spheres sampled": ("run.measure_intensity",),
    "intensities' fit": ("spheres.fit_centres", "spheres.fit_intensity"),
    "flat frames": ("run.measure_vignetting",),
    "colours": ("run.calibrate_colours",),
    "record and limits": ("run.record_of", "run.judge"),
}
"""Functions of ``services.calibrate.session`` by part. The time outside all of them is spent on the files'
checksums."""
REST = "checksums"


class Parts:
    """Processor seconds by part, each without the parts measured inside it."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._open, self._since = [REST], time.process_time()

    def measured(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Wrap a function so that its time counts under a name."""

        def call(*arguments: Any, **options: Any) -> Any:
            self.turn()
            self._open.append(name)
            try:
                return function(*arguments, **options)
            finally:
                self.turn()
                self._open.pop()

        return call

    def turn(self) -> None:
        """Add the time since the last call of this method to the part that is running."""
        now = time.process_time()
        self.seconds[self._open[-1]] += now - self._since
        self._since = now


def timed(root: Path) -> dict[str, float]:
    """Processor seconds of each part of one calibration."""
    with ExitStack() as stack:
        parts = Parts()
        for name, places in STEPS.items():
            for place in places:
                module, function = place.split(".")
                where = importlib.import_module(f"services.calibrate.session.{module}")
                stack.enter_context(patch.object(where, function, parts.measured(name, getattr(where, function))))
        parts.turn()
        parts.seconds.clear()
        calibrate(root)
        parts.turn()
        return dict(parts.seconds)


def main() -> None:
    """Write a session, calibrate it, and print and store the seconds by part."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--width", type=int, default=648, help="of images, pixels; they are three quarters as high")
    parser.add_argument("--cameras", type=int, default=3)
    parser.add_argument("--boards", type=int, default=30)
    parser.add_argument("--lights", type=int, default=54)
    parser.add_argument("--mosaic", default="RGGB", help="of the sensor; 'none' for three values a pixel")
    parser.add_argument("--json", type=Path, required=True, help="where results are added")
    given = parser.parse_args()
    size = RigSize((given.width, given.width * 3 // 4), FIELD_MM / given.width, given.cameras, given.lights)
    sensor = Sensor(mosaic=given.mosaic)
    with tempfile.TemporaryDirectory() as folder:
        began = time.process_time()
        write_session(
            Path(folder), true_rig(size, sensor.black, 1), sensor, 1, n_boards=given.boards, n_mirror=1, n_white=1
        )
        told: dict[str, Any] = {
            **{key: value for key, value in vars(given).items() if key != "json"},
            "photographs": {"boards": given.cameras * given.boards, "of each sphere": given.cameras * given.lights},
            "written_s": round(time.process_time() - began, 1),
        }
        began = time.monotonic()
        told["parts_s"] = {name: round(seconds, 2) for name, seconds in timed(Path(folder)).items()}
        told |= {"processor_s": round(sum(told["parts_s"].values()), 1), "wall_s": round(time.monotonic() - began, 1)}
    runs = json.loads(given.json.read_text()) if given.json.is_file() else []
    given.json.write_text(json.dumps([*runs, told], indent=1))
    print(json.dumps(told, indent=1))


if __name__ == "__main__":
    main()
