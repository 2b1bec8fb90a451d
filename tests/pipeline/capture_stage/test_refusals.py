"""An impossible capture is refused with one sentence before any light is on."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from services.capture import stage
from services.core.errors import (
    CaptureInputError,
    DentineError,
    ExposureLimitError,
    MeshError,
    RigError,
    SettingsError,
)
from services.core.records import JobSpec
from services.core.stage import LocalContext
from tests.support.captured_frames import LIGHTS
from tests.support.mouth import write_mouth


def _remove(name: str) -> Callable[[Path], None]:
    return lambda mouth: (mouth / name).unlink()


def _truncate(mouth: Path) -> None:
    path = mouth / "c1_l2.npy"
    path.write_bytes(path.read_bytes()[:-100])


def _relist(**lists: object) -> Callable[[Path], None]:
    def edit(mouth: Path) -> None:
        description = json.loads((mouth / "capture.json").read_text())
        (mouth / "capture.json").write_text(json.dumps(description | lists))

    return edit


def _edit(**changes: str) -> Callable[[Path], None]:
    def edit(mouth: Path) -> None:
        description = json.loads((mouth / "capture.json").read_text())
        description["images"][3] |= changes
        (mouth / "capture.json").write_text(json.dumps(description))

    return edit


def _replace(array: NDArray[np.generic]) -> Callable[[Path], None]:
    return lambda mouth: np.save(mouth / "c0_l1.npy", array)


@pytest.mark.parametrize(
    ("spoil", "error", "words"),
    [
        (_remove("c1_l2.npy"), CaptureInputError, ("c1_l2.npy", "camera c1", "light l2", "restore")),
        (_remove("capture.json"), CaptureInputError, ("capture.json", "does not exist")),
        (_remove("teeth/11/outer.ply"), CaptureInputError, ("outer.ply", "does not exist")),
        (_truncate, CaptureInputError, ("c1_l2.npy", "cannot be read")),
        (_relist(lights=[]), CaptureInputError, ("capture.json", "lists no light")),
        (_relist(channels=["red", "red", "blue"]), CaptureInputError, ("lists channel 'red' twice",)),
        (_edit(light="l77"), CaptureInputError, ("unknown light 'l77'",)),
        (_edit(camera="left"), CaptureInputError, ("unknown camera 'left'",)),
        (_edit(light="l0"), CaptureInputError, ("no image of camera c0 and light l3",)),
        (_replace(np.ones((3, 4, 3), dtype=np.float32)), CaptureInputError, ("c0_l1.npy", "(3, 4, 3)", "(18, 24, 3)")),
        (_replace(np.full((18, 24, 3), np.nan, dtype=np.float32)), CaptureInputError, ("c0_l1.npy", "non-finite")),
        (_replace(np.ones((18, 24, 3), dtype=np.uint8)), CaptureInputError, ("c0_l1.npy", "floating-point")),
    ],
)
def test_bad_input_is_one_sentence_before_any_light(
    tmp_path: Path,
    mouth: Path,
    job: Callable[..., JobSpec],
    spoil: Callable[[Path], None],
    error: type[DentineError],
    words: tuple[str, ...],
) -> None:
    spoil(mouth)
    with pytest.raises(error) as caught:
        stage.run(job(dome="127.0.0.1:1"), LocalContext(tmp_path / "job"))
    assert type(caught.value) is error
    assert all(word in caught.value.message for word in words)
    assert "\n" not in caught.value.message


def test_a_tooth_in_metres_is_refused(tmp_path: Path, mouth: Path, job: Callable[..., JobSpec]) -> None:
    import trimesh

    path = mouth / "teeth" / "11" / "outer.ply"
    mesh = trimesh.load_mesh(path)
    mesh.apply_scale(0.001)
    mesh.export(path)
    with pytest.raises(MeshError, match="millimetres"):
        stage.run(job(), LocalContext(tmp_path / "job"))


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"dome": "nowhere"}, SettingsError, "neither 'simulated' nor host:port"),
        ({"dome": "127.0.0.1:1"}, RigError, "does not answer"),
        ({"exposure_s": 30.0}, ExposureLimitError, "Light 0"),
    ],
)
def test_a_rig_that_cannot_be_used_is_refused(
    tmp_path: Path, job: Callable[..., JobSpec], options: dict[str, object], error: type[DentineError], words: str
) -> None:
    with pytest.raises(error, match=words):
        stage.run(job(**options), LocalContext(tmp_path / "job"))


def test_more_lights_than_the_dome_has_are_refused(tmp_path: Path, job: Callable[..., JobSpec]) -> None:
    write_mouth(tmp_path / "large", LIGHTS + 1)
    with pytest.raises(RigError, match=r"has 6 lights and .* lists 7"):
        stage.run(job(mouth=tmp_path / "large"), LocalContext(tmp_path / "job"))
