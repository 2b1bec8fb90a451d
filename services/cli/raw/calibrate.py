"""``dentine calibrate``: from photographs of boards, spheres and charts to a calibration with its errors."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from services.calibrate.session.run import Session
    from services.core.calibration.record import Calibration

LARGEST_CHANGES = 3
"""Number of changes that are told where none is significant."""


def calibrate_command(
    raw: Annotated[Path, typer.Argument(metavar="RAW", help="Folder with raw.toml and its frames.")],
    out: Annotated[Path, typer.Option(help="Folder of calibration.json, residuals.json and report.html.")],
    valid_days: Annotated[float, typer.Option(min=1, help="For how many days the record says that it holds.")] = 30.0,
    against: Annotated[
        Path | None, typer.Option(help="An earlier calibration.json of this rig: tell what changed.")
    ] = None,
    accept: Annotated[bool, typer.Option("--accept", help="End well though a limit is not kept.")] = False,
) -> None:
    """Calibrate cameras, lights and colours, each with its error; a calibration beyond its limits ends with status
    9.
    """
    from services.calibrate.session.report_page import write_report
    from services.calibrate.session.run import calibrate, write_session
    from services.core.calibration.record import Calibration
    from services.core.store import read_record

    earlier = None if against is None else read_record(against, Calibration)
    session = calibrate(raw, print, valid_days)
    write_session(session, out)
    write_report(session, out)
    _print_limits(session)
    if earlier is not None:
        _print_drift(session, earlier, against)
    print(f"calibration: {out / 'calibration.json'}, report: {out / 'report.html'}")
    if session.judgement.broken and not accept:
        raise typer.Exit(9)


def _print_drift(session: Session, earlier: Calibration, against: Path | None) -> None:
    from services.calibrate.session.drift import changes

    found = changes(earlier, session.record)
    clear = [one for one in found if one.is_clear]
    print(
        f"against {against}: {len(clear)} of {len(found)} quantities changed beyond their errors (lenses, the lights'"
        " distances from their middle, their intensities)"
    )
    for one in clear:
        print(f"  {one.sentence}")
    if not clear:
        print("  The largest changes over their standard errors:")
        for one in found[:LARGEST_CHANGES]:
            print(f"  {one.sentence}")


def _print_limits(session: Session) -> None:
    for limit in session.judgement.limits:
        kept = "" if limit.is_kept else ", beyond its limit"
        print(f"{limit.what}: {limit.value:.3g} {limit.unit} (limit {limit.limit:g}){kept}")
    for sentence in session.judgement.suspicions:
        print(sentence)
    print(session.judgement.advice)
