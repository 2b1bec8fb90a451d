"""Files that every phantom writes: images with their variance, the capture's description, and the true media."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from services.core.calibration.cameras_and_lights import CameraColour
from services.core.errors import InputError
from services.core.geometry import Camera, Light
from services.core.records import FolderCapture, ImageEntry
from services.core.store import write_atomic, write_record
from services.phantom.surface import PhantomSurface
from services.transport.optics.parameters import MEDIUM_FIELDS, Medium

CHANNELS = {1: ("green",), 3: ("red", "green", "blue")}
"""Names of the channels by their number."""
HELD_OUT_EVERY = 4
"""Period of the lights that are held out by default."""

XYZ_FROM_CAMERA = ((0.62, 0.22, 0.12422), (0.28, 0.70, 0.02), (0.03, 0.12, 0.67521))
"""Matrix from the virtual cameras' red, green and blue to XYZ, as a calibration states it. Its rows add up to the white
of D50, so a perfect diffuser is white."""

Renderer = Literal["engine", "mitsuba"]


def require_rig(
    pixel_mm: float,
    cameras: int,
    lights: int,
    channels: int,
    samples: int,
    held_out: int | None,
    surface: PhantomSurface,
    renderer: Renderer,
) -> None:
    """Refuse options with which no phantom can be rendered.

    Raises:
        InputError: an option is impossible; the message names it.
    """
    if min(cameras, lights) < 1 or samples < 16 or not pixel_mm > 0:
        raise InputError(
            "A phantom needs at least one camera, one light, 16 samples and a positive pixel size; raise the one that"
            " is too small."
        )
    if channels not in CHANNELS:
        raise InputError(f"A phantom has 1 or 3 channels, not {channels}; choose one of these.")
    if held_out is not None and not 0 <= held_out < lights:
        raise InputError(f"Of {lights} lights {held_out} cannot be held out; leave at least one to the fit.")
    surface.require_renderer(renderer)


def held_out_lights(lights: int, held_out: int | None) -> frozenset[int]:
    """Indices of the lights that are held out from the fit.

    These are every fourth light if ``held_out`` is None. Otherwise they are ``held_out`` lights at even distances, if
    possible without the first and the last one.
    """
    if held_out is None:
        return frozenset(range(HELD_OUT_EVERY - 1, lights, HELD_OUT_EVERY))
    return frozenset(int((k + 0.5) * lights / held_out) for k in range(held_out))


def write_images(
    out: Path,
    camera: Camera,
    lights: tuple[Light, ...],
    mean: NDArray[np.float64],
    variance: NDArray[np.float64],
    held_out: frozenset[int],
) -> list[ImageEntry]:
    """Write ``<camera>_<light>.npy`` and its variance for the images (L, H, W, C) of one camera; return their entries.

    Args:
        out: folder of the capture.
        mean, variance: (L, H, W, C), radiance and the variance of its estimate.
        held_out: indices of the lights that are marked as held out.
    """
    entries = []
    for n, light in enumerate(lights):
        stem = f"{camera.name}_{light.name}"
        write_image(out / f"{stem}.npy", mean[n])
        write_image(out / f"{stem}_var.npy", variance[n])
        entries.append(
            ImageEntry(
                camera=camera.name,
                light=light.name,
                file=f"{stem}.npy",
                variance_file=f"{stem}_var.npy",
                held_out=n in held_out,
            )
        )
    return entries


def write_image(path: Path, image: NDArray[np.float64]) -> None:
    """Write an image (H, W, C) as float32."""
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, image.astype(np.float32))


def write_description(
    out: Path,
    channels: tuple[str, ...],
    cameras: tuple[Camera, ...],
    lights: tuple[Light, ...],
    images: list[ImageEntry],
    truth: dict[str, Any],
) -> None:
    """Write ``truth.json`` and then ``capture.json``, whose presence makes the folder a capture."""
    write_atomic(out / "truth.json", (json.dumps(truth, indent=1) + "\n").encode())
    in_colour = len(channels) == len(XYZ_FROM_CAMERA)
    colour = {camera.name: CameraColour(xyz_from_rgb=XYZ_FROM_CAMERA) for camera in cameras} if in_colour else None
    write_record(
        out / "capture.json",
        FolderCapture(
            units="mm", channels=channels, cameras=cameras, lights=lights, images=tuple(images), colour=colour
        ),
    )


def medium_truth(medium: Medium) -> dict[str, float]:
    """A medium's parameters, its reduced scattering (1/mm) and its reduced albedo, by name."""
    fields = {field: float(getattr(medium, field)) for field in MEDIUM_FIELDS}
    return fields | {"sigma_s_reduced": medium.sigma_s_reduced, "alpha_reduced": medium.alpha_reduced}
