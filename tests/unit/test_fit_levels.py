"""Reducing images by averaging squares of pixels: the means, the variances, and the camera of the reduced image."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import zarr

from services.core.geometry import Camera
from services.core.records import JobSpec
from services.core.results import PreparedManifest
from services.core.store import create_array, open_stage
from services.fit.measurements.levels import LevelReader, averaged, reduced_camera, whole_squares
from services.fit.measurements.observations import read_channel, read_observations
from tests.support.prepared import SIZE, write_prepared

CAMERA = Camera(
    name="c",
    size=(23, 17),
    K=((900.0, 0.5, 11.0), (0.0, 880.0, 9.0), (0.0, 0.0, 1.0)),
    camera_from_world=((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 300), (0, 0, 0, 1)),
)


def test_a_square_is_where_its_middle_was() -> None:
    """The ray through a reduced pixel's centre is the ray through its square's centre; pixel centres are at
    half-integers.
    """
    small = reduced_camera(CAMERA, 3)
    assert small.size == (7, 5)
    _, coarse = small.rays(np.array([0.5, 4.5]), np.array([0.5, 2.5]))
    _, fine = CAMERA.rays(np.array([1.5, 13.5]), np.array([1.5, 7.5]))
    np.testing.assert_allclose(coarse, fine, atol=1e-12)


def test_means_of_squares_and_what_is_left_over() -> None:
    image = np.arange(7 * 5, dtype=np.float32).reshape(7, 5)
    np.testing.assert_array_equal(averaged(image, 2), [[3, 5], [13, 15], [23, 25]])
    chosen = np.ones((7, 5), dtype=bool)
    chosen[2, 1] = chosen[6, 4] = False
    np.testing.assert_array_equal(whole_squares(chosen, 2), [[True, True], [False, True], [True, True]])


def test_variance_is_that_of_the_mean(tmp_path: Path) -> None:
    """2,000 squares of independent noise: the mean square of z is 1 within 5 standard errors, 1e-6 false alarms."""
    rng, shape, step = np.random.default_rng(3), (1, 1, 120, 150, 1), 3
    spread = rng.uniform(0.5, 2, shape).astype(np.float32)
    values = {"radiance": spread * rng.standard_normal(shape).astype(np.float32), "variance": spread**2}
    for name, array in (*values.items(), ("valid", np.zeros(shape[:4], dtype=np.uint16))):
        dimensions = ("camera", "light", "y", "x", "channel")[: array.ndim]
        create_array(tmp_path, name, array.shape, array.shape, str(array.dtype), dimensions)[:] = array
    camera = CAMERA.model_copy(update={"size": (150, 120)})
    radiance, variance = LevelReader(tmp_path, 0, step).image(0, 0, camera)
    z_squared = radiance**2 / variance
    assert z_squared.shape == (40, 50)
    assert abs(z_squared.mean() - 1) < 5 * np.sqrt(2 / z_squared.size)


def test_a_fit_reads_means_and_not_every_nth_pixel(tmp_path: Path) -> None:
    write_prepared(tmp_path)
    spec = JobSpec(capture=tmp_path, pixel_step=2)
    observations = read_observations(tmp_path, spec)
    (view, _) = read_channel(observations, "green", spec)
    folder, _ = open_stage(tmp_path, "prepared", PreparedManifest)
    store = folder / "prepared.zarr"
    radiance = np.asarray(zarr.open_array(store / "radiance", mode="r")[0, 3, :, :, 0], dtype=np.float64)
    assert view.camera.size == (SIZE[0] // 2, SIZE[1] // 2)
    x, y = view.pixels[17]
    square = radiance[2 * y : 2 * y + 2, 2 * x : 2 * x + 2]
    np.testing.assert_allclose(view.reference[3, 17], square.mean(), rtol=1e-6)
    # The two outermost rows of pixels are masked, so the first row of squares is not fitted
    assert view.pixels[:, 1].min() == 1
    assert len(view.pixels) == (SIZE[0] // 2) * (SIZE[1] // 2 - 1)
