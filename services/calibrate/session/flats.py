"""The fall of light towards the corners of an image, from photographs of an even source."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.calibrate.session.photos import Channels, Photos
from services.core.errors import CaptureInputError

Floats = NDArray[np.float64]
CELLS = 48
"""Means of so many cells across an image: noise is averaged, and the fall of light is smooth."""
MIN_LIGHT = 0.05
"""Of the middle's light, below which an image's corner is no photograph of an even source through this lens."""


def fall_of_light(photos: Photos, camera: str, principal_px: Floats) -> tuple[float, float, float] | None:
    """a, b, c of 1 + a q + b q² + c q³ from a camera's flat frames; None without any.

    q is the squared distance from the principal point in units of half the image's diagonal. All channels share one
    fall of light, each with a brightness of its own.

    Raises:
        CaptureInputError: a flat frame is saturated or uneven beyond what a lens does.
    """
    frames = photos.folder.frames_of(camera, "flat")
    if not frames:
        return None
    size = photos.folder.camera_named(camera).size
    rows = []
    for frame in frames:
        seen = photos.channels(frame)
        if seen.saturated.mean() > 0.001:
            raise CaptureInputError(
                f"Frame {frame.file} (camera {camera}) is saturated in {seen.saturated.mean():.1%} of its pixels;"
                " expose the flat field less."
            )
        q, values = _cells(seen, size, principal_px)
        # Cells over the middle's brightness, so that frames of different exposure and channels weigh alike.
        rows += [(q, values[:, k] / np.median(values[q < np.quantile(q, 0.2), k])) for k in range(values.shape[1])]
    return fit_fall(rows, camera)


def fit_fall(rows: list[tuple[Floats, Floats]], camera: str) -> tuple[float, float, float]:
    """a, b, c from pairs of q (N,) and brightness (N,), each pair with a factor of its own.

    Raises:
        CaptureInputError: the fitted fall leaves no light in a corner.
    """
    # brightness = s (1 + a q + b q² + c q³): linear in s and in the products; the mean over pairs weighs by s.
    products = []
    for q, brightness in rows:
        answer = np.linalg.lstsq(np.stack([np.ones_like(q), q, q**2, q**3], axis=1), brightness, rcond=None)[0]
        products.append(answer[1:] / answer[0])
    a, b, c = (float(one) for one in np.mean(products, axis=0))
    edge = np.linspace(0, max(float(q.max()) for q, _ in rows), 50)
    if (1 + edge * (a + edge * (b + edge * c))).min() < MIN_LIGHT:
        raise CaptureInputError(
            f"Camera {camera}'s flat frames fall to nothing at the image's edge; photograph an even source that fills"
            " the view."
        )
    return a, b, c


def _cells(seen: Channels, size: tuple[int, int], principal_px: Floats) -> tuple[Floats, Floats]:
    """For cells of an image q (N,), and their mean values (N, C)."""
    height, width, channels = seen.values.shape
    edge = max(width // CELLS, 1)
    rows, columns = height // edge, width // edge
    parts = seen.values[: rows * edge, : columns * edge].reshape(rows, edge, columns, edge, channels)
    means = parts.mean(axis=(1, 3), dtype=np.float64).reshape(-1, channels)
    x, y = np.meshgrid((np.arange(columns) + 0.5) * edge * seen.pixel, (np.arange(rows) + 0.5) * edge * seen.pixel)
    return relative_square(np.stack([x.ravel(), y.ravel()], axis=1), size, principal_px), means


def relative_square(pixels: Floats, size: tuple[int, int], principal_px: Floats) -> Floats:
    """The q (N,) of pixels (N, 2): squared distance from the principal point in units of half the image's diagonal."""
    return np.asarray(((pixels - principal_px) ** 2).sum(axis=1) / ((size[0] ** 2 + size[1] ** 2) / 4))
