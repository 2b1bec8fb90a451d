"""The counts at which the pixels of a camera's frames end, where that is below the largest one of their bits."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from services.core.raw.frames import read_frame
from services.core.raw.records import DARK, RawCamera, RawFolder

FRAMES_READ = 8
"""Largest number of a camera's brightest frames of one gain that are read to find its end."""


def ends_of(root: Path, folder: RawFolder, camera: RawCamera) -> dict[float, tuple[float, ...]]:
    """For each gain at which the brightest frames end below the largest count of their bits, the counts at which they
    do; one number for each of the mosaic's four pixels or for each channel.

    All frames of a camera and gain end at the same count, so those that show it tell it for the others.
    """
    stated = np.inf if camera.full_counts is None else camera.full_counts
    by_gain = defaultdict(list)
    for frame in folder.frame:
        if frame.camera == camera.name and frame.kind not in DARK:
            by_gain[frame.gain].append(frame)
    ends = {}
    for gain, frames in by_gain.items():
        frames.sort(key=lambda one: -one.exposure_s * one.level)
        read = [read_frame(root, folder, one).fullness.counts for one in frames[:FRAMES_READ]]
        least = tuple(float(one) for one in np.min(read, axis=0))
        if min(least) < stated:
            ends[gain] = least
    return ends


def end_notes(folder: RawFolder, camera: RawCamera, ends: Mapping[float, tuple[float, ...]]) -> Iterator[str]:
    """Yield one sentence for each gain at which a camera's pixels end early."""
    names = list(camera.mosaic if camera.mosaic != "none" else folder.channels)
    stated = np.inf if camera.full_counts is None else camera.full_counts
    held = "" if np.isinf(stated) else f", below the {stated:g} that may be expected"
    for gain, counts in ends.items():
        found = dict.fromkeys(f"{one:g} ({name})" for name, one in zip(names, counts, strict=True) if one < stated)
        at = "" if gain == 1 else f" at gain {gain:g}"
        yield (
            f"Camera {camera.name}: its pixels end at {', '.join(found)} counts{at}{held}, so they are taken for full"
            " from there on; saturation_counts in raw.toml says so for all of its frames."
        )
