"""Stacks of exposures in a slab folder, from a camera whose numbers are known: what is read, and what is refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from services.api.captures.contents import content_fault
from services.core.errors import CaptureInputError
from services.core.settings import UploadLimits
from services.core.slab.folder import read_folder
from services.slab.cell.rig import rig_of
from services.slab.options import SlabOptions
from services.slab.read.images import read_images
from services.slab.results.stored import fingerprint
from tests.support.raw_sensor import Sensor
from tests.support.small_slab import WAVELENGTH_NM, description

EDGE = 48
POWER = 25_000.0
"""Counts per s that the whole beam would give; exposures are divided by it."""
TIMES_S = (0.05, 0.4, 3.2)
SENSOR = Sensor()
"""12 bits; full at 4095 counts, with 64 of black."""
EXPOSURE = {"exposure_s": 1.0, "bits": 12}


def radiance() -> np.ndarray:
    """From 2 to 20,000 counts per s above black: the longest exposure is full near the middle, and the shortest is dark
    away from it.
    """
    x, y = np.meshgrid(*2 * [np.linspace(-4, 4, EDGE)])
    return np.asarray(2 + 20_000 * np.exp(-2 * np.hypot(x, y)))


@lru_cache(maxsize=1)
def frames() -> dict[str, np.ndarray]:
    """Frames by file: three exposures of two cameras under two lights, and four black frames of each camera."""
    rng, light, shown = np.random.default_rng(3), radiance()[..., None], dict[str, np.ndarray]()
    for image in description()["images"]:
        for number, time_s in enumerate(TIMES_S):
            shown[image["file"].replace(".npy", f"_{number}.npy")] = SENSOR.counts(light, time_s, rng)[..., 0]
    for camera in ("f0", "b0"):
        for number in range(4):
            shown[f"{camera}_black_{number}.npy"] = SENSOR.counts(0 * light, 1.0, rng)[..., 0]
    return shown


def write_stack(root: Path, *, change: Callable[[dict[str, Any]], object] = lambda _: None) -> Path:
    """Writes a folder of two cameras and two lights in three exposures, with black frames."""
    told = description()
    told["pixels"] |= {"columns": EDGE, "rows": EDGE}
    told["beam"]["power"] = POWER
    told["exposures"] = []
    for image in told.pop("images"):
        for number, time_s in enumerate(TIMES_S):
            file = image["file"].replace(".npy", f"_{number}.npy")
            told["exposures"].append(image | EXPOSURE | {"file": file, "exposure_s": time_s})
    for camera in ("f0", "b0"):
        for number in range(4):
            file = f"{camera}_black_{number}.npy"
            told["exposures"].append(EXPOSURE | {"camera": camera, "kind": "black", "file": file})
    for file, frame in frames().items():
        np.save(root / file, frame)
    change(told)
    (root / "slab.json").write_text(json.dumps(told))
    return root


def test_exposures_become_one_image_with_the_noise_that_it_has(tmp_path: Path) -> None:
    root = write_stack(tmp_path)
    measured = read_images(root, read_folder(root), WAVELENGTH_NM)
    assert not measured.assumed_noise
    assert measured.names == ("f0 under l0", "b0 under l0", "f0 under l1", "b0 under l1")
    true = radiance()[EDGE // 2 :].ravel() / POWER  # symmetric in y, as the fold expects
    z = (measured.values - true) / np.sqrt(measured.variances)
    # 4,608 values: the rms of as many normally distributed ones is 1 within 0.011; the measured noise model is known to
    # 2 %.
    assert np.sqrt(np.mean(z**2)) == pytest.approx(1, abs=0.05)
    assert abs(z.mean()) < 5 / np.sqrt(z.size)
    # Only the shortest exposure shows the brightest pixels; the longest, with 64 times the light, shows the dark ones
    # better.
    dark = true * POWER < 5
    alone = np.sqrt((2.0**2 + 0.5 * true * POWER * TIMES_S[0]) / 2) / TIMES_S[0] / POWER
    assert (np.sqrt(measured.variances[0])[dark] < 0.05 * alone[dark]).all()
    assert np.isfinite(measured.variances).all()


def test_an_image_is_held_out_where_all_its_exposures_are(tmp_path: Path) -> None:
    def hold_out(told: dict[str, Any]) -> None:
        for one in told["exposures"]:
            one["held_out"] = one["camera"] == "b0" and one.get("light") == "l1"

    root = write_stack(tmp_path, change=hold_out)
    measured = read_images(root, read_folder(root), WAVELENGTH_NM)
    assert [name for name, out in zip(measured.names, measured.held_out, strict=True) if out] == ["b0 under l1"]


def test_pixels_that_are_full_in_all_exposures_count_for_nothing(tmp_path: Path) -> None:
    root = write_stack(tmp_path, change=lambda d: [one.update(saturation_counts=300) for one in d["exposures"]])
    measured = read_images(root, read_folder(root), WAVELENGTH_NM)
    lost = np.isinf(measured.variances[0])
    bright = radiance()[EDGE // 2 :].ravel() * TIMES_S[0] > 300 - SENSOR.black
    # Noise decides about pixels within a few standard deviations of the limit.
    assert abs(int(lost.sum()) - int(bright.sum())) <= 4
    assert lost.any()
    assert np.isfinite(measured.values).all()
    told = [fault for fault in measured.faults if "full in every exposure" in fault]
    assert len(told) == 4
    assert told[0].startswith("In image f0 under l0 ")


def test_without_noise_that_frames_tell_it_is_assumed(tmp_path: Path) -> None:
    def first_alone(told: dict[str, Any]) -> None:
        told["exposures"] = [one for one in told["exposures"] if "_0.npy" in one["file"]]

    root = write_stack(tmp_path, change=first_alone)
    assert read_images(root, read_folder(root), WAVELENGTH_NM).assumed_noise


def known_counts(told: dict[str, Any]) -> None:
    """Gives the sensor's own numbers in place of black frames."""
    told["exposures"] = [one for one in told["exposures"] if one.get("kind") != "black"]
    for camera in told["cameras"]:
        camera["counts"] = {
            "black": SENSOR.black,
            "read_noise": SENSOR.read_counts,
            "per_electron": SENSOR.counts_per_electron,
        }


