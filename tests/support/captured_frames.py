"""The frames that a capture by the simulated dome has stored, and the dome's light outputs while it runs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import zarr
from numpy.typing import NDArray

from services.capture.dome.controller import DomeObserver
from services.core.records import SimulatedCameraSpec

LIGHTS = 6
NOISELESS = SimulatedCameraSpec(noise_relative=0, noise_floor=0, bits=16)
Address = tuple[str, int]


def outputs(address: Address) -> NDArray[np.float64]:
    observer = DomeObserver(*address)
    try:
        return observer.outputs()
    finally:
        observer.close()


def frames_of(root: Path) -> NDArray[np.uint16]:
    return np.asarray(zarr.open_array(root / "capture" / "capture.zarr", mode="r")[:])
