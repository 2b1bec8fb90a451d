"""Vignetting, the fall of light towards the corners of an image, from photographs of an even source."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.calibrate.session.photos import Channels, Photos
from services.core.errors import CaptureInputError

Floats = NDArray[np.float64]
CELLS = 48
"""Number of cells across an image whose means are fitted: they average the noise, and vignetting is smooth."""
MIN_LIGHT = 0.05
"""Smallest light in an image's corner as a fraction of that in the middle: with less the photograph is not one of an
even source."""


def measure_vignetting(photos: Photos, camera: str, principal_px: Floats) -> tuple[float, float, float] | None:
    """Fit the vignetting a, b, c of 1 + a q + b q² + c q³ to a camera's flat frames; None without any.

    q is the squared distance from the principal point, with half the image's diagonal as unit of length. All channels
    share one vignetting, each with a brightness of its own.

    Raises:
        CaptureInputError: a flat frame is saturated, or more uneven than a lens can make it.
    """
    frames = photos.folder.frames_of(camera, "flat")
    if not frames:
        return None
    size = photos.folder.camera_named(camera).size
    rows = []
    for frame in frames:
        photo = photos.channels(frame)
        if photo.saturated.mean() > 0.001:
            raise CaptureInputError(
                f"Frame {frame.file} (camera {camera}) is saturated in {photo.saturated.mean():.1%} of its pixels;"
                " expose the flat field less."
            )
        q, values = _cells(photo, size, principal_px)
        # Divide by the brightness of the middle, so that all frames and channels have the same weight.
        rows += [(q, values[:, k] / np.median(values[q < np.quantile(q, 0.2), k])) for k in range(values.shape[1])]
    return fit_vignetting(rows, camera)


def fit_vignetting(rows: list[tuple[Floats, Floats]], camera: str) -> tuple[float, float, float]:
    """Fit a, b, c to pairs of q (N,) and brightness (N,), each pair with a factor s of its own.

    Raises:
        CaptureInputError: the fitted vignetting leaves less than ``MIN_LIGHT`` in a corner.
    """
    # Fit brightness = s (1 + a q + b q² + c q³), which is linear in s, s a, s b and s c, to each pair; then take the
    # plain mean of a, b, c over the pairs.
    products = []
    for q, brightness in rows:
        coefficients = np.linalg.lstsq(np.stack([np.ones_like(q), q, q**2, q**3], axis=1), brightness, rcond=None)[0]
        products.append(coefficients[1:] / coefficients[0])
    a, b, c = (float(one) for one in np.mean(products, axis=0))
    edge = np.linspace(0, max(float(q.max()) for q, _ in rows), 50)
    if (1 + edge * (a + edge * (b + edge * c))).min() < MIN_LIGHT:
        raise CaptureInputError(
            f"Camera {camera}'s flat frames fall to nothing at the image's edge; photograph an even source that fills"
            " the view."
        )
    return a, b, c


def _cells(photo: Channels, size: tuple[int, int], principal_px: Floats) -> tuple[Floats, Floats]:
    """Return q (N,) and the mean values (N, C) of the cells of an image."""
    height, width, channels = photo.values.shape
    edge = max(width // CELLS, 1)
    rows, columns = height // edge, width // edge
    parts = photo.values[: rows * edge, : columns * edge].reshape(rows, edge, columns, edge, channels)
    means = parts.mean(axis=(1, 3), dtype=np.float64).reshape(-1, channels)
    x, y = np.meshgrid((np.arange(columns) + 0.5) * edge * photo.pixel, (np.arange(rows) + 0.5) * edge * photo.pixel)
    return relative_square(np.stack([x.ravel(), y.ravel()], axis=1), size, principal_px), means


def relative_square(pixels: Floats, size: tuple[int, int], principal_px: Floats) -> Floats:
    """Return q (N,) of pixels (N, 2): the squared distance from the principal point, with half the image's diagonal as
    unit of length.
    """
    return np.asarray(((pixels - principal_px) ** 2).sum(axis=1) / ((size[0] ** 2 + size[1] ** 2) / 4))
