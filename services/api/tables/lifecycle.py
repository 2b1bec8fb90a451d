"""A job's life as a pure state machine: (state, trigger) -> (state, instruction).

There is no I/O here: the repository stores the state, and its callers carry out the instruction.

==========  =====================  ==================  ==================  =====================  =================
state       cancel                 start               succeed             fail                   lose
==========  =====================  ==================  ==================  =====================  =================
SUBMITTED   CANCELLED              -                   -                   FAILED                 QUEUED, launch
QUEUED      CANCELLED              RUNNING             -                   FAILED                 QUEUED, launch
RUNNING     CANCELLING, stop       -                   SUCCEEDED           FAILED                 QUEUED, launch
CANCELLING  CANCELLING             -                   CANCELLED           FAILED                 CANCELLED
DELETING    -                      -                   -                   -                      DELETING, erase
==========  =====================  ==================  ==================  =====================  =================

Further: SUBMITTED -queue-> QUEUED, launch; CANCELLING -stopped-> CANCELLED; FAILED and CANCELLED -retry-> QUEUED,
launch; SUCCEEDED -revise-> QUEUED, launch, where its masks were changed; RUNNING -pause-> QUEUED, launch; CANCELLING
-pause-> CANCELLED. A job that has ended can be deleted: -delete-> DELETING, erase; so can a job that is DELETING, as
the erasure itself may have been interrupted.

``lose`` says that no process works on the job any more, as after a crash: a job that ran is queued again and resumes
from its published results. ``pause`` says that the job cannot go on for now, for lack of a place, disk, a writable
store or workers. A cancel that was recorded is carried out: a job that ends before it notices it is CANCELLED, and a
retry finds its results published.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from types import MappingProxyType

from services.client.errors import JobStateError


class JobState(StrEnum):
    """Where a job is in its life."""

    SUBMITTED = "SUBMITTED"
    QUEUED = "QUEUED"
    RUNNING = "RUNNING"
    CANCELLING = "CANCELLING"
    CANCELLED = "CANCELLED"
    SUCCEEDED = "SUCCEEDED"
    FAILED = "FAILED"
    DELETING = "DELETING"

    @property
    def is_final(self) -> bool:
        """Whether nothing will happen to the job by itself."""
        return self in {JobState.CANCELLED, JobState.SUCCEEDED, JobState.FAILED}


class Trigger(StrEnum):
    """What can happen to a job."""

    QUEUE = "queue"
    START = "start"
    CANCEL = "cancel"
    STOPPED = "stopped"
    SUCCEED = "succeed"
    FAIL = "fail"
    LOSE = "lose"
    RETRY = "retry"
    REVISE = "revise"
    PAUSE = "pause"
    DELETE = "delete"


class Instruction(StrEnum):
    """What the caller of a transition must do next."""

    NOTHING = "nothing"
    LAUNCH = "launch"
    STOP = "stop"
    ERASE = "erase"


@dataclass(frozen=True)
class Transition:
    """The state that is reached, and the instruction for the caller."""

    state: JobState
    instruction: Instruction = Instruction.NOTHING


_QUEUED = Transition(JobState.QUEUED, Instruction.LAUNCH)
_DELETING = Transition(JobState.DELETING, Instruction.ERASE)

TABLE: Mapping[tuple[JobState, Trigger], Transition] = MappingProxyType(
    {
        (JobState.SUBMITTED, Trigger.QUEUE): _QUEUED,
        (JobState.SUBMITTED, Trigger.CANCEL): Transition(JobState.CANCELLED),
        (JobState.SUBMITTED, Trigger.FAIL): Transition(JobState.FAILED),
        (JobState.SUBMITTED, Trigger.LOSE): _QUEUED,
        (JobState.QUEUED, Trigger.START): Transition(JobState.RUNNING),
        (JobState.QUEUED, Trigger.CANCEL): Transition(JobState.CANCELLED),
        (JobState.QUEUED, Trigger.FAIL): Transition(JobState.FAILED),
        (JobState.QUEUED, Trigger.LOSE): _QUEUED,
        (JobState.RUNNING, Trigger.CANCEL): Transition(JobState.CANCELLING, Instruction.STOP),
        (JobState.RUNNING, Trigger.SUCCEED): Transition(JobState.SUCCEEDED),
        (JobState.RUNNING, Trigger.FAIL): Transition(JobState.FAILED),
        (JobState.RUNNING, Trigger.LOSE): _QUEUED,
        (JobState.RUNNING, Trigger.PAUSE): _QUEUED,
        (JobState.CANCELLING, Trigger.CANCEL): Transition(JobState.CANCELLING),
        (JobState.CANCELLING, Trigger.STOPPED): Transition(JobState.CANCELLED),
        (JobState.CANCELLING, Trigger.SUCCEED): Transition(JobState.CANCELLED),
        (JobState.CANCELLING, Trigger.FAIL): Transition(JobState.FAILED),
        (JobState.CANCELLING, Trigger.LOSE): Transition(JobState.CANCELLED),
        (JobState.CANCELLING, Trigger.PAUSE): Transition(JobState.CANCELLED),
        (JobState.FAILED, Trigger.RETRY): _QUEUED,
        (JobState.CANCELLED, Trigger.RETRY): _QUEUED,
        (JobState.SUCCEEDED, Trigger.REVISE): _QUEUED,
        (JobState.FAILED, Trigger.DELETE): _DELETING,
        (JobState.CANCELLED, Trigger.DELETE): _DELETING,
        (JobState.SUCCEEDED, Trigger.DELETE): _DELETING,
        (JobState.DELETING, Trigger.DELETE): _DELETING,
        (JobState.DELETING, Trigger.LOSE): _DELETING,
    }
)


def apply(state: JobState, trigger: Trigger) -> Transition:
    """Return the transition that a trigger causes.

    Raises:
        JobStateError: the state does not take the trigger.
    """
    try:
        return TABLE[state, trigger]
    except KeyError:
        allowed = ", ".join(sorted(known for at, known in TABLE if at is state)) or "nothing"
        raise JobStateError(f"A job that is {state} does not take '{trigger}'; it takes {allowed}.") from None
