"""Measured images of one wavelength: radiance and variance on the rig's grid, checked and folded."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.core.errors import CaptureInputError
from services.core.slab.folder import SlabFolder, SlabImage
from services.slab.cell.rig import Grid, grid_of
from services.slab.read.diagnosis import grid_faults, image_faults, max_power_per_sr, power_per_sr
from services.slab.read.exposures import Merged, merged_images

Array = NDArray[np.float64]

DEFAULT_NOISE = 0.01
"""Standard deviation of shot noise where no variance is given, as a share of a pixel that has the image's mean."""
DARKEST = 0.01
"""Share of the image's mean below which shot noise falls no further."""


@dataclass(frozen=True)
class Measurements:
    """Values and variances (images, pixels); a variance is infinite where a pixel is not used."""

    values: Array
    variances: Array
    held_out: NDArray[np.bool_]
    places: tuple[tuple[str, str], ...]
    """Camera and light of each image."""
    assumed_noise: bool
    """Whether some image had no variance of its own."""
    faults: tuple[str, ...] = ()
    """Sentences on faults of the images; see ``diagnosis``."""

    @property
    def names(self) -> tuple[str, ...]:
        """Name of each image, such as "b0 under l1"."""
        return tuple(f"{camera} under {light}" for camera, light in self.places)


def read_images(root: Path, folder: SlabFolder, wavelength_nm: float) -> Measurements:
    """The images of one wavelength, per unit of the beam's power.

    Raises:
        CaptureInputError: a file cannot be read, has another shape, has no usable pixel, or shows more light than the
            beam can send there; or no image is left to be fitted.
    """
    grid = grid_of(folder.pixels)
    entries = folder.images_at(wavelength_nm)
    if not entries:
        raise CaptureInputError(
            f"{root / 'slab.json'} lists no image at {wavelength_nm:g} nm; add some or remove the wavelength."
        )
    merged = merged_images(root, folder, wavelength_nm) if folder.exposures else None
    values, variances, faults, assumed = [], [], list(grid_faults(folder.pixels)), False
    faults += () if merged is None else merged.faults
    for entry, image, own in _linear(root, folder, entries, merged):
        name = f"{entry.camera} under {entry.light}"
        if folder.exposures and (full := int(np.isnan(image).sum())):
            if full == image.size:
                raise CaptureInputError(
                    f"All exposures of image {name} at {wavelength_nm:g} nm are full in every pixel, the first of them"
                    f" {root / entry.file}; expose for less long."
                )
            faults.append(
                f"In image {name} {full} pixels are full in every exposure and left out; add a shorter exposure."
            )
        variance, assumed = (shot_noise(image), True) if own is None else (own, assumed)
        usable = np.isfinite(image) & np.isfinite(variance) & (variance > 0)
        if own is None and np.isfinite(image).any() and not image[np.isfinite(image)].mean() > 0:
            raise CaptureInputError(
                f"Image file {root / entry.file} holds no light: its mean is not above zero; export it again, or leave"
                " it out."
            )
        if not usable.any():
            raise CaptureInputError(
                f"Image file {root / entry.file} has no pixel that is finite with a positive variance; export it again."
            )
        if not folder.exposures and (lost := int(np.count_nonzero(~usable))):
            faults.append(f"In image {name} {lost} pixels are not finite or have no variance and are left out.")
        _require_less_than_the_beam(folder, entry, np.where(usable, image, np.nan), root)
        faults += image_faults(name, image, folder.pixels, folder.beam)
        value, value_variance = folded(np.where(usable, image, 0), np.where(usable, variance, np.inf), grid)
        values.append(value)
        variances.append(value_variance)
    held_out = np.array([entry.held_out for entry in entries])
    if held_out.all():
        raise CaptureInputError(f"All images at {wavelength_nm:g} nm are held out; leave some to be fitted.")
    return Measurements(
        np.stack(values), np.stack(variances), held_out,
        tuple((entry.camera, entry.light) for entry in entries), assumed, tuple(faults),
    )  # fmt: skip


