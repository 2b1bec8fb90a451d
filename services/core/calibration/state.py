"""Whether a calibration may still be used: its age, and the limits that it was held to when it was made."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from typing import Literal

from services.core.calibration.record import Calibration, CalibrationLimit
from services.core.errors import CaptureInputError

CalibrationState = Literal["good", "old", "beyond its limits", "not known"]
SECONDS_A_DAY = 86_400.0


def age_days(made: str | None, now_s: float) -> float | None:
    """Days since a calibration was made; None where it states no valid date.

    Args:
        made: date and time, ISO 8601; without a zone it is taken for UTC.
        now_s: Unix time.
    """
    if made is None:
        return None
    try:
        then = datetime.fromisoformat(made)
    except ValueError:
        return None
    return (now_s - (then if then.tzinfo else then.replace(tzinfo=UTC)).timestamp()) / SECONDS_A_DAY


def state_of(
    made: str | None, valid_days: float | None, broken: tuple[str, ...] | None, now_s: float
) -> CalibrationState:
    """The state of a calibration.

    It is "beyond its limits" rather than "old" where both hold, and "not known" where the calibration states neither
    limits nor how long it is valid.

    Args:
        made, valid_days: fields of the calibration's record.
        broken: limits that the calibration does not keep, in words; None where it states no limits.
        now_s: Unix time.
    """
    age = age_days(made, now_s)
    if broken:
        return "beyond its limits"
    if age is not None and valid_days is not None:
        return "old" if age > valid_days else "good"
    return "good" if broken is not None else "not known"


def broken_limits(calibration: Calibration) -> tuple[str, ...] | None:
    """The limits that a calibration does not keep, in words; None where it states no limits."""
    if calibration.limits is None:
        return None
    return tuple(_in_words(one) for one in calibration.limits if not one.is_kept)


def warning_of_age(calibration: Calibration, name: str, now_s: float) -> str | None:
    """A warning about a calibration that is older than its ``valid_days``; None for any other."""
    age = age_days(calibration.made, now_s)
    if age is None or calibration.valid_days is None or age <= calibration.valid_days:
        return None
    return (
        f"Calibration {name} is {age:.0f} days old and was made to hold for {calibration.valid_days:g}: the rig may"
        " have moved since; calibrate again, and compare the two with dentine calibrate --against."
    )


def require_within_limits(calibration: Calibration, name: str, *, accepted: bool) -> None:
    """Refuse a calibration that does not keep its own limits, unless it is accepted all the same.

    Raises:
        CaptureInputError: a limit is not kept; the message names the first one.
    """
    if (broken := broken_limits(calibration)) and not accepted:
        raise CaptureInputError(refusal(name, broken))


def refusal(name: str, broken: tuple[str, ...]) -> str:
    """The sentence that refuses a calibration beyond its limits."""
    return f"{_beyond(name, broken)}, or accept it with accept_calibration = true."


def warnings_of(calibration: Calibration, name: str, now_s: float) -> tuple[str, ...]:
    """Warnings about a calibration that is used although it is beyond its limits or older than its ``valid_days``."""
    broken = broken_limits(calibration)
    beyond = f"{_beyond(name, broken)}." if broken else None
    return tuple(one for one in (beyond, warning_of_age(calibration, name, now_s)) if one is not None)


def _beyond(name: str, broken: tuple[str, ...]) -> str:
    more = f" (and {len(broken) - 1} more)" if broken[1:] else ""
    return f"Calibration {name} is beyond its limits: {broken[0]}{more}; calibrate again as its report advises"


def _in_words(limit: CalibrationLimit) -> str:
    value = "not known" if limit.value is None or not math.isfinite(limit.value) else f"{limit.value:.3g} {limit.unit}"
    return f"{limit.what} is {value.rstrip()}, and {f'{limit.limit:g} {limit.unit}'.rstrip()} is the limit"
