"""Properties of the job's state machine that hold for every sequence of triggers."""

from __future__ import annotations

import pytest

from services.api.tables import lifecycle
from services.api.tables.lifecycle import TABLE, Instruction, JobState, Trigger, apply
from services.client.errors import JobStateError


def reached() -> list[tuple[JobState, Trigger, lifecycle.Transition]]:
    """All transitions that some sequence of triggers takes. What is next depends on the state alone, so each reachable
    state with each trigger stands for all sequences.
    """
    waiting, known, taken = [JobState.SUBMITTED], {JobState.SUBMITTED}, []
    while waiting:
        state = waiting.pop()
        for trigger in Trigger:
            try:
                transition = apply(state, trigger)
            except JobStateError:
                continue
            taken.append((state, trigger, transition))
            if transition.state not in known:
                known.add(transition.state)
                waiting.append(transition.state)
    return taken


def test_a_launch_always_leads_to_queued_and_only_queued_jobs_start() -> None:
    for state, trigger, transition in reached():
        assert (transition.instruction is Instruction.LAUNCH) == (transition.state is JobState.QUEUED)
        assert (trigger is Trigger.START) == (transition.state is JobState.RUNNING)
        if trigger is Trigger.START:
            assert state is JobState.QUEUED


def test_an_end_is_left_only_by_deletion_or_retry_and_success_never_by_retry() -> None:
    for state, trigger, _ in reached():
        if state.is_final:
            assert trigger in {Trigger.DELETE, Trigger.REVISE if state is JobState.SUCCEEDED else Trigger.RETRY}


def test_what_is_being_deleted_never_comes_back() -> None:
    for state, _, transition in reached():
        if state is JobState.DELETING:
            assert transition == lifecycle.Transition(JobState.DELETING, Instruction.ERASE)


def test_a_cancelled_wish_never_runs_again_by_itself() -> None:
    for state, trigger, transition in reached():
        if state is JobState.CANCELLING:
            assert transition.state.is_final or trigger is Trigger.CANCEL


def test_success_comes_from_work_alone() -> None:
    for state, trigger, transition in reached():
        if transition.state is JobState.SUCCEEDED:
            assert trigger is Trigger.SUCCEED
            assert state is JobState.RUNNING


def test_every_unfinished_state_survives_a_crash_and_every_state_is_reachable() -> None:
    assert {state for state, trigger in TABLE if trigger is Trigger.LOSE} == {
        state for state in JobState if not state.is_final
    }
    assert {state for state, *_ in reached()} == set(JobState)


def test_the_refusal_names_what_the_state_takes() -> None:
    with pytest.raises(JobStateError, match=r"SUCCEEDED does not take 'cancel'; it takes delete"):
        apply(JobState.SUCCEEDED, Trigger.CANCEL)


def test_the_docstring_draws_the_table() -> None:
    header, *rows = [
        line.split("  ") for line in lifecycle.__doc__.splitlines() if line[:1].isupper() and "  " in line
    ] or [[]]
    columns = [Trigger.CANCEL, Trigger.START, Trigger.SUCCEED, Trigger.FAIL, Trigger.LOSE]
    drawn: dict[tuple[str, Trigger], str] = {}
    for row in [header, *rows]:
        state, *cells = [cell.strip() for cell in row if cell.strip()]
        drawn |= {(state, trigger): cell for trigger, cell in zip(columns, cells, strict=True) if cell != "-"}
    told = {
        (state, trigger): transition.state
        + (f", {transition.instruction}" if transition.instruction is not Instruction.NOTHING else "")
        for (state, trigger), transition in TABLE.items()
        if trigger in columns
    }
    assert drawn == told
