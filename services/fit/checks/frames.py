"""Check that each photograph shows its own light: it is compared with the renders under all lights of its camera.

A photograph that another light's render explains far better than its own was filed under the wrong light. Two
photographs that explain each other were exchanged. A photograph that no render explains, while the others are well
explained, was taken wrongly. Such frames bias the media, and in an average over all frames their error hardly shows.
A photograph is blamed only for what exceeds the renders' noise: with too few samples any render is far off.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from services.fit.measurements.observations import Observations
from services.fit.measurements.view_stack import ViewStack
from services.fit.passes.evaluate import Evaluation, FrameSums

Array = NDArray[np.float64]

TESTED_ERROR = 0.1
"""Relative error of a photograph above which other lights are tried: below it, the renders of neighbouring lights
hardly differ from its own."""
MAX_OTHER_ERROR = 0.5
"""Largest error of another light's render, as a part of the error of the photograph's own light. Renders of lights 10
degrees apart differ by more than those of lights that are misplaced by 10 mm."""
MAX_EXCHANGED_ERROR = 0.75
"""Largest joint error of two exchanged photographs with lights swapped, as a part of their joint error; each has to be
better explained by the other's light. The limit is weaker than for a single photograph, because a fit biases its media
towards exchanged ones; by chance two photographs do not explain each other at all."""
MIN_ODD_ERROR = 0.3
"""Relative error above which a photograph is reported although no other light explains it."""
ODD_RATIO = 5.0
"""Factor by which the error of an odd photograph must exceed the median of its camera's: where all are poorly
explained, no single one is odd."""
MIN_ODD_SHARE = 0.05
"""Least misfit of an odd photograph, as a share of the median photograph of its camera (roots of sums of squares).
Where gums hide a tooth from a light, a hundredth or a thousandth of that reaches it, which a fit hardly knows."""
MIN_FRAMES = 3
"""Least number of photographs of a camera for one of them to be odd."""


@dataclass(frozen=True)
class WrongFrame:
    """A photograph that does not show its light, or two that are exchanged."""

    camera: str
    light: str
    error: float
    """Relative error against the render of the photograph's own light."""
    other: str = ""
    """Light whose render explains the photograph; '' where none does."""
    exchanged: bool = False
    """Whether the photograph of ``other`` in turn shows this light."""


def wrong_frames(camera: str, lights: Sequence[str], sums: FrameSums) -> Iterator[WrongFrame]:
    """Wrong frames of a camera; of two exchanged ones only the first.

    Args:
        camera: name of the camera.
        lights: names of the lights (L,).
        sums: sums over the camera's frames.
    """
    errors = sums.errors
    own, reported = np.diag(errors), set[int]()
    shown = own[np.isfinite(own)]
    if not len(shown):
        return
    for first, second in combinations(range(len(lights)), 2):
        if {first, second} & reported or not _are_exchanged(sums, first, second):
            continue
        reported |= {first, second}
        yield WrongFrame(camera, lights[first], float(own[first]), lights[second], exchanged=True)
    best_lights = {
        photo: int(errors[:, photo].argmin())
        for photo in range(len(lights))
        if np.isfinite(own[photo])
        and own[photo] > TESTED_ERROR
        and errors[:, photo].min() <= MAX_OTHER_ERROR * own[photo]
        and sums.are_apart((photo, photo), (int(errors[:, photo].argmin()), photo))
    }
    for photo, light in best_lights.items():
        if photo in reported:
            continue
        reported.add(photo)
        yield WrongFrame(camera, lights[photo], float(own[photo]), lights[light])
    limit = max(MIN_ODD_ERROR, ODD_RATIO * float(np.median(shown)))
    misfit, signal = np.diag(sums.product), np.diag(sums.signal)
    matters = misfit > MIN_ODD_SHARE**2 * np.median(signal[np.isfinite(own)])
    is_odd = np.isfinite(own) & np.diag(sums.is_above(limit)) & matters
    odd = np.flatnonzero(is_odd).tolist() if len(shown) >= MIN_FRAMES else []
    for photo in odd:
        if photo not in reported:
            yield WrongFrame(camera, lights[photo], float(own[photo]))


