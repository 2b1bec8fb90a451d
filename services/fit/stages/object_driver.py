"""Fit of an object that is no tooth: that of a tooth whose enamel is its body, with a known core or without dentin."""

from __future__ import annotations

from dataclasses import dataclass, replace

from services.core.pages.object_words import of_an_object, part_of_a_tooth, renamed
from services.core.results import FitReport, PreparedManifest
from services.core.store import open_stage
from services.fit.stages.attempt import Attempt
from services.fit.stages.tooth.driver import FitDriver


@dataclass
class ObjectDriver:
    """One attempt at the fit of an object."""

    attempt: Attempt

    def run(self, started_s: float) -> FitReport:
        """Fit all channels, write files into the stage's folder and return the report, in words about an object."""
        spec = self.attempt.spec
        has_core = bool(open_stage(self.attempt.context.root, "prepared", PreparedManifest)[1].dentin_known)
        options = {
            "dentin": "known" if has_core else "none",
            "held": {part_of_a_tooth(name): value for name, value in spec.held.items()},
        }
        attempt = replace(self.attempt, spec=spec.model_copy(update=options), names=renamed)
        return told_of_an_object(FitDriver(attempt).run(started_s))


def told_of_an_object(report: FitReport) -> FitReport:
    """The report of a tooth's fit with the names of an object's parts."""
    correlations = {
        channel: one.model_copy(update={"names": tuple(renamed(dict.fromkeys(one.names)))})
        for channel, one in report.correlations.items()
    }
    return report.model_copy(
        update={
            "parameters": {channel: renamed(table) for channel, table in report.parameters.items()},
            "correlations": correlations,
            "enamel_thickness": None,
            "advice": of_an_object(report.advice),
            "told": of_an_object(report.told),
            "next_capture": of_an_object(report.next_capture),
            "instrument_told": tuple(map(of_an_object, report.instrument_told)),
        }
    )
