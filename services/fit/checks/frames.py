"""Whether each photograph is that of its light: each is compared with the renders under all lights of its camera, not
with its own alone.

A photograph that another light's render explains far better than its own was filed under the wrong light, two that
explain each other were exchanged, and one that nothing explains while the others are well explained was taken wrong.
Such frames bend the media, and their share of an average hides them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from services.fit.checks.evaluate import Evaluation, FrameSums
from services.fit.inputs.observations import Observations, ViewStack

Array = NDArray[np.float64]

LOOKED_AT = 0.1
"""Relative error of a photograph above which other lights are tried: below it a neighbour's light is hardly another
picture."""
BETTER = 0.5
"""Another light's error has to be at most this part of its own light's. Lights 10 degrees apart differ by more than
lights that are off by 10 mm."""
EXCHANGED = 0.75
"""Two photographs are exchanged where each is better explained by the other's light, and both together have at most
this part of their error. A fit bends its media towards them, so less is asked than of a single one; by chance two do
not explain each other at all."""
ODD = 0.3
"""Relative error of a photograph that is told where no other light explains it either."""
ODD_RATIO = 5.0
"""And by so many times it has to exceed the median of its camera's: where all are poorly explained, no single one is
odd."""
MIN_FRAMES = 3
"""Photographs that a camera needs for one of them to be odd."""


@dataclass(frozen=True)
class WrongFrame:
    """A photograph that is not what its light makes, or two that are each other's."""

    camera: str
    light: str
    error: float
    """Relative, against its own light's render."""
    other: str = ""
    """The light whose render explains it; '' where none does."""
    exchanged: bool = False
    """Whether that light's photograph is this light's."""


def wrong_frames(camera: str, lights: Sequence[str], sums: FrameSums) -> Iterator[WrongFrame]:
    """The wrong frames of a camera; of two that were exchanged the first.

    Args:
        lights: names (L,).
    """
    errors = sums.errors
    own, told = np.diag(errors), set[int]()
    shown = own[np.isfinite(own)]
    if not len(shown):
        return
    for first, second in combinations(range(len(lights)), 2):
        if {first, second} & told or not _are_exchanged(errors, first, second):
            continue
        told |= {first, second}
        yield WrongFrame(camera, lights[first], float(own[first]), lights[second], exchanged=True)
    looks_like = {
        photo: int(errors[:, photo].argmin())
        for photo in range(len(lights))
        if np.isfinite(own[photo]) and own[photo] > LOOKED_AT and errors[:, photo].min() <= BETTER * own[photo]
    }
    for photo, light in looks_like.items():
        if photo in told:
            continue
        told.add(photo)
        yield WrongFrame(camera, lights[photo], float(own[photo]), lights[light])
    limit = max(ODD, ODD_RATIO * float(np.median(shown)))
    odd = np.flatnonzero(np.isfinite(own) & (own > limit)).tolist() if len(shown) >= MIN_FRAMES else []
    for photo in odd:
        if photo not in told:
            yield WrongFrame(camera, lights[photo], float(own[photo]))


def _are_exchanged(errors: Array, first: int, second: int) -> bool:
    own, others = (errors[first, first], errors[second, second]), (errors[second, first], errors[first, second])
    if not np.isfinite([*own, *others]).all() or np.hypot(*own) <= np.sqrt(2) * LOOKED_AT:
        return False
    return bool(others[0] < own[0] and others[1] < own[1] and np.hypot(*others) <= EXCHANGED * np.hypot(*own))


def photographs_told(
    evaluations: Mapping[str, Evaluation],
    observations: Observations,
    views: Mapping[str, tuple[ViewStack, ...]],
    *,
    is_placed: bool,
) -> list[str]:
    """A sentence for each wrong frame of a fit.

    Args:
        evaluations: by channel, of the final answer, with sums over frames.
        is_placed: whether the mesh lies where the photographs show it; see ``frames_told``.
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
    return frames_told({channel: one.frames for channel, one in evaluations.items()}, lights, is_placed=is_placed)[0]


def frames_told(
    sums: Mapping[str, Mapping[str, FrameSums]], lights: Mapping[str, Sequence[str]], *, is_placed: bool = True
) -> tuple[list[str], tuple[WrongFrame, ...]]:
    """A sentence for each wrong frame, what several cameras show alike told once; and the frames.

    Args:
        sums: by channel and camera.
        lights: names, by channel.
        is_placed: whether the mesh lies where the photographs show it. Renders of a misplaced one are like no
            photograph, so that single ones seem odd or another light's; two that explain each other are exchanged
            there, too.
    """
    found: dict[tuple[str, str, str, bool], tuple[WrongFrame, list[str]]] = {}
    for channel, cameras in sums.items():
        for camera, own in cameras.items():
            for frame in wrong_frames(camera, lights[channel], own):
                if not is_placed and not frame.exchanged:
                    continue
                # Odd ones are told by camera, as what is wrong with one need not be with another.
                key = frame.camera if not frame.other else "", frame.light, frame.other, frame.exchanged
                seen = found.setdefault(key, (frame, []))[1]
                if camera not in seen:
                    seen.append(camera)
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
        " camera's others; look at it, and leave that light out or take it again."
    )