def test_counts_that_are_known_need_no_black_frames(tmp_path: Path) -> None:
    measured = [
        read_images(root, read_folder(root), WAVELENGTH_NM)
        for root in (
            write_stack(folder(tmp_path, "frames")),
            write_stack(folder(tmp_path, "known"), change=known_counts),
        )
    ]
    assert not any(one.assumed_noise for one in measured)
    by_frames, known = measured
    # Four black frames add a quarter of a frame's read noise, of which the images share all else.
    finite = np.isfinite(known.variances) & np.isfinite(by_frames.variances)
    assert finite.mean() > 0.99
    z = (known.values - by_frames.values)[finite] / np.sqrt(by_frames.variances[finite])
    assert 0 < np.sqrt((z**2).mean()) < 0.5
    # Frames tell the noise to some per cent.
    assert 0.7 < np.median(known.variances[finite] / by_frames.variances[finite]) < 1.1


@pytest.mark.parametrize(
    ("factor", "is_told"), [(1.0, False), (1.5, False), (1 / 1.5, False), (4.0, True), (1 / 4, True)]
)
def test_counts_per_electron_that_frames_contradict_are_told(tmp_path: Path, factor: float, is_told: bool) -> None:
    """As where electrons per count are stated in place of counts per electron."""

    def misstate(told: dict[str, Any]) -> None:
        known_counts(told)
        for camera in told["cameras"]:
            camera["counts"]["per_electron"] *= factor

    root = write_stack(tmp_path, change=misstate)
    faults = read_images(root, read_folder(root), WAVELENGTH_NM).faults
    stated = f"counts.per_electron says {factor * SENSOR.counts_per_electron:g}"
    assert [stated in fault for fault in faults if "scatter like" in fault] == [True, True] * is_told


def folder(parent: Path, name: str) -> Path:
    (parent / name).mkdir()
    return parent / name


def test_cameras_may_share_a_black_frame(tmp_path: Path) -> None:
    """As where one camera is moved to several places."""

    def shared(told: dict[str, Any]) -> None:
        for one in blacks(told):
            one["file"] = one["file"].replace("b0_", "f0_")

    root = write_stack(tmp_path, change=shared)
    assert not read_images(root, read_folder(root), WAVELENGTH_NM).assumed_noise


def test_a_short_exposure_may_be_too_dim_to_see(tmp_path: Path) -> None:
    """Where longer ones show light, a short one of less than its noise contradicts nothing."""
    root, rng, dim = write_stack(tmp_path), np.random.default_rng(9), np.full((EDGE, EDGE, 1), 2.0)
    for number, time_s in enumerate(TIMES_S):
        np.save(root / f"f0_l0_{number}.npy", SENSOR.counts(dim, time_s, rng)[..., 0])
    measured = read_images(root, read_folder(root), WAVELENGTH_NM)
    assert measured.values[0].mean() == pytest.approx(2 / POWER, rel=0.1)


def test_a_beam_on_a_few_pixels_is_light(tmp_path: Path) -> None:
    """Nine pixels of 2,304 are lit: the spread over the image is then that of the light, not of the noise."""
    root, rng, lit = write_stack(tmp_path), np.random.default_rng(8), np.zeros((EDGE, EDGE, 1))
    lit[23:26, 23:26] = 3000
    for number, time_s in enumerate(TIMES_S):
        np.save(root / f"f0_l0_{number}.npy", SENSOR.counts(lit, time_s, rng)[..., 0])
    measured = read_images(root, read_folder(root), WAVELENGTH_NM)
    assert measured.values[0].max() == pytest.approx(3000 / POWER, rel=0.1)


def test_a_result_is_of_all_frames_it_was_made_from(tmp_path: Path) -> None:
    root = write_stack(tmp_path)
    before = fingerprint(root, WAVELENGTH_NM, SlabOptions())
    frame = np.load(root / "b0_black_3.npy")
    frame[0, 0] += 1
    np.save(root / "b0_black_3.npy", frame)
    assert fingerprint(root, WAVELENGTH_NM, SlabOptions()) != before


