"""Errors of the instrument in the fit of one channel, with their covariance.

Photographs follow (1 + gain + light_gain) C + flare, where C is the image that the media give. The derivatives with
respect to the errors are the image itself for the gain, one light's image for a light's gain, and the brightest pixel's
value for a flare; they come from the renders of the residual and cost nothing. (Photographs in place of the renders
would bring in the sensor's noise, which the residuals contain too: that biases a gain by 1e-4, one standard error of a
gain where the tissue is known.)
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from services.core.calibration.uncertainty import TWIST, CalibrationUncertainty

Array = NDArray[np.float64]

DEFAULT_SE: Mapping[str, float] = MappingProxyType({"gain": 0.01, "light_gain": 0.01, "flare": 0.003})
"""Standard error by kind where a calibration states none: relative, relative, and a share of the camera's brightest
valid pixel in that channel. A white standard is certified to about 1 %, lights are compared on it to 1 %, and a lens
shade leaves about 0.3 % of veiling glare."""
_DEGREE = math.radians(1)
DEFAULT_MOVE_SE: Mapping[str, tuple[float, ...]] = MappingProxyType(
    {"teeth": (0.1 * _DEGREE,) * 3 + (0.05,) * 3, "dome": (0.1 * _DEGREE,) * 3 + (2.0,) * 3}
)
"""Standard errors of rotations (rad) and translations (mm) of the scan and of the dome where a calibration states none:
the best that registration reaches, and the precision of a tape measure."""
LINEAR_REACH = 0.1
"""Length scale of an error for the lengths of steps, in its unit; images are exactly linear in all errors but the
scan's pose."""
CURVED_REACH: Mapping[str, float] = MappingProxyType(
    dict.fromkeys((f"teeth.{axis}" for axis in TWIST[:3]), 0.05)
    | dict.fromkeys((f"teeth.{axis}" for axis in TWIST[3:]), 0.25)
)
"""Length scale of each coordinate of the scan's pose, rad and mm, over which images of a tooth are about linear."""

FAULT_Z: Mapping[str, float] = MappingProxyType({"light_gain": 3.0, "flare": 4.0, "shift": 3.0})
"""Kinds of errors that images show to be faults of the calibration, and the number of standard errors from its prior
beyond which such an error is one. One sound light in 370 lies beyond 3 by chance. A flare also takes up light that the
model leaves out, so sound flares lie beyond 3 more often. The gain of all is not among them, because images can hardly
tell it from absorption: freed of its prior it follows other errors, such as the model's own. Of 36 good captures 4 put
it 11 to 15 % too low, with absorption 35 to 65 % too low, and of 7 with a gain 10 % too high none showed it."""
MANY_FAULTS = 3
"""Least number of checked errors far from their prior that show a cause common to them."""
FAULT_SHARE = 1 / 4
"""Least share of them. In fits of a virtual mouth's tooth with another root than the photographed one, or with a dentin
that no blend shape follows, three to six of twelve were far off; with one light 30 mm off, or with errors drawn from
their prior, at most one of eight. Exchanged photographs (four or five of eight) and a scan 1 mm off (two to four) have
such a common cause too."""
MAX_ERROR = 10.0
"""Largest absolute value of an error, in its unit."""


def kind_of_error(name: str) -> str:
    """Kind of an error by its name: ``gain``, ``light_gain``, ``flare``, ``teeth`` or ``shift``."""
    return name.partition(".")[0]


@dataclass(frozen=True)
class InstrumentErrors:
    """Errors of the instrument in one channel, the last coordinates of its fit; their prior is Gaussian about 0."""

    names: tuple[str, ...] = ()
    covariance: tuple[tuple[float, ...], ...] = ()
    assumed: frozenset[str] = frozenset()
    """Names of the errors whose covariance is a default and not the calibration's."""
    weight: float = 1.0
    """Factor by which a fit multiplies the prior, because its renders are noisier than the photographs
    (``solve.elimination``)."""

    @property
    def precision(self) -> Array:
        """Inverse of the covariance, (K, K), without the weight."""
        return np.asarray(np.linalg.inv(self.matrix), dtype=np.float64)

    @property
    def matrix(self) -> Array:
        """The covariance, (K, K)."""
        return np.array(self.covariance, dtype=np.float64).reshape(len(self.names), len(self.names))

    @property
    def se(self) -> Array:
        """Standard errors of the prior, (K,)."""
        return np.sqrt(np.diag(self.matrix))

    @property
    def scale(self) -> Array:
        """Length scale of each error, (K,)."""
        return np.array([CURVED_REACH.get(name, LINEAR_REACH) for name in self.names])

    def curved_length(self, step: Array) -> float:
        """Length of the part of a step (K,) in which images are curved, in its scales."""
        own = zip(self.names, step.tolist(), strict=True)
        return float(np.linalg.norm([size / CURVED_REACH[name] for name, size in own if name in CURVED_REACH]))

    @property
    def bounds(self) -> tuple[tuple[float, float], ...]:
        """Bounds of each error, wide enough to do no more than keep a wild step representable."""
        return ((-MAX_ERROR, MAX_ERROR),) * len(self.names)