def _require_less_than_the_beam(folder: SlabFolder, entry: SlabImage, image: Array, root: Path) -> None:
    # Raises CaptureInputError where an image is so bright that its unit must be wrong.
    (camera,) = (one for one in folder.cameras if one.name == entry.camera)
    (light,) = (one for one in folder.lights if one.name == entry.light)
    share, most = power_per_sr(image, folder.pixels, camera), max_power_per_sr(camera, light)
    if share > most:
        remedy = (
            "correct beam.power and the exposures' exposure_s"
            if folder.exposures
            else "give radiance per unit of the beam's power, per mm2 and sr"
        )
        raise CaptureInputError(
            f"Image file {root / entry.file} (camera {entry.camera}, light {entry.light}) shows {share:.2g} times the"
            f" beam's power per sr, and no material sends more than {most:.2g} there; {remedy}."
        )


def _linear(
    root: Path, folder: SlabFolder, entries: Sequence[SlabImage], merged: Merged | None
) -> Iterator[tuple[SlabImage, Array, Array | None]]:
    """Each image with its variance, None where the variance has to be assumed."""
    for entry in entries:
        if merged is not None:
            key = entry.camera, entry.light
            yield entry, merged.values[key], None if merged.variances is None else merged.variances[key]
            continue
        variance = None if entry.variance_file is None else _read(root, folder, entry, entry.variance_file)
        yield entry, _read(root, folder, entry, entry.file), variance


def shot_noise(image: Array, share: float = DEFAULT_NOISE) -> Array:
    """Variance of Poisson noise whose standard deviation is ``share`` of a pixel at the image's mean."""
    finite = image[np.isfinite(image)]
    mean = max(float(finite.mean()), 0.0) if finite.size else 0.0
    return share**2 * mean * np.maximum(image, DARKEST * mean)


def _read(root: Path, folder: SlabFolder, entry: SlabImage, file: str) -> Array:
    subject = f"Image file {root / file} (camera {entry.camera}, light {entry.light})"
    if Path(file).suffix.lower() != ".npy":
        raise CaptureInputError(
            f"{subject} is no .npy file, the only format read here; convert it with numpy.save, linear and as float."
        )
    try:
        image = np.load(root / file, allow_pickle=False)
    except (ValueError, EOFError, OSError) as problem:
        raise CaptureInputError(
            f"{subject} cannot be read ({problem}); it may be truncated, so copy or export it again."
        ) from problem
    expected = folder.pixels.rows, folder.pixels.columns
    if not isinstance(image, np.ndarray) or image.shape != expected or not np.issubdtype(image.dtype, np.floating):
        found = f"{image.dtype} {image.shape}" if isinstance(image, np.ndarray) else "an archive"
        raise CaptureInputError(
            f"{subject} holds {found} instead of floats {expected} (rows, columns); export it on the folder's grid."
        )
    return image.astype(np.float64)


def folded(value: Array, variance: Array, grid: Grid) -> tuple[Array, Array]:
    """Means of the two halves where the grid is folded, over those that are usable, and their variances; flat
    (pixels,).
    """
    if not grid.folded:
        return value.ravel(), variance.ravel()
    halves = np.stack([value[: grid.rows][::-1], value[grid.rows :]])
    weights = 1 / np.stack([variance[: grid.rows][::-1], variance[grid.rows :]])
    total = weights.sum(axis=0)
    # Both halves have the same expectation, so they are weighted alike where both are usable: weights by noisy values
    # are biased.
    usable = weights > 0
    count = usable.sum(axis=0)
    mean = (halves * usable).sum(axis=0) / np.maximum(count, 1)
    spread = np.where(usable, 1 / np.maximum(weights, 1e-300), 0).sum(axis=0) / np.maximum(count, 1) ** 2
    return mean.ravel(), np.where(total > 0, spread, np.inf).ravel()
