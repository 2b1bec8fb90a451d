"""The report's first picture: photographs in colour beside renders of the asset, at the photographs' exposure."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from services.assets.asset import middle_of
from services.assets.colour import beside as beside_module
from services.assets.colour.beside import Beside, Pair, Shown, beside
from services.assets.colour.beside_picture import BACKGROUND, MARGIN_PX, picture
from services.assets.colour.develop import developed
from services.assets.colour.smoothing import smoothed, smoothed_colours, smoothed_halves
from services.assets.colour.spaces import LINEAR_SRGB
from services.assets.fitted_job import FittedJob
from services.assets.lead_picture import read_differences, write_lead_picture
from services.core.errors import CorruptStoreError
from services.core.geometry import Mesh, Tooth
from services.core.pages.pictures import tone_map
from services.core.records import JobSpec
from services.core.results import FitReport, PreparedManifest
from services.core.store import StoredArray, open_stage
from tests.support.colour_job import COLOURS, LIGHTS, report, write_job
from tests.support.prepared import camera, sphere

SAMPLES = 256
PATHS = 60_000
BALL = sphere(4.0)
TOOTH = Tooth(11, BALL, Mesh(0.8 * BALL.vertices_mm, BALL.faces))
SHOWN = Shown((TOOTH,), (camera("c0"),), LIGHTS, middle_of((TOOTH,)))


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A job whose photographs stock Mitsuba rendered."""
    return write_job(tmp_path_factory.mktemp("demo") / "job", SAMPLES)