NO_ERRORS = InstrumentErrors()


COMMON_KINDS = (("light_gain", "flare"), ("shift",))
"""Kinds of errors of which many far from their prior at once have one cause; the pose of the scan is one thing."""


def have_common_cause(faults: int, names: Sequence[str], kinds: Sequence[str] = COMMON_KINDS[0]) -> bool:
    """Whether so many errors lie far from their prior that they have one cause, in the model or the photographs, and
    are no faults of the calibration.

    Args:
        faults: number of errors that do. names: names of all errors. kinds: kinds of errors that are counted.
    """
    checked = sum(kind_of_error(name) in kinds for name in names)
    return faults >= max(MANY_FAULTS, FAULT_SHARE * checked)


def single_faults(faults: Sequence[int], names: Sequence[str]) -> tuple[int, ...]:
    """Those of some faults, by their index among all errors, that have no cause in common with others."""
    common = set[str]()
    for kinds in COMMON_KINDS:
        if have_common_cause(sum(kind_of_error(names[k]) in kinds for k in faults), names, kinds):
            common.update(kinds)
    return tuple(k for k in faults if kind_of_error(names[k]) not in common)


def gain_name(channel: str) -> str:
    """Name of a channel's gain."""
    return f"gain.{channel}"


def flare_name(camera: str, channel: str) -> str:
    """Name of a camera's flare in a channel."""
    return f"flare.{camera}.{channel}"


def light_names(lights: Sequence[str], channel: str, stated: CalibrationUncertainty | None) -> tuple[str, ...]:
    """Names of the lights' gains: those of the channel where the calibration states a gain for each channel."""
    known = frozenset(() if stated is None else stated.names)
    own = {light: f"light_gain.{light}.{channel}" for light in lights}
    return tuple(own[light] if own[light] in known else f"light_gain.{light}" for light in lights)


def shift_name(camera: str, light: str) -> str:
    """Name of the shift of a photograph, whose coordinates along x and y end in ``.x`` and ``.y``."""
    return f"shift.{camera}.{light}"


def errors_of(
    channel: str,
    lights: Sequence[str],
    cameras: Sequence[str],
    stated: CalibrationUncertainty | None,
    *,
    with_scan: bool = False,
    shifts_px: Mapping[str, float] = MappingProxyType({}),
) -> InstrumentErrors:
    """Errors of a channel under the lights and cameras of its fit.

    Args:
        stated: the calibration's uncertainty; an error that it does not name takes a default, independent of all
            others.
        with_scan: whether the pose of the scan is among them.
        shifts_px: standard error of each photograph's shift, in pixels of the fit, by the shift's name.
    """
    sizes = {
        name: DEFAULT_SE[kind_of_error(name)] for name in (gain_name(channel), *light_names(lights, channel, stated))
    }
    sizes |= {flare_name(camera, channel): DEFAULT_SE["flare"] for camera in cameras}
    if with_scan:
        sizes |= {f"teeth.{axis}": se for axis, se in zip(TWIST, DEFAULT_MOVE_SE["teeth"], strict=True)}
    own_shifts = {f"{name}.{axis}": se for name, se in shifts_px.items() for axis in "xy"}
    names = (*sizes, *own_shifts)
    covariance = np.diag([se**2 for se in (sizes | own_shifts).values()])
    if stated is not None:
        own = [name for name in names if name in stated.names]
        here, there = [names.index(name) for name in own], [stated.names.index(name) for name in own]
        covariance[np.ix_(here, here)] = stated.matrix[np.ix_(there, there)]
    assumed = frozenset(sizes) - frozenset(() if stated is None else stated.names)
    return InstrumentErrors(names, tuple(map(tuple, covariance.tolist())), assumed)
