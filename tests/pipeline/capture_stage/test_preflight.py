"""Findings of a preflight before any frame is taken."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from services.capture import stage
from services.capture.cameras.motion import SubjectMotion
from services.capture.cameras.simulated import SimulatedCameras
from services.capture.cameras.stills import Stills
from services.capture.dome.driver import ModbusDome
from services.capture.dome.protocol import ExposureBudget
from services.capture.dome.registers import FaultKind
from services.capture.dome.simulator import order_fault
from services.capture.plan import plan_capture
from services.capture.preflight import preflight
from services.core.errors import (
    ReadbackError,
    RigError,
)
from services.core.records import FolderCapture, JobSpec, RigSpec
from services.core.stage import LocalContext
from services.core.store import read_record
from tests.support.captured_frames import LIGHTS, NOISELESS, Address, outputs


def test_preflight_names_a_dead_light_before_any_frame(
    tmp_path: Path, job: Callable[..., JobSpec], address: Address
) -> None:
    order_fault(*address, FaultKind.DEAD_LIGHT, 4)
    with pytest.raises(ReadbackError, match="Light 4 emits"):
        stage.run(job(), LocalContext(tmp_path / "job"))
    assert not outputs(address).any()
    assert not (tmp_path / "job" / ".capture.1" / "capture.zarr" / "c").exists()


class LeakyRoom(SimulatedCameras):
    """Cameras in a room that is not dark, with 500 counts more in every pixel."""

    def read(self) -> tuple[NDArray[np.uint16], ...]:
        return tuple(image + np.uint16(500) for image in super().read())


def look(mouth: Path, address: Address, kind: type[SimulatedCameras], gain_level: float) -> tuple[str, ...]:
    """Run a preflight at level 0.5 with cameras whose gain is set for ``gain_level``; returns its findings."""
    rig = RigSpec(mouth=mouth, exposure_s=0.01, simulation=NOISELESS)
    plan = plan_capture(rig, LIGHTS)
    stills = Stills(mouth, read_record(mouth / "capture.json", FolderCapture))
    with (
        ModbusDome(*address, ExposureBudget(10, 10)) as dome,
        kind(stills, rig, gain_level, SubjectMotion(0, 0, 1, 0), *address) as cameras,
    ):
        return preflight(plan, dome, cameras, rig, lambda: None)


def test_preflight_finds_nothing_in_a_good_rig(mouth: Path, address: Address) -> None:
    assert look(mouth, address, SimulatedCameras, gain_level=0.5) == ()


def test_preflight_tells_of_clipping(mouth: Path, address: Address) -> None:
    findings = look(mouth, address, SimulatedCameras, gain_level=0.05)
    assert [finding.split(" of its")[0] for finding in findings] == ["Camera 0 clips 100.0%", "Camera 1 clips 100.0%"]


def test_preflight_tells_of_a_closed_shutter(mouth: Path, address: Address) -> None:
    assert all("sees no light" in finding for finding in look(mouth, address, SimulatedCameras, gain_level=500.0))


def test_preflight_refuses_a_room_that_is_not_dark(mouth: Path, address: Address) -> None:
    with pytest.raises(RigError, match=r"Camera 0 reads 564.0 counts in the dark instead of 64"):
        look(mouth, address, LeakyRoom, gain_level=0.5)
