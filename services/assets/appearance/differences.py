"""Maps of the colour difference ΔE00 between photographs and renders, on squares so large that they show more than
noise.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.assets.appearance.white import CameraWhite
from services.core.colour.cie import delta_e_2000
from services.core.geometry import Record
from services.core.pages.pictures import Picture

Floats = NDArray[np.float64]

JUST_SEEN, ACCEPTED = 0.8, 1.8
"""Differences that half of observers see, and accept (ISO/TR 28642:2016)."""
MAX_NOISE = 1.0
"""Median ΔE00 that noise alone may give on the squares; near what is just seen."""
MIN_SQUARES = 12
"""Squares that remain where noise would need still larger ones."""
GAIN = 0.95
"""Share of the noise that larger squares may leave; where they leave more, the render's common noise decides."""
EDGES_PX = (1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 24, 32, 40, 48, 64)
"""Edges of the squares that are tried, pixels."""
DRAWS = 32
"""Draws of noise for each square, whose median over the squares is then known to a few per cent."""


class ColourDifference(Record):
    """ΔE00 between a photograph and its render, each averaged over squares; noise of both is included."""

    camera: str
    light: str
    """Name of the light, or words for several."""
    held_out: bool
    edge_px: int
    """Edge of the squares, in pixels of the picture that was compared."""
    rows: tuple[tuple[float | None, ...], ...]
    """ΔE00 of each square; None where less than half of a square was compared."""
    median: float
    most: float
    """The difference that 95 % of the squares keep."""
    noise: float
    """Median that noise alone would give."""

    @property
    def image(self) -> Floats:
        """ΔE00 of each square (H, W), NaN where it was not compared."""
        return np.array([[np.nan if one is None else one for one in row] for row in self.rows])


def colour_difference(
    picture: Picture, white_radiance: Floats, white: CameraWhite, render_noise: Floats | None = None
) -> ColourDifference | None:
    """Compare a photograph with its render; None where no pixel was compared.

    Noise that differs from pixel to pixel is measured by differences of neighbours, so that of both is in it; what
    changes so fast in truth counts as noise too.

    Args:
        white_radiance: radiance (3,) of a perfect diffuser that faces the light where the teeth are.
        white: the camera's colours.
        render_noise: covariance (3, 3) of the render's noise relative to itself, where its pixels share their noise.
    """
    valid = picture.valid & np.isfinite(picture.photo).all(axis=-1)
    if not valid.any():
        return None
    photo, render = (
        np.where(valid[..., None], image, 0.0) / white_radiance for image in (picture.photo, picture.render)
    )
    covariance = _neighbour_covariance(photo - render, valid)
    found = None
    for edge in EDGES_PX:
        squares = _on_squares(photo, render, covariance, valid, edge)
        if found is not None and np.isfinite(squares[0][..., 0]).sum() < MIN_SQUARES:
            break
        larger = _compared(picture, edge, *squares, white, render_noise)
        if found is not None and larger.noise > GAIN * found.noise:
            break
        found = larger
        if found.noise <= MAX_NOISE:
            break
    return found


def _neighbour_covariance(difference: Floats, valid: NDArray[np.bool_]) -> Floats:
    """Covariance (H, W, 3, 3) of a pixel's noise: the mean of half of the outer product of the difference to a
    neighbour, over pairs of valid pixels within one pixel; NaN where there is no pair.
    """
    from scipy.ndimage import uniform_filter

    total, count = np.zeros((*difference.shape, 3)), np.zeros(valid.shape)
    for axis in (0, 1):
        step = np.diff(difference, axis=axis)
        both = np.logical_and(*(np.delete(valid, end, axis=axis) for end in (0, -1)))
        outer = np.where(both[..., None, None], step[..., :, None] * step[..., None, :] / 2, 0.0)
        for end in (0, 1):
            place = tuple(slice(end, valid.shape[k] - 1 + end) if k == axis else slice(None) for k in (0, 1))
            total[place] += outer
            count[place] += both
    total, count = uniform_filter(total, (3, 3, 1, 1), mode="constant"), uniform_filter(count, 3, mode="constant")
    return np.asarray(
        np.where(count > 1e-9, 1, np.nan)[..., None, None] * total / np.maximum(count, 1e-9)[..., None, None]
    )


def _on_squares(
    photo: Floats, render: Floats, covariance: Floats, valid: NDArray[np.bool_], edge: int
) -> tuple[Floats, Floats, Floats]:
    """Means (h, w, 3) of photograph and render and the covariance (h, w, 3, 3) of their noise; NaN where less than half
    of a square is valid.
    """
    height, width = (-(-size // edge) for size in valid.shape)

    def total(values: Floats) -> Floats:
        padding = [(0, height * edge - valid.shape[0]), (0, width * edge - valid.shape[1])]
        padded = np.pad(values, padding + [(0, 0)] * (values.ndim - 2))
        return np.asarray(padded.reshape(height, edge, width, edge, *values.shape[2:]).sum(axis=(1, 3)))

    count = total(valid.astype(np.float64))
    count = np.where(2 * count >= edge**2, count, np.nan)[..., None]
    spread = total(np.where(valid[..., None, None], np.nan_to_num(covariance), 0.0))
    return total(photo) / count, total(render) / count, spread / count[..., None] ** 2


def _compared(
    picture: Picture,
    edge: int,
    photo: Floats,
    render: Floats,
    covariance: Floats,
    white: CameraWhite,
    own: Floats | None,
) -> ColourDifference:
    on = np.isfinite(photo[..., 0])
    image = np.full(on.shape, np.nan)
    image[on] = _delta(photo[on], render[on], white)
    spread = covariance[on] + (0.0 if own is None else own * render[on][:, :, None] * render[on][:, None, :])
    values, vectors = np.linalg.eigh(spread)
    roots = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    random = np.random.default_rng(0).standard_normal((DRAWS, *render[on].shape))
    noise = [_delta(render[on] + np.einsum("nij,nj->ni", roots, draw), render[on], white) for draw in random]
    return ColourDifference(
        camera=picture.camera,
        light=picture.light,
        held_out=picture.held_out,
        edge_px=edge,
        rows=tuple(tuple(None if np.isnan(one) else float(one) for one in row) for row in image),
        median=float(np.median(image[on])),
        most=float(np.percentile(image[on], 95)),
        noise=float(np.median(noise)),
    )


def _delta(one: Floats, two: Floats, white: CameraWhite) -> Floats:
    return delta_e_2000(*(white.lab(np.maximum(each, 0.0)) for each in (one, two)))
