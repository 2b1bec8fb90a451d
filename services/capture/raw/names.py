"""Interpretation of a photograph's file name: camera, kind or light, exposure and gain.

The words of a path are separated by slashes, underscores and blanks. The first word without another meaning is the
camera, the second one the light, to whose name a wavelength such as 450nm is added; numbers that follow count
repetitions, and all other words are listed as unused::

    left_L07_0.05s.tif    left/black_50ms_2.png    right_tracking_003_1-20s.dng    left_flat_0.1s_gain4.npy
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from pathlib import PurePosixPath
from types import MappingProxyType

from services.core.raw.records import LIT_BY_ONE, FrameKind

KINDS: Mapping[str, FrameKind] = MappingProxyType(
    {
        "black": "black",
        "dark": "black",
        "tracking": "tracking",
        "all": "tracking",
        "allon": "tracking",
        "flat": "flat",
        "darkroom": "dark-room",
        "dark-room": "dark-room",
        "ambient": "dark-room",
        "board": "board",
        "charuco": "board",
        "chessboard": "board",
        "mirror": "mirror-sphere",
        "mirror-sphere": "mirror-sphere",
        "white": "white-sphere",
        "white-sphere": "white-sphere",
        "chart": "chart",
        "colorchecker": "chart",
    }
)
"""Words that laboratories use for the kinds of photographs; a number may follow the word."""
PLACED: frozenset[FrameKind] = frozenset({"board", "mirror-sphere", "white-sphere"})
"""Kinds of photographs of a target that is moved from place to place."""
_SECONDS = re.compile(r"(?:(\d+)-(\d+)|(\d+(?:\.\d+)?))(s|ms|us)")
_GAIN = re.compile(r"gain(\d+(?:\.\d+)?)")
_BAND = re.compile(r"\d{3,4}nm")
"""A wavelength: photographs of one lamp through other filters are lit by other light."""
_NUMBER = re.compile(r"\d+")
_DECIMAL = re.compile(r"\d*\.\d+")
_MEANINGLESS = re.compile(
    r"(?:19|20)\d{6}(?:[t-]?\d{4,6})?|(?:19|20)\d\d-\d\d-\d\d|\d\d-\d\d-\d\d|iso-?\d+|f\d+(?:\.\d+)?|\d+mm"
)
"""Dates, times of day, and what cameras write into names: sensitivities, apertures and focal lengths."""
_NUMBERED = frozenset({"cam", "camera", "light", "led", "lamp", "l", "c", "source"})
"""Words to whose names the number that follows belongs: cam 1 is another camera than cam 2."""
_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6}


@dataclass(frozen=True)
class NamedFrame:
    """A photograph as its name describes it; a value that the name does not give is None, and the gain 1."""

    file: str
    camera: str
    kind: FrameKind
    light: str | None
    exposure_s: float | None
    gain: float
    place: str | None = None
    """Place of a board or sphere: the word and number in the name."""
    unused: tuple[str, ...] = ()
    """Words of the name that have no meaning here."""


def named_frame(file: str, ignored: AbstractSet[str] = frozenset()) -> NamedFrame | str:
    """Interpret a file name; if it lacks something, return a part of a sentence that says what.

    Args:
        ignored: words, in lower case, that are left out.
    """
    pure = PurePosixPath(file)
    parts = [part for whole in (*pure.parent.parts, pure.stem) for part in re.split(r"[_ ]+", whole) if part]
    parts = [part for part in parts if part.lower() not in ignored]
    exposure_s, gain, kind, place, band = None, 1.0, None, None, None
    words, unused = list[str](), list[str]()
    for before, part in zip(["", *parts], parts, strict=False):
        word = part.lower()
        if _MEANINGLESS.fullmatch(word) is not None:
            unused.append(part)
        elif (seconds := _SECONDS.fullmatch(word)) is not None:
            over, under, whole, unit = seconds.groups()
            exposure_s = (float(over) / float(under) if over else float(whole)) * _UNITS[unit]
        elif (stated_gain := _GAIN.fullmatch(word)) is not None:
            gain = float(stated_gain[1])
        elif _BAND.fullmatch(word) is not None and band is None:
            band = part
        elif _DECIMAL.fullmatch(word) is not None:
            return f"says {part} without a unit, such as {part}s"
        elif (found := KINDS.get(word.rstrip("0123456789").rstrip("-"))) is not None and kind is None:
            kind, place = found, word
        elif _NUMBER.fullmatch(word) is not None and place is not None and not place[-1].isdigit():
            place += word
        elif _NUMBER.fullmatch(word) is None or not words:
            words.append(part)
        elif before == words[-1] and before.lower() in _NUMBERED:
            words[-1] += part
        elif before == words[-1] and kind is None and not any(letter.isdigit() for letter in before):
            unused.append(part)  # it may count lights or repetitions
    if not words:
        return "does not name its camera"
    light = "-".join(part for part in (*words[1:2], band) if part is not None) or None
    kind = kind or ("light" if light is not None else None)
    if kind is None:
        return f"names camera {words[0]}, and neither a light nor a kind such as black, flat or tracking"
    if kind in LIT_BY_ONE and light is None:
        return f"is of kind {kind} and does not name its light"
    takes_light = kind in LIT_BY_ONE or kind in {"flat", "board", "chart"}
    unused += words[2 if takes_light else 1 :]
    light, place = light if takes_light else None, place if kind in PLACED else None
    return NamedFrame(file, words[0], kind, light, exposure_s, gain, place, tuple(unused))
