"""A jaw with known optics as stock Mitsuba renders it; ``tests/benchmarks/render_jaw_truth.py`` made the images.

Its surfaces are those of one subject's phantom jaw, which is built again when the images are read; moments stored with
the images check that the surfaces are still the same. Sensor noise is added when the capture is written.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.core.geometry import Camera, Light
from services.phantom.dome_rig import dome_cameras, dome_lights
from services.phantom.files import held_out_lights, write_description, write_images
from services.phantom.jaw import JawSurfaces, jaw_surfaces, jaw_truth, known_mouth, write_jaw_meshes
from services.phantom.surface import PhantomSurface
from services.transport.optics.parameters import Mouth

STORED = Path(__file__).resolve().parents[1] / "data" / "truths-jaw" / "subject-1.npz"
SUBJECT, CHANNEL = 1, "green"
PIXEL_MM, CAMERAS, LIGHTS, HELD_OUT = 1.0, 3, 7, 2
NOISE_RELATIVE, NOISE_FLOOR = 0.01, 0.002
"""Standard deviation of sensor noise as shares of the pixel's value and of the image's maximum."""
NEIGHBOURS_PX = 2
"""Half width in pixels of the square over which the renderer's variance is averaged."""


@dataclass(frozen=True)
class JawTruth:
    """The jaw of ``SUBJECT`` without sensor noise."""

    jaw: JawSurfaces
    mouth: Mouth
    cameras: tuple[Camera, ...]
    lights: tuple[Light, ...]
    mean: tuple[NDArray[np.float64], ...]
    """Images (L, H, W) by camera."""
    variance: tuple[NDArray[np.float64], ...]
    """Variance (L, H, W) of the mean by camera, from independent passes."""


def cameras(jaw: JawSurfaces) -> tuple[Camera, ...]:
    """The rig's cameras."""
    return dome_cameras(CAMERAS, PIXEL_MM, tuple(tooth.outer for tooth in jaw.teeth))


def lights() -> tuple[Light, ...]:
    """The rig's lights."""
    return dome_lights(LIGHTS, (CHANNEL,), seed=SUBJECT)


@cache
def subjects_jaw() -> JawSurfaces:
    """The jaw of ``SUBJECT``, built once in a process; nobody may change its arrays."""
    return jaw_surfaces(SUBJECT)


def pack(stored: Path, passes: list[NDArray[np.float64]], samples: int) -> None:
    """Store the mean and standard error of images (P, L, H, W) of every camera, from P independent passes.

    Args:
        samples: paths per pixel of all passes together.
    """
    arrays: dict[str, NDArray[Any]] = {"samples": np.array(samples), "moments": _moments(subjects_jaw())}
    for k, images in enumerate(passes):
        arrays[f"mean_{k}"] = images.mean(axis=0).astype(np.float32)
        arrays[f"standard_error_{k}"] = (images.std(axis=0, ddof=1) / np.sqrt(len(images))).astype(np.float16)
    stored.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(stored, allow_pickle=False, **arrays)


def read_jaw_truth(stored: Path = STORED) -> JawTruth:
    """Read the images, and build the jaw that they show."""
    jaw = subjects_jaw()
    with np.load(stored) as arrays:
        assert np.allclose(arrays["moments"], _moments(jaw), rtol=1e-6), (
            f"the phantom jaw is not the one of {stored.name}; render it again"
        )
        mean, error = (
            [arrays[f"{kind}_{k}"].astype(np.float64) for k in range(CAMERAS)] for kind in ("mean", "standard_error")
        )
    return JawTruth(
        jaw, known_mouth(jaw, CHANNEL, SUBJECT), cameras(jaw), lights(), tuple(mean), tuple(one**2 for one in error)
    )


def by_engine(truth: JawTruth, samples: int) -> JawTruth:
    """Render the same jaw with the project's own engine, for tests of fits to images with less noise than stock Mitsuba
    can render in the same time.
    """
    from services.phantom.render import render_engine
    from services.transport.engine import Engine

    engine = Engine(truth.jaw.recipe(truth.lights, 0, PhantomSurface()))
    whole = [(9001 + k, camera, np.ones(camera.size[::-1], dtype=bool)) for k, camera in enumerate(truth.cameras)]
    stacks = [render_engine(engine, truth.mouth, camera, seen, samples, seed) for seed, camera, seen in whole]
    return replace(truth, mean=tuple(mean for mean, _ in stacks), variance=tuple(variance for _, variance in stacks))


def write_jaw_capture(folder: Path, truth: JawTruth, seed: int, *, dentin: bool = True) -> None:
    """Write the truth as a folder capture with sensor noise.

    A pixel's stored variance is the sensor's variance plus the renderer's, averaged over the pixel's neighbours. Where
    a pixel misses its few bright paths, its value and its own variance both come out low, so weights from its own
    variance would bias a fit downwards.

    Args:
        dentin: whether to write the surfaces of dentin.
    """
    random = np.random.default_rng(seed)
    entries, kept = [], held_out_lights(LIGHTS, HELD_OUT)
    for camera, mean, variance in zip(truth.cameras, truth.mean, truth.variance, strict=True):
        sensor = (NOISE_RELATIVE * mean) ** 2 + (NOISE_FLOOR * mean.max(axis=(1, 2), keepdims=True)) ** 2
        noisy = mean + np.sqrt(sensor) * random.standard_normal(mean.shape)
        entries += write_images(
            folder, camera, truth.lights, noisy[..., None], (sensor + _of_neighbours(variance))[..., None], kept
        )
    jaw = (
        truth.jaw
        if dentin
        else JawSurfaces(
            tuple(type(tooth)(tooth.fdi, tooth.outer) for tooth in truth.jaw.teeth), truth.jaw.gums, truth.jaw.cavity
        )
    )
    write_jaw_meshes(folder, jaw)
    known = jaw_truth(truth.jaw, {CHANNEL: truth.mouth}, PhantomSurface())
    write_description(
        folder, (CHANNEL,), truth.cameras, truth.lights, entries, known | {"subject": SUBJECT, "renderer": "mitsuba"}
    )


def _of_neighbours(variance: NDArray[np.float64]) -> NDArray[np.float64]:
    # Mean over the square around a pixel, without the pixel itself and without pixels of zero variance.
    from scipy.ndimage import uniform_filter

    width = 2 * NEIGHBOURS_PX + 1
    lit = variance > 0
    total, count = (
        uniform_filter(array, (0, width, width), mode="constant") * width**2 for array in (variance, lit.astype(float))
    )
    others, number = np.maximum(total - variance, 0.0), np.round(count - lit)
    return np.where(number > 0, others / np.maximum(number, 1), 0.0)


def _moments(jaw: JawSurfaces) -> NDArray[np.float64]:
    # Volume (mm³) and mean vertex (mm) of every surface.
    meshes = [mesh for tooth in jaw.teeth for mesh in (tooth.outer, tooth.dentin) if mesh is not None]
    return np.array([[mesh.signed_volume_mm3(), *mesh.vertices_mm.mean(axis=0)] for mesh in (*meshes, jaw.gums)])
