"""Pictures of a fit: previews while it runs, and renders beside photographs for the report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.core.pages.pictures import (
    RESIDUAL_OF_WHITE,
    Picture,
    enlarge,
    png_bytes,
    signed_map,
    tone_map,
    white_level,
)
from services.core.results import PreparedManifest
from services.core.store import write_atomic
from services.fit.measurements.view_stack import ViewStack
from services.fit.passes.evaluate import Evaluation
from services.fit.stages.step_report import StepReport

Array = NDArray[np.float64]
PREVIEWS = "previews"
"""Folder of the previews, in the job's folder."""
MARGIN = 0.1
"""Width of the frame around the pixels that a fit reads, as a share of their extent."""


def shown_images(views: tuple[ViewStack, ...]) -> tuple[tuple[str, int], ...]:
    """Images to show: for each camera the brightest fitted and the brightest held-out image, as camera name and index
    among the lights with a valid pixel.
    """
    valid_lights = np.flatnonzero(np.any([v.valid.any(axis=1) for v in views], axis=0))
    shown = []
    for view in views:
        brightness = np.where(view.valid, view.reference, 0.0).sum(axis=1)[valid_lights]
        for group in (~view.held_out[valid_lights], view.held_out[valid_lights]):
            lit = np.flatnonzero(group & (brightness > 0))
            if len(lit):
                shown.append((view.camera.name, int(lit[np.argmax(brightness[lit])])))
    return tuple(shown)


def pictures_of(
    evaluations: Mapping[str, Evaluation], manifest: PreparedManifest, views: Mapping[str, tuple[ViewStack, ...]]
) -> tuple[Picture, ...]:
    """Pictures from lists of pixels, cropped about these; the last axis is the channel, in the order of
    ``evaluations``.
    """
    # Show a fit of every n-th pixel as a smaller picture and not as separate dots.
    every = min(
        (spacing(pixels) for evaluation in evaluations.values() for pixels, _ in evaluation.renders.values()), default=1
    )
    channels = list(evaluations)
    every_view = [view for own in views.values() for view in own]
    corners = {
        name: _corners([view for view in every_view if view.camera.name == name], every)
        for name in {view.camera.name for view in every_view}
    }
    images: dict[tuple[str, str], Picture] = {}
    for index, channel in enumerate(channels):
        valid_lights = np.flatnonzero(np.any([v.valid.any(axis=1) for v in views[channel]], axis=0))
        by_camera = {v.camera.name: v for v in views[channel]}
        for (camera, light), (pixels, values) in evaluations[channel].renders.items():
            view, number = by_camera[camera], int(valid_lights[light])
            key = (camera, manifest.lights[number].name)
            if key not in images:
                width, height = np.ptp(corners[camera], axis=0)
                blank = np.zeros((height, width, len(channels)))
                images[key] = Picture(
                    *key, bool(view.held_out[number]), blank, blank.copy(), np.zeros((height, width), dtype=bool)
                )
            shown = (view.pixels % every == 0).all(axis=1)
            left, top = corners[camera][0]
            x, y = (view.pixels[shown] // every - (left, top)).T
            images[key].photo[y, x, index] = view.reference[number, shown]
            images[key].valid[y, x] |= view.valid[number, shown]
            images[key].render[pixels[:, 1] // every - top, pixels[:, 0] // every - left, index] = values
    return tuple(images[key] for key in sorted(images))


def _corners(views: Sequence[ViewStack], every: int) -> NDArray[np.int64]:
    # Upper left and lower right corner (2, 2) of one camera's pictures, x and y, in pictures' pixels.
    pixels = np.concatenate([view.pixels for view in views]) // every
    low, high = pixels.min(axis=0), pixels.max(axis=0) + 1
    margin = np.ceil(MARGIN * (high - low)).astype(int)
    size = -(-np.array(views[0].camera.size) // every)
    return np.stack([np.maximum(low - margin, 0), np.minimum(high + margin, size)])


def spacing(pixels: NDArray[np.int32]) -> int:
    """Spacing n of pixels (N, 2) that are every n-th of an image; 1 where there are too few to determine it."""
    steps = [np.diff(np.unique(axis)) for axis in pixels.T]
    return max(int(np.gcd.reduce(np.concatenate(steps))), 1)


def write_preview(
    root: Path, step: StepReport, evaluation: Evaluation, manifest: PreparedManifest, views: tuple[ViewStack, ...]
) -> list[dict[str, object]]:
    """Write render, photograph and residual of up to two images as PNG, one fitted and one held out; return the preview
    events' data, with paths relative to ``root``.
    """
    pictures = pictures_of({step.channel: evaluation}, manifest, {step.channel: views})
    chosen = [p for p in pictures if not p.held_out][:1] + [p for p in pictures if p.held_out][:1]
    (root / PREVIEWS).mkdir(exist_ok=True)
    events = []
    for picture in chosen:
        white = white_level(picture.photo, picture.valid)
        drawn = {
            "render": tone_map(picture.render, white),
            "photo": tone_map(picture.photo, white),
            "residual": signed_map(picture.residual, RESIDUAL_OF_WHITE * white, picture.valid),
        }
        event: dict[str, object] = {
            "camera": picture.camera, "light": picture.light, "held_out": picture.held_out,
            "channel": step.channel, "step": step.step, "residual_limit": RESIDUAL_OF_WHITE * white,
            "residual_of_white": RESIDUAL_OF_WHITE,
        }  # fmt: skip
        for kind, image in drawn.items():
            path = Path(PREVIEWS) / f"{step.channel}-{step.step:03d}-{picture.camera}-{picture.light}-{kind}.png"
            write_atomic(root / path, png_bytes(enlarge(image)))
            event[kind] = path.as_posix()
        events.append(event)
    return events
