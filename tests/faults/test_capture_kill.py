"""After SIGKILL of a capturing process, the dome is dark within the watchdog period, acknowledged frames are intact,
and the next attempt continues.
"""

from __future__ import annotations

import hashlib
import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import zarr

from services.capture import stage
from services.capture.dome.controller import DomeObserver
from services.capture.dome.registers import FaultBit
from services.capture.dome.simulator import simulated_dome
from services.core.records import JobSpec, RigSpec, SimulatedCameraSpec
from services.core.stage import LocalContext, StageEvent
from services.core.store import is_published
from tests.support.mouth import write_mouth

WATCHDOG_S = 1.0
LIGHTS = 6
CAPTURE = """
import sys
from pathlib import Path
from services.capture import stage
from services.core.records import JobSpec
from services.core.stage import LocalContext
stage.run(JobSpec.model_validate_json(sys.argv[1]), LocalContext(Path(sys.argv[2]), attempt=1))
"""


def wait_for(condition: Callable[..., object], *arguments: object) -> None:
    deadline_s = time.monotonic() + 60
    while not condition(*arguments):
        assert time.monotonic() < deadline_s, "the capture did not get so far within a minute"
        time.sleep(0.01)


def stopped_under_light(process: subprocess.Popen[bytes], observer: DomeObserver) -> bool:
    """Stop the process; keep it stopped if a light is on, so that the kill strikes during an exposure."""
    process.send_signal(signal.SIGSTOP)
    if observer.outputs().any():
        return True
    process.send_signal(signal.SIGCONT)
    return False


def journal_lines(root: Path) -> list[str]:
    path = root / ".capture.1" / "journal.jsonl"
    return path.read_text().splitlines()[1:] if path.exists() else []


def test_killed_in_mid_exposure(tmp_path: Path) -> None:
    write_mouth(tmp_path / "mouth", LIGHTS)
    killed, undisturbed = tmp_path / "killed", tmp_path / "undisturbed"
    with simulated_dome(LIGHTS, WATCHDOG_S) as (host, port):
        rig = RigSpec(
            mouth=tmp_path / "mouth",
            dome=f"{host}:{port}",
            exposure_s=0.1,
            watchdog_s=WATCHDOG_S,
            tracking_every=3,
            simulation=SimulatedCameraSpec(motion_px=1.0),
        )
        spec = JobSpec(rig=rig)
        observer = DomeObserver(host, port)
        with subprocess.Popen([sys.executable, "-c", CAPTURE, spec.model_dump_json(), str(killed)]) as process:
            wait_for(lambda: len(journal_lines(killed)) >= 4)
            wait_for(lambda: stopped_under_light(process, observer))
            process.kill()
            process.wait()
            killed_s = time.monotonic()

        # No request that starts a watchdog period after the death may see light. The watchdog, not the end of the
        # exposure, must have darkened the dome.
        seen_lit = 0
        while (asked_s := time.monotonic()) < killed_s + WATCHDOG_S:
            seen_lit += int(observer.outputs().any())
            time.sleep(0.02)
        assert not observer.outputs().any(), f"lit {asked_s - killed_s:.2f} s after the kill"
        assert seen_lit > 0
        assert observer.faults() == FaultBit.WATCHDOG
        observer.close()

        assert not is_published(killed, "capture")
        acknowledged = [json.loads(line) for line in journal_lines(killed)]
        for line in acknowledged:
            for name, size, sha256 in line["shards"]:
                content = (killed / ".capture.1" / "capture.zarr" / name).read_bytes()
                assert (len(content), hashlib.sha256(content).hexdigest()) == (size, sha256)

        events: list[StageEvent] = []
        resumed = stage.run(spec, LocalContext(killed, attempt=2, listener=events.append))
        fresh = stage.run(spec, LocalContext(undisturbed, attempt=1))

    exposed = [event.data["frame"] for event in events if event.kind == "progress"]
    assert exposed == list(range(len(acknowledged), len(fresh.frames)))
    untimed = {"time_s": 0.0}
    assert [f.model_copy(update=untimed) for f in resumed.frames] == [
        f.model_copy(update=untimed) for f in fresh.frames
    ]
    assert [f.time_s for f in resumed.frames[: len(acknowledged)]] == [line["frame"]["time_s"] for line in acknowledged]
    one, other = (zarr.open_array(root / "capture" / "capture.zarr", mode="r")[:] for root in (killed, undisturbed))
    assert np.array_equal(np.asarray(one), np.asarray(other))
    assert not list(killed.glob(".capture.[0-9]*"))
