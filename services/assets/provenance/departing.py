"""What goes along with files that leave: their provenance, without photographs where that is asked for, and a list of
hashes.
"""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

from services.core.consent import ABSENT, require_allowed
from services.core.errors import CaptureInputError, CorruptStoreError
from services.core.provenance.hash_list import write_hash_list
from services.core.provenance.inputs import stated_by
from services.core.provenance.record import PROVENANCE, Provenance
from services.core.records import JOB_FILE, JobSpec
from services.core.store import read_record, write_record

BESIDE_PHOTOGRAPH = "render_beside_photograph.png"
"""Picture of photographs beside renders, with which the report begins; ``lead_picture`` writes it."""
COLOUR_DIFFERENCES = "colour_differences.json"
"""Differences between that picture's photographs and renders, from which photographs could be computed roughly."""
SHOWS_PERSON = (BESIDE_PHOTOGRAPH, COLOUR_DIFFERENCES)
"""Files of an asset that tell of a photograph."""


def departing(
    job: Path, asset: Path, use: str | None, now: datetime, *, with_photographs: bool = True
) -> Provenance | None:
    """Provenance that goes along with an export; None of an asset that an earlier version wrote.

    The consent is the one that the capture states at present, or else the one that the asset recorded.

    Args:
        job: the job's folder.
        asset: the folder of its asset.
        use: what the export is for; None where that is not said.
        now: the present, with its time zone.

    Raises:
        ConsentError: the person has not agreed to the use, or no longer. CorruptStoreError: the asset's provenance
            cannot be read. CaptureInputError: what the capture says of consent cannot be read.
    """
    try:
        provenance = read_record(asset / PROVENANCE, Provenance) if (asset / PROVENANCE).is_file() else None
    except CaptureInputError as problem:
        raise CorruptStoreError(
            f"{asset / PROVENANCE} cannot be read; write the asset again with dentine export."
        ) from problem
    consent = None if provenance is None else provenance.consent
    if (job / JOB_FILE).is_file():
        stated = stated_by(read_record(job / JOB_FILE, JobSpec).capture)
        consent = consent if stated is None else stated.consent
    require_allowed(consent, use, now)
    if provenance is None:
        return None
    told = provenance.model_copy(
        update={
            "made": now.astimezone(UTC).isoformat(timespec="seconds"),
            "use": use,
            "consent": consent,
            "consent_said": ABSENT if consent is None else consent.sentence,
        }
    )
    return told if with_photographs else told.without_photographs()


def seal(folder: Path, provenance: Provenance | None, exporter: str, *, with_photographs: bool) -> None:
    """Write provenance and list of hashes into an exported folder; without photographs, remove what shows one."""
    if not with_photographs:
        for name in SHOWS_PERSON:
            (folder / name).unlink(missing_ok=True)
    if provenance is not None:
        write_record(folder / PROVENANCE, provenance.model_copy(update={"exporter": exporter}))
    write_hash_list(folder, f"asset-{exporter}")
