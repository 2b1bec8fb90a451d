"""Offsets between photographs and meshes: found where there is one, and not reported where something else is wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from services.core.geometry import Camera, Tooth
from services.core.records import MaskBit
from services.core.results import PreparedManifest
from services.core.store import create_array
from services.fit.checks.alignment import Offset, clearest_offset, offset_sentences
from services.fit.measurements.blocks import PixelParts
from services.fit.measurements.observations import Observations
from services.fit.measurements.view_stack import ViewStack
from services.fit.passes.evaluate import ErrorSums, Evaluation
from tests.support.prepared import lights, sphere

SIZE, PIXEL_MM, RADIUS_PX = 40, 0.4, 10


def ball(right_px: float = 0.0, down_px: float = 0.0, exponent: float = 1.0, floor: float = 0.2) -> NDArray[np.float64]:
    """A shaded ball in front of black, lit from the upper left."""
    y, x = np.mgrid[:SIZE, :SIZE] + 0.5
    u, v = (x - SIZE / 2 - right_px) / RADIUS_PX, (y - SIZE / 2 - down_px) / RADIUS_PX
    depth = np.sqrt(np.maximum(1 - u**2 - v**2, 0))
    return np.where(u**2 + v**2 < 1, floor + np.maximum(0.8 * depth - 0.4 * u - 0.4 * v, 0) ** exponent, 0.0)


def compare(
    root: Path,
    photo: NDArray[np.float64],
    render: NDArray[np.float64],
    noise: float = 0.02,
    neighbour: float = 0.0,
    tooth: int | None = None,
    seed: int = 3,
) -> tuple[Offset | None, list[str]]:
    """Offset and sentences for one camera and one light.

    Args:
        neighbour: brightness beside the tooth.
        tooth: 0 for the left half of the ball, 1 for the right one.
    """
    pose = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 400.0), (0.0, 0.0, 0.0, 1.0))
    k = ((1000.0, 0.0, SIZE / 2), (0.0, 1000.0, SIZE / 2), (0.0, 0.0, 1.0))
    camera = Camera(name="c0", size=(SIZE, SIZE), K=k, camera_from_world=pose)
    inside = ball() > 0
    photo = np.where(photo > 0, photo, neighbour) + noise * np.random.default_rng(seed).standard_normal(photo.shape)
    arrays = {
        "radiance": photo[..., None],
        "variance": np.full((SIZE, SIZE, 1), noise**2),
        "valid": np.where(inside, 0, MaskBit.OUTSIDE),
    }
    for name, values in arrays.items():
        stored = create_array(
            root / "prepared.zarr", name, (1, 1, *values.shape), (1, 1, *values.shape),
            "uint16" if name == "valid" else "float32", ("camera", "light", "y", "x", "channel")[: 2 + values.ndim],
        )  # fmt: skip
        stored[0, 0] = values
    manifest = PreparedManifest(
        channels=("green",),
        cameras=(camera,),
        lights=lights(1),
        held_out=(),
        fdi=(11,),
        dentin_known=(),
        median_motion_px=None,
        valid_fraction=1.0,
    )
    observations = Observations(root, manifest, (Tooth(11, sphere(4.0)),), np.zeros((1, 1), dtype=bool))
    y, x = np.nonzero(inside)
    pixels = np.stack([x, y], axis=-1).astype(np.int32)
    valid, held_out = np.ones((1, len(x)), dtype=bool), np.zeros(1, dtype=bool)
    halves = (x >= SIZE // 2).astype(np.int16)
    views = (
        ViewStack(
            camera,
            pixels,
            photo[y, x][None],
            np.full((1, len(x)), noise**2),
            valid,
            held_out,
            PixelParts(halves, halves),
        ),
    )
    evaluation = Evaluation(ErrorSums(), ErrorSums(), {("c0", 0): (pixels, render[y, x])})
    told = offset_sentences(
        {"green": evaluation}, {"green": 0.3}, observations, {"green": views}, "the mesh of tooth 11", tooth
    )
    return clearest_offset(evaluation, observations, views, "green", tooth), told


@pytest.mark.parametrize(("right_mm", "down_mm"), [(2.0, 0.0), (0.0, -2.0), (-1.6, 1.2), (0.9, 0.0)])
def test_an_offset_is_found_with_its_direction_and_told(tmp_path: Path, right_mm: float, down_mm: float) -> None:
    offset, told = compare(tmp_path, ball(right_mm / PIXEL_MM, down_mm / PIXEL_MM), ball())
    assert offset is not None
    # Within half a pixel: the noise of the photograph moves the minimum by less.
    assert offset.right_mm == pytest.approx(right_mm, abs=0.5 * PIXEL_MM)
    assert offset.down_mm == pytest.approx(down_mm, abs=0.5 * PIXEL_MM)
    (sentence,) = told
    assert f"about {offset.length_mm:.1f} mm apart" in sentence
    assert sentence.endswith("recalibrate the camera or register the mesh again.")
    for size, positive, negative in ((right_mm, "right", "left"), (down_mm, "down", "up")):
        assert (positive in sentence.split("lie")[1].split(")")[0]) == (size > 0.3)
        assert (negative in sentence.split("lie")[1].split(")")[0]) == (size < -0.3)


def test_an_offset_is_found_where_the_fit_has_bent_its_media_to_it_and_neighbours_are_bright(tmp_path: Path) -> None:
    offset, _ = compare(tmp_path, ball(2.0 / PIXEL_MM), ball(exponent=0.6, floor=0.1), neighbour=0.3)
    assert offset is not None
    assert offset.right_mm == pytest.approx(2.0, abs=PIXEL_MM)


def test_one_tooth_of_two_that_lies_elsewhere_is_told_from_the_other(tmp_path: Path) -> None:
    # Only the right half of the photograph is higher than its mesh.
    photo = np.where(np.arange(SIZE) < SIZE // 2, ball(), ball(down_px=-1.6 / PIXEL_MM))
    assert compare(tmp_path / "left", photo, ball(), tooth=0) == (None, [])
    offset, told = compare(tmp_path / "right", photo, ball(), tooth=1)
    assert offset is not None
    assert offset.down_mm == pytest.approx(-1.6, abs=0.5 * PIXEL_MM)
    assert told[0].split(")")[0].endswith("mm up")


@pytest.mark.parametrize(
    ("photo", "render"),
    [
        (ball(), ball()),
        (ball(), 3.0 * ball()),
        (ball(), ball(exponent=0.7, floor=0.3)),
        (ball() * (1 + 0.3 * np.sin(np.arange(SIZE))), ball()),
        (ball(0.5), ball()),
    ],
    ids=["explained", "brightness", "shading", "stripes", "a fifth of a millimetre"],
)
def test_other_faults_are_not_called_an_offset(
    tmp_path: Path, photo: NDArray[np.float64], render: NDArray[np.float64]
) -> None:
    assert compare(tmp_path, photo, render) == (None, [])


def test_a_sentence_gives_the_error_and_says_what_cannot_be_seen(tmp_path: Path) -> None:
    _, (sentence,) = compare(tmp_path, ball(2.0 / PIXEL_MM), ball(), noise=0.1)
    error_mm = float(sentence.split("± ")[1].split(" mm")[0])
    assert 0 < error_mm < 0.5 * PIXEL_MM
    assert "how far along the line of sight cannot be seen" in sentence
