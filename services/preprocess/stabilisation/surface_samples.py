"""The scanned surface of a body as one camera sees it, sampled more finely than its pixels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from services.core.geometry import Camera
from services.preprocess.views.projection import Footprint
from services.preprocess.views.window import Window

Image = NDArray[np.float32]

BAND_PX = 2
"""Width of the compared band on either side of the outline, pixels. Farther in, the terms follow a translucent tooth's
shading less well than the outline needs: with bands of 5 and 8 pixels errors are 10 and 25 % larger."""
SAMPLED_PX, MIN_SAMPLES, MAX_SAMPLES = 200, 2, 6
"""Longest side of the body in samples of the surface, and the bounds of the samples along a pixel's side: the share of
an outline's pixel that is covered is known to a few per cent, and the template of a large body fits in memory."""
ARCS = 12
"""Number of arcs of the outline whose residuals count as independent of each other: shading is alike along a twelfth of
an outline and differs beyond it."""


class SurfaceSamples:
    """Samples of the surface in one reduced image and around it.

    Attributes:
        factor: pixels of the image in a pixel of the reduced one, along a side.
        reach: largest translation that is searched, pixels of the reduced image, as all lengths here.
        samples: samples along a pixel's side.
        pad: pixels around the reduced image that are sampled too.
        shape: rows and columns of the reduced image.
        body, other: (h, w) samples that show the body, and those that show another surface.
        points_mm, normal: (h, w, 3) place and normal of the surface in the world.
        shading: (h, w, 14) polynomials of normal and place.
        place: x and y (h, w) of the samples, of the order of one over the body.
        arc: (H, W) number of the arc of the outline to which a pixel belongs.
        band: (H, W) pixels along the outline. around: (H, W) pixels that the body may cover.
    """

    def __init__(
        self,
        camera: Camera,
        numbers: Sequence[int],
        factor: int,
        extent: float,
        reach: float,
        footprint_in: Callable[[Camera], Footprint],
    ) -> None:
        """Sample the surface; lengths are in pixels of the reduced image."""
        import cv2

        self.factor, self.reach = factor, reach
        self.samples = int(np.clip(np.ceil(SAMPLED_PX / extent), MIN_SAMPLES, MAX_SAMPLES))
        self.pad = int(np.ceil(reach)) + BAND_PX + 2
        width, height = (max(1, n // factor) for n in camera.size)
        self.shape = height, width
        sampled = _sampled_camera(camera, factor, self.samples, self.pad, (width, height))
        footprint = footprint_in(sampled)
        self.body = np.isin(footprint.mesh, list(numbers))
        surface = np.isfinite(footprint.depth_mm)
        self.other = surface & ~self.body
        y, x = np.mgrid[0 : self.body.shape[0], 0 : self.body.shape[1]]
        # Points and normals of all surfaces, in the world for the light and along the camera's axes for the shading
        every = replace(footprint, mesh=np.where(surface, 0, -1).astype(np.int16))
        self.points_mm = every.points_at(sampled, y, x).astype(np.float32)
        self.normal = footprint.normal
        pose = np.asarray(camera.camera_from_world)[:3, :3].astype(np.float32)
        facing = footprint.normal @ pose.T
        inside = np.flatnonzero(self.body.any(axis=1)), np.flatnonzero(self.body.any(axis=0))
        middle = inside[1].mean(), inside[0].mean()
        half = 0.5 * max(1, int(np.ptp(inside[0])), int(np.ptp(inside[1])))
        place = ((x - middle[0]) / half).astype(np.float32), ((y - middle[1]) / half).astype(np.float32)
        self.shading = _polynomial(facing[..., 0], facing[..., 1], *place)
        self.place = place
        # Pixels by whether they see the body: the band along its outline, and the whole with its surroundings
        covered = _block_mean(self.body, self.samples, self.pad, self.shape)
        self.arc = _arcs(covered)
        self.band = _near_outline(covered)
        disc = _disc(int(np.ceil(reach)) + 1)
        self.around = cv2.dilate((covered > 0).astype(np.uint8), disc) > 0


def surroundings(visible: NDArray[np.bool_], margin_px: int) -> Window:
    """Part of an image that holds a body (H, W) and a margin."""
    rows, columns = (np.flatnonzero(visible.any(axis=axis)) for axis in (1, 0))
    body = Window(int(rows[0]), int(rows[-1]) + 1, int(columns[0]), int(columns[-1]) + 1)
    return body.grown(margin_px, (visible.shape[1], visible.shape[0]))


def _sampled_camera(camera: Camera, factor: int, samples: int, pad: int, size: tuple[int, int]) -> Camera:
    """Camera whose pixels are samples of the reduced image of ``size`` (width, height) and of ``pad`` pixels around."""
    K = np.array(camera.K)
    K[:2] /= factor
    K[:2, 2] += pad
    K[:2] *= samples
    width, height = ((n + 2 * pad) * samples for n in size)
    return camera.model_copy(update={"size": (width, height), "K": tuple(map(tuple, K.tolist()))})


def _polynomial(right: Image, down: Image, x: Image, y: Image) -> Image:
    """Polynomials (H, W, 14) of a normal's components to the right and down and of a place x, y, each (H, W).

    All products of two of one kind are there, and those with the normal's third component, with which the light from
    inside a translucent tooth fades towards the outline.
    """
    towards = np.sqrt(np.clip(1 - right * right - down * down, 0, 1))
    terms = [np.ones_like(right), right, down, x, y, towards, towards * right, towards * down]
    for first, second in ((right, down), (x, y)):
        terms += [first * first, first * second, second * second]
    return np.stack(terms, axis=-1)


def _block_mean(body: NDArray[np.bool_], samples: int, pad: int, shape: tuple[int, int]) -> Image:
    """Covered share (H, W) of each pixel of the reduced image."""
    inner = body[pad * samples : (pad + shape[0]) * samples, pad * samples : (pad + shape[1]) * samples]
    blocks = inner.reshape(shape[0], samples, shape[1], samples)
    return np.asarray(blocks.mean(axis=(1, 3), dtype=np.float32))


def _near_outline(covered: Image) -> NDArray[np.bool_]:
    """Pixels (H, W) at most ``BAND_PX`` inside or outside the outline."""
    import cv2

    disc = _disc(BAND_PX)
    outer = cv2.dilate((covered > 0).astype(np.uint8), disc)
    return np.asarray((outer > 0) & (cv2.erode((covered >= 1).astype(np.uint8), disc) == 0))


def _arcs(covered: Image) -> NDArray[np.intp]:
    """Number (H, W) of the arc of the outline to which a pixel belongs, by its direction from the body's centre."""
    rows, columns = np.nonzero(covered > 0)
    y, x = np.indices(covered.shape)
    turn = np.arctan2(y - rows.mean(), x - columns.mean()) / (2 * np.pi) + 0.5
    return np.asarray(np.minimum((turn * ARCS).astype(np.intp), ARCS - 1))


def _disc(radius: int) -> NDArray[np.uint8]:
    import cv2

    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)), dtype=np.uint8)
