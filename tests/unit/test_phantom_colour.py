"""A virtual rig of three channels states the colours of its cameras, and a job reads them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from services.core.colour.cie import D50
from services.core.records import ImageEntry, JobSpec
from services.phantom.files import XYZ_FROM_CAMERA, write_description
from services.preprocess.opening import open_source
from tests.support.prepared import camera, lights


def rig(folder: Path, channels: tuple[str, ...]) -> Path:
    one = camera("c0")
    light = lights()[0].model_copy(update={"intensity": (1e6,) * len(channels)})
    images = [ImageEntry(camera="c0", light="l0", file="c0_l0.npy")]
    np.save(folder / "c0_l0.npy", np.ones((one.size[1], one.size[0], len(channels)), dtype=np.float32))
    write_description(folder, channels, (one,), (light,), images, {})
    return folder


def test_a_job_reads_the_colours_of_a_rig_of_three_channels(tmp_path: Path) -> None:
    spec = JobSpec(capture=rig(tmp_path, ("red", "green", "blue")))
    found = open_source(spec, tmp_path / "job").description.colour
    assert found is not None
    assert found["c0"].xyz_from_rgb == XYZ_FROM_CAMERA
    np.testing.assert_allclose(np.sum(XYZ_FROM_CAMERA, axis=1), D50)


def test_one_channel_has_no_colour(tmp_path: Path) -> None:
    spec = JobSpec(capture=rig(tmp_path, ("green",)))
    assert open_source(spec, tmp_path / "job").description.colour is None
