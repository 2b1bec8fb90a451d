"""Entry points of the fit service: ``run`` fits a prepared capture, ``export`` turns the fit into an asset."""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable
from contextlib import suppress

from services.core.choices import chosen
from services.core.installed import require_packages
from services.core.records import JobSpec
from services.core.results import FitReport, PreparedManifest
from services.core.stage import StageContext, StageEvent
from services.core.store import StageWriter, open_stage
from services.core.verdict import VERDICT, verdict_of

ENGINE = "services.transport.engine:Engine"


PACKAGES = ("drjit", "jinja2", "manifold3d", "mitsuba", "numba", "OpenEXR", "PIL", "rtree", "scipy", "xatlas")
"""Packages of the extra ``fit``, by the names under which they are imported."""


def check() -> None:
    """Import the packages and modules that a fit and its export need, and render one pixel.

    Raises:
        PlatformError: a package is missing, or the renderer does not work.
    """
    from services.transport.platform import import_renderer, require_renderer

    with suppress(ModuleNotFoundError):  # require_packages reports the missing package below
        import_renderer()
    require_packages(PACKAGES, "fit")
    for module in ("services.fit.stages.jaw.driver", "services.transport.engine"):
        importlib.import_module(module)
    require_renderer()


def run(spec: JobSpec, context: StageContext, *, engine: str = ENGINE) -> FitReport:
    """Fit every channel and publish ``fit/``: report, history, task trace, pictures.

    Inside a Dask task the passes run on the cluster and this task holds no slot; elsewhere they run in this process.
    Each step is on disk before the next begins; a new attempt continues after the last recorded step.

    Args:
        spec: the job.
        context: folder, progress and cancellation of the job.
        engine: rendering engine, as ``module:class``.

    Raises:
        CaptureInputError, SettingsError, StoreError: the prepared capture cannot be fitted as the job asks.
        JobCancelledError: the job was cancelled; raised between two steps.
    """
    from services.fit.stages.attempt import Attempt
    from services.fit.stages.jaw.driver import JawDriver
    from services.fit.stages.object_driver import ObjectDriver
    from services.fit.stages.tooth.driver import FitDriver

    context.report(StageEvent(stage="fit", kind="started"))
    context.raise_if_cancelled()
    writer = StageWriter(context.root, "fit", context.attempt)
    attempt = Attempt(spec, context, writer, engine)
    kinds: dict[str, Callable[[Attempt], FitDriver | JawDriver | ObjectDriver]] = {
        "tooth": FitDriver,
        "jaw": JawDriver,
        "object": ObjectDriver,
    }
    driver = chosen("Kind of fit", spec.kind, kinds)(attempt)
    notes = open_stage(context.root, "prepared", PreparedManifest, verify=False)[1].notes
    report = driver.run(time.time())
    if report.surface is not None and report.surface.highlights is not None:
        notes += report.surface.highlights.warnings
    report = report.model_copy(update={"notes": notes, "seconds_by_purpose": attempt.seconds_by_purpose})
    writer.publish(report)
    verdict = verdict_of(report)
    context.report(
        StageEvent(
            stage="fit",
            kind="finished",
            done=1.0,
            message=verdict.headline,
            data={VERDICT: verdict.model_dump(mode="json")},
        )
    )
    return report
