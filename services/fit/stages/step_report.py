"""Report of one step of a fit, and the names under which it is stored and told."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class StepReport:
    """Report of one step."""

    channel: str
    stage: str
    step: int
    stage_step: int
    loss: float
    """Relative squared error on fitted images, sensor noise included; dimensionless. The loss and the errors are not
    reported below the precision of the step's samples."""
    fit_error: float | None
    held_out_error: float | None
    held_out_se: float | None
    """Monte Carlo standard error of ``held_out_error``."""
    parameters: dict[str, float]
    samples: int
    verdict: str
    tooth: int | None = None
    """FDI number of the tooth, while a jaw's fit treats one tooth alone."""


def message_prefix(channel: str, tooth: int | None) -> str:
    """Start of a fit's messages: the channel, and the tooth while a jaw's fit treats one tooth alone."""
    return channel if tooth is None else f"{channel}, tooth {tooth}"


def history_key(channel: str, step: int) -> str:
    """Key of a step's report in the journal."""
    return f"{channel}/history/{step}"
