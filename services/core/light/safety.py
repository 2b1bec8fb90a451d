"""What a person states before a dome may light more than the defaults allow: an acknowledgement of faster flashes, and
the assessment of the lights.
"""

from __future__ import annotations

from datetime import datetime, timedelta
from typing import Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, AwareDatetime, BeforeValidator, Field, Strict, StringConstraints
from pydantic_core import PydanticCustomError

from services.core.errors import SettingsError
from services.core.geometry import Record

FREE_FLASHES_PER_S = 3.0
"""Flashes of light in one second that need no acknowledgement: the general limit of broadcasting and web guidelines,
above which flashes can trigger epileptic seizures."""
SHIPPED_LIGHT_LIMIT_S = 10.0
"""Limit of the dose of one light, in level-seconds, that needs no assessment of the lights."""
SHIPPED_TOTAL_LIMIT_S = 100.0
"""The same limit for all lights together."""
VALID_FOR = timedelta(hours=24)
"""Age up to which an acknowledgement holds."""
CLOCK_ERROR = timedelta(minutes=5)
"""Largest difference between the clocks of two computers that is not remarked on."""


def _affirmed(value: Any) -> Any:
    if value is not True:
        raise PydanticCustomError(
            "affirmed", "a faster plan needs this to be true; make it so, or leave 'flashes' out for three a second"
        )
    return value


def _faster(value: float) -> float:
    if value <= FREE_FLASHES_PER_S:
        raise PydanticCustomError(
            "per_s", "up to three flashes a second need no acknowledgement; leave 'flashes' out, or give more"
        )
    return value


def _three_parts(value: str) -> str:
    if len([part for part in value.split(",", 2) if part.strip()]) < 3:
        raise PydanticCustomError(
            "assessment", "an assessment says 'who, when, file'; name the person, the date and the document"
        )
    return value


_Line = Annotated[str, StringConstraints(strip_whitespace=True, min_length=1, pattern=r"^[^\x00-\x1f\x7f]*$")]
Affirmed = Annotated[Literal[True], BeforeValidator(_affirmed)]
"""Something that a person affirms: it is true, or the record is refused."""
Assessment = Annotated[_Line, Field(max_length=500), AfterValidator(_three_parts)]
"""Who assessed the lights of a rig, when, and the file that says so."""
AssessmentOfLights = Annotated[
    Assessment | None,
    Field(
        description=(
            "'who, when, file' of the photobiological assessment (IEC 62471) of these lights; needed for limits above"
            " the defaults"
        )
    ),
]
"""The assessment as an option of a rig and of a server's dome."""
T = TypeVar("T")
DoseOfOneLight = Annotated[
    T, Field(description="most level x on-time of one light; more than the default needs an assessment")
]
"""The limit of the dose of one light, as an option of a rig and of a server's dome, in level-seconds."""
DoseOfAllLights = Annotated[
    T, Field(description="most level x on-time of all lights together; more than the default needs an assessment")
]
"""The same limit for all lights together."""


class FlashAcknowledgement(Record):
    """A person's acknowledgement that a dome may flash more often than three times a second."""

    per_s: Annotated[float, Strict(), AfterValidator(_faster)] = Field(
        le=100, description="most flashes in one second; 3 to 65 can trigger epileptic seizures"
    )
    eye_cover: Affirmed = Field(description="true: the subject's eyes are covered so that no flash is seen")
    epilepsy_asked: Affirmed = Field(
        description="true: the subject, and whoever else can see the dome, was asked about epilepsy and has none"
    )
    by: Annotated[_Line, Field(max_length=80)] = Field(description="name of who asked and covered")
    at: AwareDatetime = Field(description="when, with its time zone; it holds for 24 hours")

    def require_recent(self, now: datetime) -> None:
        """Refuse an acknowledgement that is older than a day, or of the future.

        Raises:
            SettingsError: the acknowledgement does not hold now.
        """
        at = self.at.isoformat()
        if self.at > now + CLOCK_ERROR:
            raise SettingsError(
                f"rig.flashes.at {at} lies in the future, it is {now.isoformat()}; correct the time or the clock."
            )
        if now - self.at > VALID_FOR:
            raise SettingsError(
                f"rig.flashes.at {at} is more than {VALID_FOR / timedelta(hours=1):g} hours ago; ask the subject again"
                " and give the new time."
            )

    def require_newer(self, used: tuple[FlashAcknowledgement, ...]) -> None:
        """Refuse an acknowledgement under which an earlier attempt has flashed, or that is older than such a one.

        Raises:
            SettingsError: this attempt needs an acknowledgement of its own.
        """
        if used and self.at <= (latest := max(one.at for one in used)):
            raise SettingsError(
                f"An earlier attempt has flashed under the acknowledgement of {latest.isoformat()}, and this attempt"
                f" gives {self.at.isoformat()}; ask the subject again and give rig.flashes with the new time, on a"
                " server with dentine retry ID --flashes JOB.toml."
            )

    def __str__(self) -> str:
        """One line for logs."""
        return f"{self.per_s:g} flashes a second, eyes covered and epilepsy asked by {self.by} at {self.at.isoformat()}"


def unassessed(light_limit_s: float, total_limit_s: float, assessment: str | None) -> str | None:
    """Say which limit of dose is above the default without an assessment of the lights; None where none is."""
    if assessment is None:
        for name, limit_s, shipped_s in (
            ("light_exposure_limit_s", light_limit_s, SHIPPED_LIGHT_LIMIT_S),
            ("total_exposure_limit_s", total_limit_s, SHIPPED_TOTAL_LIMIT_S),
        ):
            if limit_s > shipped_s:
                return (
                    f"{name} {limit_s:g} is above the default of {shipped_s:g} level-seconds, which needs a"
                    " photobiological assessment of these lights (IEC 62471); give assessment = 'who, when, file', or a"
                    " lower limit"
                )
    return None
