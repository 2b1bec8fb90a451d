"""``dentine shade``: the colour of a job's teeth against a guide that the laboratory measured itself."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from services.cli.arguments import Json

SHOWN = 3
"""Number of tabs that are printed for each tooth; all are in shade.json and in the report."""


def shade(
    job: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a job that has exported its asset.")],
    guide: Annotated[Path, typer.Argument(help="CSV with the guide's tabs: tab, geometry, L, a, b or a spectrum.")],
    as_json: Json = False,
) -> None:
    """Compare the colour of a job's teeth with the tabs of a laboratory's own guide; the report then shows it.

    Not for choosing or making restorations.
    """
    from services.assets.appearance.guide import read_guide
    from services.assets.appearance.shade import shade_of, write_shade
    from services.core.results import AssetManifest
    from services.core.store import open_stage

    tabs = read_guide(guide)
    folder, _ = open_stage(job, "asset", AssetManifest)
    found = shade_of(folder, tabs)
    write_shade(job, found)
    _write_report_again(job, folder)
    if as_json:
        print(found.model_dump_json())
        return
    for tooth in found.teeth:
        nearest = ", ".join(f"{one.tab} {one.delta_e_2000:.1f} ± {one.se:.1f}" for one in tooth.tabs[:SHOWN])
        print(f"tooth {tooth.fdi}: ΔE00 {nearest} ({found.geometry}, {found.illuminant})")
    print("\n".join(found.sentences))


def _write_report_again(job: Path, asset: Path) -> None:
    from services.assets.fitted_job import read_fitted
    from services.assets.job_report import write_job_report
    from services.core.provenance.record import PROVENANCE, Provenance
    from services.core.records import JOB_FILE, JobSpec
    from services.core.store import read_record

    path = asset / PROVENANCE
    provenance = read_record(path, Provenance) if path.is_file() else None
    fitted = read_fitted(job, read_record(job / JOB_FILE, JobSpec))
    write_job_report(job / "report.html", fitted, asset, provenance)