def test_an_upload_needs_every_frame(tmp_path: Path) -> None:
    path = write_stack(tmp_path) / "slab.json"
    files = frozenset(one.name for one in tmp_path.glob("*.npy"))
    assert content_fault(path, "slab.json", UploadLimits(), files) is None
    told = content_fault(path, "slab.json", UploadLimits(), files - {"f0_black_0.npy"})
    assert told is not None
    assert "f0_black_0.npy" in told


def test_black_frames_of_another_wavelength_do_not_count(tmp_path: Path) -> None:
    def of_two(told: dict[str, Any]) -> None:
        told["wavelengths_nm"] = [532.0, 633.0]
        for one in told["exposures"]:
            one["wavelength_nm"] = 532.0
        told["exposures"].append(told["exposures"][0] | {"file": "red.npy", "wavelength_nm": 633.0})

    root = write_stack(tmp_path, change=of_two)
    with pytest.raises(CaptureInputError, match="no black exposure, so the zero of red"):
        read_folder(root)


def blacks(told: dict[str, Any]) -> list[dict[str, Any]]:
    return [one for one in told["exposures"] if one.get("kind") == "black"]


BAD: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "images too": (lambda d: d.update(description()), "either images or exposures, not both"),
    "no power": (lambda d: d["beam"].pop("power"), "beam has no power, by which exposures are divided"),
    "times in hours": (
        lambda d: [one.update(exposure_s=one["exposure_s"] / 3600) for one in d["exposures"]],
        "times the beam's power per sr, and no material sends more than 6.6 there; correct beam.power",
    ),
    "full": (
        lambda d: [one.update(saturation_counts=1) for one in d["exposures"]],
        "All exposures of image f0 under l0 at 532 nm are full in every pixel, the first of them",
    ),
    "held out in part": (
        lambda d: d["exposures"][1].update(held_out=True),
        "of camera f0 under light l0 is fitted and another of the same image is held out; hold out all of them or none",
    ),
    "black held out": (lambda d: blacks(d)[0].update(held_out=True), "only exposures of light are held out"),
    "no black": (lambda d: [d["exposures"].remove(one) for one in blacks(d)], "camera f0 has no black exposure"),
    "lit black": (lambda d: blacks(d)[0].update(light="l0"), "has no light on"),
    "light not named": (lambda d: d["exposures"][0].pop("light"), "must name its light"),
    "not said when full": (lambda d: d["exposures"][0].pop("bits"), "give bits or saturation_counts"),
    "fuller than full": (lambda d: d["exposures"][0].update(saturation_counts=5000), "more than 12 bits hold"),
    "the same file twice": (lambda d: d["exposures"].append(d["exposures"][0]), "is listed in two exposures"),
    "a light and a black": (
        lambda d: d["exposures"][0].update(file="b0_black_0.npy"), "b0_black_0.npy is listed in two exposures"
    ),
    "no time": (lambda d: d["exposures"][0].update(exposure_s=0), "exposure_s"),
    "unknown light": (lambda d: d["exposures"][0].update(light="x"), "names light x"),
    "unknown wavelength": (lambda d: d["exposures"][0].update(wavelength_nm=700), "wavelength_nm 700"),
    "a missing frame": (lambda d: d["exposures"][-1].update(file="gone.npy"), "gone.npy does not exist"),
    "fewer bits": (lambda d: d["exposures"][2].update(bits=8), "more than the 8 bits"),
    "black as a light": (
        lambda d: d["exposures"][2].update(file="f0_black_1.npy") or d["exposures"].remove(blacks(d)[1]),
        "no brighter than",
    ),
    "half a noise": (lambda d: d["cameras"][0].update(counts={"read_noise": 2}), "give both or neither"),
    "two blacks": (lambda d: d["cameras"][0].update(counts={"black": 64}), "keep one of both"),
    "too far up": (lambda d: d["exposures"][0].update(shift=8), "together more than the 16 bits"),
    "times exchanged": (
        lambda d: [one.update(exposure_s=TIMES_S[2 - TIMES_S.index(one["exposure_s"])]) for one in d["exposures"][:3]],
        "-fold in counts per second and gain; check their exposure_s and gain, and which file is which.",
    ),
    "another size": (lambda d: d["pixels"].update(columns=EDGE // 2), "export it at the camera's size"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_exposures_are_refused_by_a_sentence(tmp_path: Path, name: str) -> None:
    change, told = BAD[name]
    root = write_stack(tmp_path, change=change)
    with pytest.raises(CaptureInputError) as refused:
        read_images(root, read_folder(root), WAVELENGTH_NM)
    assert told in str(refused.value)
    assert "\n" not in str(refused.value)


def test_the_rig_has_one_image_for_each_camera_under_each_light(tmp_path: Path) -> None:
    assert rig_of(read_folder(write_stack(tmp_path)), WAVELENGTH_NM).images == 4