@pytest.fixture(autouse=True)
def _few_paths(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(beside_module, "PATHS", PATHS)


def found_of(job: Path, fitted: FitReport, **options: object) -> Beside | None:
    folder, prepared = open_stage(job, "prepared", PreparedManifest, verify=False)
    radiance = StoredArray(folder / "prepared.zarr" / "radiance")
    return beside(JobSpec(capture=job, boundary="matched", **options), fitted, prepared, radiance, SHOWN)  # type: ignore[arg-type]


def test_renders_have_the_colours_of_stock_mitsubas_photographs(job: Path) -> None:
    found = found_of(job, report())
    assert found is not None
    assert (found.camera, found.is_calibrated) == ("c0", True)
    every, unseen = found.pairs
    assert (every.lights, every.held_out) == (("l0", "l1"), False)
    assert (unseen.lights, unseen.held_out) == (("l1",), True)
    for pair in found.pairs:
        times = pair.render.shape[0] // pair.photo.shape[0]
        assert times > 1
        assert pair.render.shape[:2] == tuple(times * size for size in pair.photo.shape[:2])
        # A pixel of the photograph has a noise of 8.6 % and 208 show the ball: 0.6 % of the mean. The render has twice
        # as many paths over all. Four standard errors of the difference, and 1 % for the edge's covered share.
        np.testing.assert_allclose(pair.render.mean(axis=(0, 1)), pair.photo.mean(axis=(0, 1)), rtol=0.04)
    # The developed photograph is the stored one over a diffuser's radiance, intensity ÷ (π d²), by the matrices.
    raw = StoredArray(job / "prepared" / "prepared.zarr" / "radiance")[0, 1].astype(np.float64)
    position = np.array(LIGHTS[1].position_mm)
    wanted = developed(np.pi * position @ position * raw / np.array(LIGHTS[1].intensity), COLOURS["c0"], LINEAR_SRGB)
    assert unseen.photo.sum() == pytest.approx(wanted.sum(), rel=1e-6)
    red, _, blue = unseen.render.mean(axis=(0, 1))
    assert red > 1.1 * blue  # blue is absorbed most, so the ball is yellow


def test_without_held_out_photographs_there_is_one_pair(job: Path) -> None:
    found = found_of(write_job(job.parent / "all", 4, held_out=()), report())
    assert found is not None
    assert [(pair.lights, pair.held_out) for pair in found.pairs] == [(("l0", "l1"), False)]
    left = found_of(job, report(), left_out_lights=("l0",))
    assert left is not None
    assert [(pair.lights, pair.held_out) for pair in left.pairs] == [(("l1",), True)]


def test_other_channels_have_no_picture(job: Path) -> None:
    assert found_of(job, report(("green",))) is None


def test_the_picture_is_a_file_of_the_asset(job: Path, tmp_path: Path) -> None:
    folder, prepared = open_stage(job, "prepared", PreparedManifest, verify=False)
    fitted = FittedJob(JobSpec(capture=job), job, report(), folder, prepared)
    fitted.__dict__.update(teeth=(TOOTH,), stains=None)
    assert write_lead_picture(tmp_path, fitted, SHOWN.cameras, SHOWN.lights) == (
        "render_beside_photograph.png", "colour_differences.json"
    )  # fmt: skip
    every, unseen = read_differences(tmp_path)
    assert (every.light, every.held_out, unseen.light, unseen.held_out) == ("2 lights together", False, "l1", True)
    assert 0 < every.median < every.most
    (tmp_path / "colour_differences.json").write_text("[{}]")
    with pytest.raises(CorruptStoreError, match=r"colour_differences.json cannot be read; write it again"):
        read_differences(tmp_path)
    assert (tmp_path / "render_beside_photograph.png").read_bytes().startswith(b"\x89PNG")


def test_both_have_one_exposure_above_what_they_are() -> None:
    photo = np.random.default_rng(0).uniform(0.2, 0.5, (24, 20, 3))
    render = 0.5 * photo.repeat(3, axis=0).repeat(3, axis=1)
    pairs = (Pair(("l0", "l1"), held_out=False, photo=photo, render=render, render_noise=np.zeros((3, 3)),
                  compared=np.ones((24, 20), dtype=bool)),)  # fmt: skip
    shown = picture(Beside("c0", pairs, is_calibrated=True, samples=4), "Simulated photograph")
    white = np.percentile(photo.max(axis=-1), 99)
    rows = shown[MARGIN_PX : MARGIN_PX + 72]
    for wanted in (tone_map(photo, white).repeat(3, axis=0).repeat(3, axis=1), tone_map(render, white)):
        places = [x for x in range(rows.shape[1] - 60 + 1) if (rows[:, x : x + 60] == wanted).all()]
        assert len(places) == 1
    assert (shown[MARGIN_PX + 76 :] != BACKGROUND).any(axis=-1).sum() > 500
    assert (shown[:, :4] == BACKGROUND).all()
    assert (shown[:, -4:] == BACKGROUND).all()


def shaded_ball() -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Radiance (H, W, 3) of a diffuse ball lit from a side, its normals and its covered pixels."""
    y, x = (np.mgrid[:200, :200] - 99.5) / 80
    covered = (x**2 + y**2 < 1).astype(np.float64)
    normals = np.stack([x, y, -np.sqrt(np.maximum(1 - x**2 - y**2, 0))], axis=-1) * covered[..., None]
    shade = covered * (1.2 + normals @ np.array([0.6, -0.3, 0.2]))
    return shade[..., None] * np.array([1.0, 0.8, 0.5]), normals, covered


def test_smoothing_takes_out_noise_and_leaves_the_shape() -> None:
    truth, normals, covered = shaded_ball()
    noisy = truth * np.random.default_rng(1).exponential(1.0, truth.shape)
    found = smoothed_colours(noisy, normals, covered, 8)
    on = covered > 0
    before, after = (np.sqrt(np.mean((image[on] / truth[on] - 1) ** 2)) for image in (noisy, found))
    # Noise of one a pixel, over squares of 17 pixels' side with four coefficients, is sqrt(4 / 289) = 12 % in a square
    # and less in the mean of the squares that hold a pixel.
    assert before == pytest.approx(1.0, rel=0.05)
    assert after < 0.12
    # 20,000 pixels of noise one: the means' standard error is 0.7 %; four of them.
    np.testing.assert_allclose(found[on].mean(axis=0), truth[on].mean(axis=0), rtol=0.028)
    assert (found[~on] == 0).all()


def test_halves_tell_the_noise_of_the_whole() -> None:
    truth, normals, covered = shaded_ball()
    random, inner = np.random.default_rng(2), covered * (np.linalg.norm(normals[..., :2], axis=-1) < 0.8) > 0
    told, real = [], []
    for _ in range(4):
        noisy = truth * random.exponential(1.0, truth.shape)
        one, two = smoothed_halves(noisy, normals, covered, 8)
        told.append((one - two)[inner] / 2 / truth[inner])
        real.append(smoothed_colours(noisy, normals, covered, 8)[inner] / truth[inner] - 1)
    # The disc holds some (2 · 64 ÷ 34)² = 14 independent squares for brightness; four draws give 56, so either root
    # mean square is known to 1 / sqrt(2 · 56) = 9 %. Four standard errors of their ratio.
    assert np.std(told) == pytest.approx(np.std(real), rel=0.52)


def test_smoothing_leaves_what_has_no_noise() -> None:
    truth, normals, covered = shaded_ball()
    inner = covered * (np.linalg.norm(normals[..., :2], axis=-1) < 0.8)
    # The radiance is linear in the normal but for the smoothing of the normals, which bends them by the sagitta over
    # the Gaussian's 2 pixels, 2² ÷ (2 · 80²) = 3e-4, and for the ridge of 3e-3 beside their variance in a square.
    np.testing.assert_allclose(smoothed(truth, normals, covered, 8)[inner > 0], truth[inner > 0], rtol=0.03)
