"""Changes between two calibrations of one rig, each with its standard error.

Each calibration has a world frame of its own, that of its first board. So only quantities that do not depend on the
world frame are compared: lenses, the lights' distances from their common mean, and their intensities.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.core.calibration.record import Calibration
from services.core.errors import CaptureInputError

Floats = NDArray[np.float64]
CLEAR_SIGMAS = 4.0
"""Size of a change in standard errors beyond which it is significant. Of 400 values that did not change one exceeds
3 σ, but only in one of forty such comparisons does one exceed 4 σ."""


@dataclass(frozen=True)
class Change:
    """Change of one quantity.

    Attributes:
        what: name of the quantity.
        change: new minus old value.
        se: standard error of the change, from both calibrations together.
        unit: unit of change and standard error.
    """

    what: str
    change: float
    se: float
    unit: str

    @property
    def is_clear(self) -> bool:
        """Whether the change is larger than both calibrations' errors explain."""
        return abs(self.change) > CLEAR_SIGMAS * self.se

    @property
    def sentence(self) -> str:
        """A clause that states the change and its standard error."""
        return f"{self.what} changed by {self.change:+.3g} {self.unit} (± {self.se:.2g})"


def changes(old: Calibration, new: Calibration) -> list[Change]:
    """Return the changes of all quantities that both calibrations have with a standard error, the most significant
    first.

    Raises:
        CaptureInputError: the calibrations have different channels.
    """
    if old.channels != new.channels:
        raise CaptureInputError(
            f"The earlier calibration has channels {', '.join(old.channels)} and this one {', '.join(new.channels)}; "
            "compare calibrations of the same channels."
        )
    found = [*_lenses(old, new), *_lights(old, new)]
    return sorted(found, key=lambda one: -abs(one.change) / one.se)


def _lenses(old: Calibration, new: Calibration) -> Iterator[Change]:
    before = {camera.name: camera for camera in old.cameras}
    for camera in new.cameras:
        if camera.name not in before:
            continue
        for key, row, column, unit in (("fx", 0, 0, "%"), ("fy", 1, 1, "%"), ("cx", 0, 2, "px"), ("cy", 1, 2, "px")):
            was, now = before[camera.name].K[row][column], camera.K[row][column]
            change, scale = ((now / was - 1) * 100, 100.0) if unit == "%" else (now - was, 1.0)
            names = [f"camera.{camera.name}.{key}"]
            if (se := _joint_se(old, new, names, names, np.array([scale]), np.array([scale]))) is not None:
                yield Change(f"{key} of camera {camera.name}", change, se, unit)


def _lights(old: Calibration, new: Calibration) -> Iterator[Change]:
    before = {light.name: light for light in old.lights}
    common = [light for light in new.lights if light.name in before]
    places = [
        np.array([light.position_mm for light in lights]) for lights in ([before[c.name] for c in common], common)
    ]
    names = [f"light.{light.name}.{axis}" for light in common for axis in "xyz"]
    for number, light in enumerate(common):
        (was, old_slope), (now, new_slope) = (_from_middle(one, number) for one in places)
        if (se := _joint_se(old, new, names, names, old_slope, new_slope)) is not None:
            yield Change(f"distance of light {light.name} from the lights' middle", now - was, se, "mm")
        for channel, (dim, bright) in enumerate(zip(before[light.name].intensity, light.intensity, strict=True)):
            gain = [f"light_gain.{light.name}.{new.channels[channel]}"]
            percent = np.array([100.0])
            if (se := _joint_se(old, new, gain, gain, percent, percent)) is not None:
                what = f"intensity of light {light.name} in {new.channels[channel]}"
                yield Change(what, 100 * float(np.log(bright / dim)), se, "%")


def _from_middle(places: Floats, number: int) -> tuple[float, Floats]:
    """Return a light's distance in mm from the mean of all lights, and the derivative of this distance with respect to
    the coordinates of all lights (3 L,).
    """
    off = places[number] - places.mean(axis=0)
    distance = float(np.linalg.norm(off))
    towards = off / max(distance, 1e-12)
    share = np.full(len(places), -1 / len(places))
    share[number] += 1
    return distance, np.asarray((share[:, None] * towards).ravel())


def _joint_se(
    old: Calibration,
    new: Calibration,
    old_names: Sequence[str],
    new_names: Sequence[str],
    old_slope: Floats,
    new_slope: Floats,
) -> float | None:
    """Return the standard error of the difference of a quantity between two independent calibrations; None where one of
    them does not state the quantity's uncertainty.

    Args:
        old: earlier calibration.
        new: later calibration.
        old_names: names of the earlier calibration's uncertain values on which the quantity depends.
        new_names: the same of the later calibration.
        old_slope: derivative of the quantity with respect to the earlier values.
        new_slope: derivative of the quantity with respect to the later values.
    """
    total = 0.0
    for calibration, names, slope in ((old, old_names, old_slope), (new, new_names, new_slope)):
        if calibration.uncertainty is None:
            return None
        index = {name: n for n, name in enumerate(calibration.uncertainty.names)}
        if not set(names) <= index.keys():
            return None
        chosen = [index[name] for name in names]
        total += float(slope @ calibration.uncertainty.matrix[np.ix_(chosen, chosen)] @ slope)
    return total**0.5 if total > 0 else None