def _are_exchanged(sums: FrameSums, first: int, second: int) -> bool:
    errors = sums.errors
    own, others = (errors[first, first], errors[second, second]), (errors[second, first], errors[first, second])
    if not np.isfinite([*own, *others]).all() or np.hypot(*own) <= np.sqrt(2) * TESTED_ERROR:
        return False
    if not all(sums.are_apart((one, one), (other, one)) for one, other in ((first, second), (second, first))):
        return False
    return bool(others[0] < own[0] and others[1] < own[1] and np.hypot(*others) <= MAX_EXCHANGED_ERROR * np.hypot(*own))


def photograph_sentences(
    evaluations: Mapping[str, Evaluation],
    observations: Observations,
    views: Mapping[str, tuple[ViewStack, ...]],
    *,
    is_placed: bool,
) -> list[str]:
    """One sentence for each wrong frame of a fit.

    Args:
        evaluations: by channel, evaluation of the final solution with sums over frames.
        observations: the fit's observations.
        views: by channel, the observed views.
        is_placed: whether the mesh lies where the photographs show it; see ``report_frames``.
    """
    lights = {
        channel: [
            light.name
            for light, is_seen in zip(
                observations.manifest.lights, np.any([view.valid.any(axis=1) for view in own], axis=0), strict=True
            )
            if is_seen
        ]
        for channel, own in views.items()
    }
    return report_frames({channel: one.frames for channel, one in evaluations.items()}, lights, is_placed=is_placed)[0]


def report_frames(
    sums: Mapping[str, Mapping[str, FrameSums]], lights: Mapping[str, Sequence[str]], *, is_placed: bool = True
) -> tuple[list[str], tuple[WrongFrame, ...]]:
    """One sentence for each wrong frame, with one common sentence where several cameras show the same fault; and the
    frames.

    Args:
        sums: sums over frames, by channel and camera.
        lights: names of the lights, by channel.
        is_placed: whether the mesh lies where the photographs show it. Renders of a misplaced mesh resemble no
            photograph, so single photographs can seem odd or to show another light; only exchanged ones are then
            reported, because two that explain each other are reliable.
    """
    found: dict[tuple[str, str, str, bool], tuple[WrongFrame, list[str]]] = {}
    for channel, cameras in sums.items():
        for camera, own in cameras.items():
            for frame in wrong_frames(camera, lights[channel], own):
                if not is_placed and not frame.exchanged:
                    continue
                # Report odd photographs by camera, because a fault in one camera need not occur in another.
                key = frame.camera if not frame.other else "", frame.light, frame.other, frame.exchanged
                cameras_shown = found.setdefault(key, (frame, []))[1]
                if camera not in cameras_shown:
                    cameras_shown.append(camera)
    return [_sentence(frame, cameras) for frame, cameras in found.values()], tuple(frame for frame, _ in found.values())


def _sentence(frame: WrongFrame, cameras: Sequence[str]) -> str:
    where = f"camera {cameras[0]}" if len(cameras) == 1 else f"cameras {', '.join(cameras[:-1])} and {cameras[-1]}"
    if frame.exchanged:
        return (
            f"The photographs of {where} under lights {frame.light} and {frame.other} seem exchanged: each is what the"
            " other light makes; check both lights' cables and the files' names."
        )
    if frame.other:
        return (
            f"The photograph of {where} under light {frame.light} is what light {frame.other} makes; "
            "check that light's cable and the file's name."
        )
    return (
        f"The photograph of {where} under light {frame.light} is {100 * frame.error:.0f} % off, far more than its"
        " camera's others; look at it, and take it again or leave that light out (left_out_lights)."
    )
