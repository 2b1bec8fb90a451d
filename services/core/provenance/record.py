"""``provenance.json`` of an asset: what its numbers were made from, by what, and for what they may be used."""

from __future__ import annotations

from typing import Any

from pydantic import Field

from services.core.consent import ABSENT, Consent
from services.core.geometry import Record

PROVENANCE = "provenance.json"
"""Name of the file in an asset's folder."""
INPUTS = "inputs.json"
"""Name of the file in the folder of a preparation."""


SUBJECT_FILE = "subject.txt"
"""Name of the file in a job's folder with the label of the person that an upload gave."""


class InputFile(Record):
    """One file that a result was made from."""

    name: str = Field(description="path below the capture's folder, or masks/NAME and calibration/NAME")
    bytes: int
    sha256: str
    is_photograph: bool = Field(description="whether it holds an image, or an outline drawn on one")


class Inputs(Record):
    """What a preparation has read, as it was at that time."""

    files: tuple[InputFile, ...]
    consent: Consent | None = None
    subject: str | None = Field(default=None, description="pseudonymous label of the person")


class Provenance(Record):
    """What an asset comes from."""

    made: str = Field(description="date and time of the export, ISO 8601 in UTC")
    job: str = Field(description="name of the job's folder")
    subject: str | None = Field(description="pseudonymous label of the person; null where none was given")
    source: str = Field(description="name of the capture's folder, or address of the rig")
    versions: dict[str, str] = Field(description="dentine, its numerics, Python, and the packages that compute")
    platform: str = Field(description="system and processor")
    options: dict[str, Any] = Field(description="all options of the job; files by their names alone")
    seeds: dict[str, int]
    inputs: tuple[InputFile, ...] | None = Field(
        description="files that it was made from; null where a preparation of an earlier version did not list them"
    )
    photographs_left_out: int | None = Field(
        default=None, description="number of files with images of the person that are not listed here; null if none is"
    )
    consent: Consent | None = None
    consent_said: str = Field(default=ABSENT, description="the consent in words, or that there is none")
    use: str | None = Field(default=None, description="what this export was made for, as the caller said")
    exporter: str | None = Field(default=None, description="exporter that wrote this folder; null for the asset itself")

    def without_photographs(self) -> Provenance:
        """The same without names and hashes of files that hold images."""
        if self.inputs is None or self.photographs_left_out is not None:
            return self
        kept = tuple(file for file in self.inputs if not file.is_photograph)
        return self.model_copy(update={"inputs": kept, "photographs_left_out": len(self.inputs) - len(kept)})
