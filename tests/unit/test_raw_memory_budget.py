"""A raw photograph is processed in strips that fit into a worker's memory; the strips leave no trace in the result."""

from __future__ import annotations

import json
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from services.core.errors import SettingsError
from services.core.raw.records import RawCamera
from services.preprocess.raw.memory_budget import GIB, PROCESS_BYTES, MemoryBudget, strips
from services.preprocess.raw.source import RawSource
from services.preprocess.stabilisation.stabilise import TERMS
from services.preprocess.views.source import LightImage, MatchedFrame
from services.preprocess.views.subject import read_subject
from services.preprocess.views.window import Window
from tests.support.mouth import write_mouth
from tests.support.raw_captures import write_raw_capture
from tests.support.raw_sensor import Sensor

FULL_SIZE = (5120, 3840)
TOOTH = Window(231, 3609, 1150, 3970)
"""The part of a 20 megapixel image that a tooth of four fifths of its height takes, with a margin."""
REGION = Window(0, 3840, 550, 4570)
"""The part of the photograph from which ``TOOTH`` may be sampled."""


def camera(mosaic: str, size: tuple[int, int] = FULL_SIZE) -> RawCamera:
    return RawCamera.model_validate({"name": "c", "size": size, "bits": 12, "mosaic": mosaic})


@pytest.mark.parametrize(
    ("mosaic", "exposures", "bound_gib"),
    [("RGGB", 1, 2.0), ("RGGB", 3, 2.0), ("RGGB", 3, 8.0), ("none", 1, 2.0), ("none", 3, 3.0)],
)
def test_the_plan_keeps_the_bound(mosaic: str, exposures: int, bound_gib: float) -> None:
    plan = MemoryBudget(bound_gib * GIB, camera(mosaic), 3, TOOTH, REGION)
    rows = plan.rows(exposures)
    assert plan.peak_bytes(exposures, rows) <= bound_gib * GIB
    assert rows == TOOTH.shape[0] or plan.peak_bytes(exposures, rows + 1) > bound_gib * GIB
    covered = [row for strip in strips(TOOTH.shape[0], rows) for row in range(strip.start, strip.stop)]
    assert covered == [*range(TOOTH.shape[0])]


def test_less_than_the_smallest_strips_take_is_refused() -> None:
    with pytest.raises(SettingsError, match=r"camera c takes 1\.\d\d GiB .* leaves 1\.00 to each thread"):
        MemoryBudget(GIB, camera("RGGB"), 3, TOOTH, REGION).rows(3)


@pytest.fixture(scope="module", params=[("RGGB", True), ("none", False)])
def raw_folder(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tooth of 400 pixels in three exposures, with or without lens distortion."""
    mosaic, is_distorted = request.param
    root = tmp_path_factory.mktemp("raw")
    write_mouth(root / "mouth", lights=1, sizes=((640, 480),))
    sensor = Sensor(mosaic=mosaic)
    write_raw_capture(root / "raw", root / "mouth", sensor, (0.0125, 0.05, 0.2), tracking=0, flats=1, blacks=1)
    record = json.loads((root / "raw" / "calibration.json").read_text())
    record["cameras"][0]["K"] = [[5000, 0, 320], [0, 5000, 240], [0, 0, 1]]
    record["cameras"][0]["distortion"] = [-0.5, 0.05, 0.001, -0.001, 0.0] if is_distorted else None
    (root / "raw" / "calibration.json").write_text(json.dumps(record))
    return root / "raw"


def moved(source: RawSource, *, apart: bool) -> dict[int, MatchedFrame]:
    """Motion of the frames by their outline: none, or a shift from one exposure to the next."""
    found = {}
    for place, frame in enumerate(source.matched_frames(0)):
        shift = (1.3 * place, 0.7 * place) if apart else (0.0, 0.0)
        coefficients = np.zeros((1, TERMS, 2))
        coefficients[0, 0] = shift
        found[frame] = MatchedFrame(coefficients, (0.1,), ((shift, shift),))
    return found


def image_within(root: Path, *, apart: bool) -> LightImage:
    source = RawSource(root, None, 0.01, 0.002, memory_bytes=8 * GIB)
    view = read_subject(root, whole=False).view_of(0, source.description.cameras[0])
    return next(iter(source.images(view, (0,), moved(source, apart=apart))))[1]


@pytest.mark.parametrize("apart", [False, True])
def test_strips_leave_no_trace(raw_folder: Path, monkeypatch: pytest.MonkeyPatch, apart: bool) -> None:
    whole = image_within(raw_folder, apart=apart)
    seen: list[int] = []

    def low(self: MemoryBudget, exposures: int) -> int:
        seen.append(exposures)
        return 70

    monkeypatch.setattr(MemoryBudget, "rows", low)
    in_strips = image_within(raw_folder, apart=apart)
    assert 3 in seen
    assert (whole.bits == 0).mean() > 0.5
    for name in ("radiance", "variance", "bits"):
        np.testing.assert_array_equal(getattr(in_strips, name), getattr(whole, name))


@pytest.mark.parametrize("apart", [False, True])
def test_an_image_takes_what_the_plan_says_at_most(
    raw_folder: Path, monkeypatch: pytest.MonkeyPatch, apart: bool
) -> None:
    """And at least half of it, or the bound would waste memory; the process itself is not counted."""
    source = RawSource(raw_folder, None, 0.01, 0.002)
    view = read_subject(raw_folder, whole=False).view_of(0, source.description.cameras[0])
    motions = moved(source, apart=apart)
    plans: list[tuple[MemoryBudget, int]] = []
    told = MemoryBudget.rows

    def watched(self: MemoryBudget, exposures: int) -> int:
        plans.append((self, told(self, exposures)))
        return plans[-1][1]

    monkeypatch.setattr(MemoryBudget, "rows", watched)
    tracemalloc.start()
    try:
        kept = next(iter(source.images(view, (0,), motions)))
        taken = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert kept
    plan, rows = plans[-1]
    planned = plan.peak_bytes(3, rows) - PROCESS_BYTES
    assert 0.5 * planned < taken < planned
