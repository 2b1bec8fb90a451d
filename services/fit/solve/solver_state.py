"""State of Gauss-Newton between steps, and its record in a job's journal."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.fit.solve.normal_equations import NormalEquations
from services.fit.solve.outcome import Result

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Proposal:
    """A step that is tested where it ends."""

    step: Array
    """Change (F,) of all coordinates."""
    length: float
    """Its length for the tissue, in scales."""
    change: float
    """Predicted change of F, without what noise alone predicts."""
    change_se: float

    def record(self) -> dict[str, Any]:
        """The proposal as JSON values."""
        return {f.name: getattr(self, f.name) for f in fields(self)} | {"step": self.step.tolist()}

    @staticmethod
    def of(record: dict[str, Any]) -> Proposal:
        """The proposal of a record."""
        return Proposal(**(record | {"step": np.array(record["step"], dtype=np.float64)}))


@dataclass(frozen=True)
class State:
    """State of the solver between steps."""

    x: Array
    samples: int
    radius: float = 1.0
    step: int = 0
    accepted: int = 0
    result: Result = Result.RUNNING
    memory: NormalEquations | None = None
    """Pooled normal equations of earlier steps, carried to x."""
    memory_samples: float = 0.0
    loss: tuple[float, float] | None = None
    """The data's loss at x and its Monte Carlo variance; None where no render told it."""
    proposal: Proposal | None = None
    """The step from x that the next linearisation tests."""
    refusals: int = 0
    """Number of proposals that were refused since the equations were rendered."""
    verdict: str = ""
    """Outcome of the last step, for the log."""


def state_record(state: State) -> dict[str, Any]:
    """A state as JSON values; floats survive exactly."""
    memory = None if state.memory is None else state.memory.record()
    proposal = None if state.proposal is None else state.proposal.record()
    return {f.name: getattr(state, f.name) for f in fields(State)} | {
        "x": state.x.tolist(),
        "memory": memory,
        "loss": None if state.loss is None else list(state.loss),
        "proposal": proposal,
    }


def state_from(record: dict[str, Any]) -> State:
    """The state of a record."""
    loss = None if record["loss"] is None else (record["loss"][0], record["loss"][1])
    return State(
        **(
            record
            | {
                "x": np.array(record["x"]),
                "result": Result(record["result"]),
                "memory": None if record["memory"] is None else NormalEquations.of(record["memory"]),
                "loss": loss,
                "proposal": None if record["proposal"] is None else Proposal.of(record["proposal"]),
            }
        )
    )
