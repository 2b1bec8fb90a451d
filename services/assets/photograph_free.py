"""``asset-without-photographs``: an asset and its report with no image of the person, and no hash of one."""

from __future__ import annotations

import shutil
from datetime import UTC, datetime
from pathlib import Path

from services.assets.exporters import write_anew
from services.assets.fitted_job import read_fitted
from services.assets.job_report import write_job_report
from services.assets.provenance.departing import SHOWS_PERSON, departing, seal
from services.core.errors import MissingStageError
from services.core.provenance.record import PROVENANCE
from services.core.records import JOB_FILE, JobSpec
from services.core.results import AssetManifest
from services.core.store import MANIFEST, open_stage, read_record

NAME = "without-photographs"
LEFT_OUT = frozenset({*SHOWS_PERSON, MANIFEST, PROVENANCE})
"""Files of an asset that show a photograph or list the hash of one; provenance and hashes are written anew."""


def export_without_photographs(job: Path, *, use: str | None = None) -> Path:
    """Write a published asset and its report without photographs; return the folder, in place of an earlier one.

    Left out are photographs, residuals and colour differences, from which a photograph could be computed beside a
    render, and the hashes of all files that hold images.

    Args:
        use: what the export is for, as the person's consent names it.

    Raises:
        StoreError: the asset or the fit is absent or damaged. ConsentError: the person has not agreed.
    """
    folder, _ = open_stage(job, "asset", AssetManifest)
    spec = read_record(job / JOB_FILE, JobSpec)
    if spec.kind not in {"tooth", "jaw"}:
        raise MissingStageError(f"The asset in {job} holds no tooth, so it shows no person; hand it out as it is.")
    provenance = departing(job, folder, use, datetime.now(UTC), with_photographs=False)
    fitted = read_fitted(job, spec)

    def fill(place: Path) -> None:
        for source in sorted(path for path in folder.rglob("*") if path.is_file() and path.name not in LEFT_OUT):
            target = place / source.relative_to(folder)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source, target)
        write_job_report(place / "report.html", fitted, folder, provenance, with_photographs=False)
        seal(place, provenance, NAME, with_photographs=False)

    return write_anew(job / f"asset-{NAME}", fill)
