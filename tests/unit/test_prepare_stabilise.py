"""Alignment of real photographs under known warps, and interpolation in time."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from services.core.errors import CaptureInputError
from services.core.geometry import Camera
from services.core.results import FrameRecord
from services.preprocess.stabilisation.motion import Scene, ViewMotion, jaws, stored_step
from services.preprocess.stabilisation.stabilise import TERMS, Aligner, Image, SurfaceFlow, interpolate, warp
from services.preprocess.views.projection import Footprint
from services.preprocess.views.source import View
from services.preprocess.views.window import Window
from tests.support.shared_data import shared_path


def no_surfaces(camera: Camera) -> Footprint:
    raise AssertionError(f"tracking frames need no outline in {camera.name}")


NO_SCENE = Scene((), no_surfaces)


def footprint(seen: np.ndarray, depth_mm: np.ndarray | None = None) -> Footprint:
    depth = np.full(seen.shape, 1000.0) if depth_mm is None else depth_mm
    return Footprint(
        np.where(seen, 0, -1).astype(np.int16), depth.astype(np.float32), np.zeros((*seen.shape, 3), np.float32), seen
    )


def view_of(seen: Footprint) -> View:
    height, width = seen.mesh.shape
    camera = Camera(
        name="front",
        size=(width, height),
        K=((1, 0, 0), (0, 1, 0), (0, 0, 1)),
        camera_from_world=((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1)),
    )
    return View(0, camera, Window(0, height, 0, width), camera, seen)


def warped_photograph(path: Path, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A photograph, the same moved by up to 6 px and under other light, and the true displacement; both have sensor
    noise.
    """
    photograph = (cv2.imread(str(path)).astype(np.float32) / 255) ** 2.2
    linear = photograph.mean(axis=-1)
    height, width = linear.shape
    y, x = np.mgrid[0:height, 0:width].astype(np.float64)

    def field(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        u, v = (x - width / 2) / (width / 2), (y - height / 2) / (width / 2)
        return np.stack([7.4 + 3 * v - 2 * u + 1.5 * u * u, -4.4 - 3 * u + v + 1.2 * u * v], axis=-1)

    source = (np.stack([x, y], axis=-1) + field(x, y)).astype(np.float32)
    moved = cv2.remap(linear, source[..., 0], source[..., 1], cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE)
    # moved(p) = still(p + f(p)), so still(x) is found in it at x + u with u = -f(x + u)
    displacement = np.zeros((height, width, 2))
    # The field changes by about a hundredth of a pixel from one pixel to the next, so each round gains two digits.
    for _ in range(5):
        displacement = -field(x + displacement[..., 0], y + displacement[..., 1])
    u, v = (x - width / 2) / (width / 2), (y - height / 2) / (width / 2)
    gain = np.exp(0.5 * u + 0.4 * v + 0.3 * np.sin(5 * u + 2) * np.cos(4 * v))

    # Made at twice the size, so that no trace of interpolation is left at the final size
    rng = np.random.default_rng(seed)
    half = [
        cv2.resize(image.astype(np.float32), (width // 2, height // 2), interpolation=cv2.INTER_AREA)
        for image in (linear, moved * gain)
    ]
    noisy = [image + rng.normal(size=image.shape) * np.hypot(0.01 * image, 0.002 * image.max()) for image in half]
    truth = cv2.resize(displacement.astype(np.float32), (width // 2, height // 2), interpolation=cv2.INTER_AREA) / 2
    return noisy[0].astype(np.float32), noisy[1].astype(np.float32), truth


# A second photograph and a second pair take the same way as the first.
@pytest.mark.parametrize("view", [0, pytest.param(4, marks=pytest.mark.slow)])
def test_known_warp_of_an_intraoral_photograph_under_changed_light(view: int) -> None:
    """The accuracy that the capture design demands: median < 0.1 px, 95 % < 0.3 px."""
    reference, frame, truth = warped_photograph(shared_path(f"data/intraoral-photos/image/0-{view}.png"), seed=view)
    flow = SurfaceFlow(footprint(np.ones(reference.shape, dtype=bool)), [0])
    found = flow.field(Aligner(flow, reference).solve(frame))
    inner = np.s_[20:-20, 20:-20]
    error = np.linalg.norm(found - truth, axis=-1)[inner]
    assert np.linalg.norm(truth, axis=-1)[inner].min() > 2
    assert np.median(error) < 0.1
    assert np.quantile(error, 0.95) < 0.3


@pytest.mark.parametrize(
    ("pair", "dense_px"), [("motorcycle", 0.42), pytest.param("aloe", 0.69, marks=pytest.mark.slow)]
)
def test_parallax_of_a_real_stereo_pair(pair: str, dense_px: float) -> None:
    """With the true relief given, the displacement follows it; dense flow (DIS medium) has the given median error."""
    left, right, disparity = stereo_pair(pair)
    known = np.isfinite(disparity) & (disparity > 0)
    # The displacement by a sideways step is inverse to depth, so the disparity itself serves as the relief
    flow = SurfaceFlow(footprint(known, np.where(known, disparity, 0)), [0])
    found = flow.field(Aligner(flow, left).solve(right))
    truth = np.stack([-disparity, np.zeros_like(disparity)], axis=-1)
    assert np.median(np.linalg.norm(found - truth, axis=-1)[known]) < dense_px


def stereo_pair(name: str) -> tuple[Image, Image, Image]:
    """Linear left and right images (H, W) of a rectified pair, and the disparity (H, W) in pixels, 0 where unknown."""
    folder = shared_path("data/flow-pairs")
    sides = {"motorcycle": ("motorcycle_left.png", "motorcycle_right.png"), "aloe": ("aloeL.jpg", "aloeR.jpg")}[name]
    left, right = (
        (cv2.imread(str(folder / file)).astype(np.float32).mean(axis=-1) / 255) ** np.float32(2.2) for file in sides
    )
    if name == "aloe":
        return left, right, cv2.imread(str(folder / "aloeGT.png"), cv2.IMREAD_GRAYSCALE).astype(np.float32)
    with np.load(folder / "motorcycle_disp.npz") as stored:
        return left, right, stored[stored.files[0]]


def test_cubic_motion_is_interpolated_exactly_and_its_error_is_not_underrated() -> None:
    times = np.array([2.0, 9.0, 16.0, 23.0, 30.0])
    cubic = np.array([1 + 0.3 * t - 0.02 * t**2 + 4e-4 * t**3 for t in times])
    value, error = interpolate(times, cubic, 12.0)
    assert value == pytest.approx(1 + 3.6 - 2.88 + 4e-4 * 1728, rel=1e-12)
    assert error > 0
    smooth = np.sin(times / 8)
    found = [
        (abs(value - np.sin(time / 8)), error)
        for time in np.arange(2, 30, 0.5)
        for value, error in [interpolate(times, smooth, time)]
    ]
    true, estimated = np.max(found, axis=0)
    assert true < estimated


def test_two_knots_interpolate_linearly_and_doubt_it_by_their_distance() -> None:
    value, error = interpolate(np.array([0.0, 10.0]), np.array([[0.0], [5.0]]), 4.0)
    assert value == pytest.approx(2.0)
    assert error == pytest.approx(2.0)


def test_warp_undoes_a_shift() -> None:
    image = np.random.default_rng(0).random((30, 40, 2), dtype=np.float32)
    moved = np.zeros_like(image)
    moved[3:, 5:] = image[:-3, :-5]
    back = warp(moved, np.broadcast_to(np.array([5, 3], np.float32), (30, 40, 2)))
    np.testing.assert_allclose(back[:-3, :-5], image[:-3, :-5], atol=1e-6)
    assert (back[-3:] == 0).all()


def test_jaws_are_told_apart_by_fdi() -> None:
    assert jaws([11, 21, 31, 45]) == [[0, 1], [2, 3]]
    assert jaws([31]) == [[0]]


def textured(rng: np.random.Generator) -> np.ndarray:
    grain = rng.normal(size=(90, 120)).astype(np.float32)
    return 0.5 + cv2.GaussianBlur(grain, (0, 0), 2) + 4 * cv2.GaussianBlur(grain, (0, 0), 8)


def frames(count: int) -> list[FrameRecord]:
    return [
        FrameRecord(index=k, kind="tracking", light=None, exposure_s=0.05, level=0.1, time_s=k, readback=(0, 0, 0))
        for k in range(count)
    ]


def test_each_jaw_gets_its_own_motion() -> None:
    texture = textured(np.random.default_rng(1))
    label = np.full((90, 120), -1, dtype=np.int16)
    label[10:42, 15:105], label[48:80, 15:105] = 0, 1
    seen = Footprint(label, np.full((90, 120), 1000, np.float32), np.zeros((90, 120, 3), np.float32), label >= 0)
    moved = texture.copy()
    upper, lower = np.array([2.0, 0.0]), np.array([-1.0, 1.0])
    for rows, shift in ((slice(0, 45), upper), (slice(45, 90), lower)):
        field = np.broadcast_to(-shift.astype(np.float32), (90, 120, 2))
        moved[rows] = warp(texture, field)[rows]
    motion = ViewMotion(view_of(seen), [[0], [1]], frames(2), "auto")
    found = motion.stored_field(
        motion.at(frames(2)[1], dict(motion.measure([0, 1], lambda frame: moved if frame.index else texture, NO_SCENE)))
    )
    # Whole-pixel shifts of a noise-free texture; what is left is the seam between the jaws
    assert np.median(np.linalg.norm(found[15:35, 25:95] - upper, axis=-1)) < 0.1
    assert np.median(np.linalg.norm(found[55:75, 25:95] - lower, axis=-1)) < 0.1


def test_too_much_motion_is_refused_by_name() -> None:
    texture = textured(np.random.default_rng(1))
    seen = np.zeros((90, 120), dtype=bool)
    seen[20:70, 30:90] = True
    moved = warp(texture, np.broadcast_to(np.array([-11, 0], np.float32), (90, 120, 2)))
    motion = ViewMotion(view_of(footprint(seen)), [[0]], frames(2), "auto")
    with pytest.raises(
        CaptureInputError, match=r"moved 1\d\.\d px by frame 1 \(camera front, light all\).*head supported\.$"
    ):
        dict(motion.measure([0, 1], lambda frame: moved if frame.index else texture, NO_SCENE))


def test_coefficients_and_grid() -> None:
    assert TERMS == 7
    assert stored_step((34, 28)) == 1
    assert stored_step((3840, 5120)) == 9
