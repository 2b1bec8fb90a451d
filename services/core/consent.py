"""What the photographed person has agreed to: ``[consent]`` of ``raw.toml``, ``consent`` of ``capture.json``."""

from __future__ import annotations

from datetime import UTC, date, datetime
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, StringConstraints
from pydantic_core import PydanticCustomError

from services.core.errors import ConsentError
from services.core.geometry import Record

Use = Annotated[
    str, StringConstraints(strip_whitespace=True, min_length=1, max_length=64, pattern=r"^[^\x00-\x1f\x7f]*$")
]
"""What data are used for, in words of the laboratory's own, such as ``research``."""
SUBJECT = r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}"
Subject = Annotated[str, StringConstraints(pattern=f"^{SUBJECT}$")]
"""Pseudonymous label of a person; never a name."""
ABSENT = "No consent is recorded: neither for which uses nor until when the person agreed."
"""Sentence in report and provenance where a capture says nothing of consent."""


def _date_of(value: Any) -> Any:
    # TOML has dates of its own; JSON has texts.
    if isinstance(value, str):
        try:
            return date.fromisoformat(value.strip())
        except ValueError:
            pass
    elif isinstance(value, date) and not isinstance(value, datetime):
        return value
    raise PydanticCustomError(
        "date", "{what} is no date; write year, month and day as in 2027-01-31", {"what": repr(value)[:40]}
    )


class Consent(Record):
    """For which uses and until when a person agreed to the use of the data."""

    uses: tuple[Use, ...] = Field(min_length=1, max_length=100, description="what the data may be used for")
    until: Annotated[date, BeforeValidator(_date_of)] = Field(description="last day on which they may be used, in UTC")

    @property
    def sentence(self) -> str:
        """The consent in words."""
        return f"Consent for {', '.join(self.uses)}, until {self.until.isoformat()}."


def require_allowed(consent: Consent | None, use: str | None, now: datetime) -> None:
    """Refuse an export that the person has not agreed to. Without a recorded consent nothing is refused.

    Args:
        use: what the export is for; None where that is not said, and then the date alone is looked at.
        now: the present, with its time zone.

    Raises:
        ConsentError: the consent has ended, or does not list the use.
    """
    if consent is None:
        return
    if now.astimezone(UTC).date() > consent.until:
        raise ConsentError(
            f"The person's consent ended on {consent.until.isoformat()}; ask for a new one and write its date into the"
            " capture's consent, or delete the data."
        )
    if use is not None and use not in consent.uses:
        raise ConsentError(
            f"The person's consent is for {', '.join(consent.uses)} and not for {use}; ask the person, and add the use"
            " to the capture's consent."
        )
