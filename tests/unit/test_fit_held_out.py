"""Which images a fit keeps back to test itself: by light, by camera, and both."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from services.core.errors import SettingsError
from services.core.geometry import Light
from services.core.records import JobSpec
from services.core.results import PreparedManifest
from services.fit.measurements.held_out import held_out_images, left_out_lights
from services.fit.measurements.observations import read_channel, read_observations
from tests.support.prepared import camera, write_prepared


def manifest() -> PreparedManifest:
    lights = tuple(Light(name=f"l{k}", position_mm=(float(k), 500.0, 300.0), intensity=(1e6,)) for k in range(5))
    return PreparedManifest(
        channels=("green",), cameras=(camera("c0"), camera("c1"), camera("c2")), lights=lights,
        held_out=(("c0", "l1"),), fdi=(11,), dentin_known=(), median_motion_px=None, valid_fraction=0.9,
    )  # fmt: skip


def chosen(**options: object) -> np.ndarray:
    return held_out_images(manifest(), JobSpec.model_validate({"capture": "c"} | options))


def test_a_camera_that_is_named_is_tested_under_all_lights_and_the_others_are_fitted_under_all() -> None:
    found = chosen(held_out_cameras=("c1",))
    assert found[1].all()
    assert not found[[0, 2]].any()


def test_lights_that_are_named_too_are_kept_from_all_cameras() -> None:
    found = chosen(held_out_cameras=("c1",), held_out_lights=("l3",))
    assert found[1].all()
    assert found[:, 3].all()
    assert found.sum() == 5 + 2


def test_without_cameras_the_captures_own_choice_stays() -> None:
    assert np.argwhere(chosen()).tolist() == [[0, 1]]


def test_lights_that_are_left_out_are_named_by_the_job() -> None:
    found = left_out_lights(manifest(), JobSpec.model_validate({"capture": "c", "left_out_lights": ("l0", "l4")}))
    assert found.tolist() == [True, False, False, False, True]
    assert not left_out_lights(manifest(), JobSpec.model_validate({"capture": "c"})).any()


@pytest.mark.parametrize("left_out", [("l0", "l1", "l2", "l4"), ("l0", "l1", "l2", "l3", "l4")])
def test_some_light_is_left_to_fit(left_out: tuple[str, ...]) -> None:
    spec = JobSpec.model_validate({"capture": "c", "held_out_lights": ("l3",), "left_out_lights": left_out})
    with pytest.raises(SettingsError, match="No light is left to fit; name fewer in left_out_lights"):
        left_out_lights(manifest(), spec)


def test_no_image_of_a_light_that_is_left_out_counts(tmp_path: Path) -> None:
    write_prepared(tmp_path)
    spec = JobSpec.model_validate({"capture": tmp_path, "left_out_lights": ("l2",)})
    for view in read_channel(read_observations(tmp_path, spec), "green", spec):
        assert view.valid.any(axis=1).tolist() == [True, True, False, True, True, True]
