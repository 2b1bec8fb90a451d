"""Photographs of an image by an instrument with errors, and their derivatives with respect to these errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from services.fit.measurements.blocks import BlockTask, PixelBlock, read_block
from services.transport.scene.rigid_moves import SCAN, moved_camera, rigid, twist_of

Array = NDArray[np.float64]

MAX_BRIGHTENING = 0.5
"""Largest relative change of an image by the scan's turn under the lights; the formula is one for small turns."""


def block_of(task: BlockTask) -> PixelBlock:
    """The block of a task, as its camera sees the scan where the task's errors put it."""
    return placed(read_block(task.block), dict(task.errors))


def placed(block: PixelBlock, errors: Mapping[str, float]) -> PixelBlock:
    """The block with its camera where it sees an unmoved scan as it sees the scan that these errors move."""
    twist = twist_of(errors)
    if block.motion is None or not twist.any():
        return block
    camera = moved_camera(block.view.camera, rigid(twist, block.motion.centre_mm))
    return replace(block, view=replace(block.view, camera=camera))


def photographed(image: Array, block: PixelBlock, errors: Mapping[str, float]) -> Array:
    """Photographs (L, N) that an instrument with these errors would take of an image (L, N), which shows the scan where
    they put it (``placed``) under lights that do not move with it.
    """
    instrument, motion = block.instrument, block.motion
    if not errors or instrument is None:
        return image
    gains = (
        1
        + errors.get(instrument.gain, 0.0)
        + np.array([errors.get(light, 0.0) for light in instrument.lights])[:, None]
    )
    taken = gains * image
    if motion is not None:
        change = np.tensordot(twist_of(errors), motion.brightening, 1)
        taken = taken * (1 + np.clip(change, -MAX_BRIGHTENING, MAX_BRIGHTENING))
        for row, name in enumerate(instrument.shifts):
            for axis, slope in zip("xy", motion.slopes[:, row], strict=True):
                taken[row] -= errors.get(f"{name}.{axis}", 0.0) * slope
    return np.asarray(taken + errors.get(instrument.flare, 0.0) * instrument.brightest)


def error_derivatives(image: Array, block: PixelBlock, names: Sequence[str]) -> Array:
    """Derivatives (K, L N) of the photographs with respect to each named error: the image for the gain, one light's
    image for a light's gain, the brightest pixel's value everywhere for a flare, and for the scan's pose and for the
    shift of a photograph what ``pose`` says.
    """
    found = np.zeros((len(names), *image.shape))
    instrument, motion = block.instrument, block.motion
    if instrument is None:
        return found.reshape(len(names), image.size)
    index = {name: k for k, name in enumerate(names)}
    if instrument.gain in index:
        found[index[instrument.gain]] = image
    for row, light in enumerate(instrument.lights):
        if light in index:
            found[index[light], row] = image[row]
    if instrument.flare in index:
        found[index[instrument.flare]] = instrument.brightest
    if motion is not None:
        for k, name in enumerate(SCAN):
            if name in index:
                moved = (motion.displacement[k, :, None] * motion.slopes).sum(axis=0)
                found[index[name]] = image * motion.brightening[k] - moved
        for row, shift in enumerate(instrument.shifts):
            for axis, slope in zip("xy", motion.slopes[:, row], strict=True):
                if (name := f"{shift}.{axis}") in index:
                    found[index[name], row] = -slope
    return found.reshape(len(names), image.size)


def slope_noise(block: PixelBlock, names: Sequence[str]) -> tuple[Array, Array]:
    """What the photographs' noise in the slopes adds to the products of these derivatives: to J'WJ and to J'W Sigma WJ,
    (K, K) each.
    """
    added = np.zeros((2, len(names), len(names)))
    instrument, motion = block.instrument, block.motion
    if instrument is None or motion is None:
        return added[0], added[1]
    index = {name: k for k, name in enumerate(names)}
    by_axis = motion.slope_noise * block.variance
    weights = block.fit_weight, block.fit_weight**2 * block.variance
    axes = [k for k, name in enumerate(SCAN) if name in index]
    scan = [index[SCAN[k]] for k in axes]
    for total, weight in zip(added, weights, strict=True):
        for axis, letter in enumerate("xy"):
            amount, moved = weight * by_axis[axis], motion.displacement[axes, axis]
            if scan:
                total[np.ix_(scan, scan)] += (moved * amount.sum(axis=0)) @ moved.T
            for row, shift in enumerate(instrument.shifts):
                if (own := index.get(f"{shift}.{letter}")) is not None:
                    total[own, own] += amount[row].sum()
                    if scan:
                        total[own, scan] += moved @ amount[row]
                        total[scan, own] += moved @ amount[row]
    return added[0], added[1]
