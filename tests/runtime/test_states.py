import itertools

import pytest

from disco_hw.runtime import PROBLEM, TRANSITIONS, Condition, State, next_transition

C = Condition
PROBLEMS = {name: bit for name, bit in vars(C).items() if isinstance(bit, int) and bit & PROBLEM}


def bits(conditions):
    return [1 << place for place in range(conditions.bit_length()) if conditions >> place & 1]


ROWS = [(row, source) for row in TRANSITIONS for source in sorted(row.sources, key=lambda state: state.value)]
# A healthy connection in which no other row of the same source fires, so that one row can be looked at alone.
QUIET = {
    State.DISCONNECTED: C.NONE,
    State.HANDSHAKE: C.LINK_UP | C.TELEMETRY_FRESH,
    State.READY: C.LINK_UP | C.ROBOT_TALKS | C.ROBOT_IDLE | C.TELEMETRY_FRESH | C.WHEELS_STATIONARY,
    State.ARMED: C.LINK_UP | C.ROBOT_TALKS | C.ROBOT_ARMED | C.ROBOT_MAY_MOVE | C.TELEMETRY_FRESH,
    State.STOPPING: C.LINK_UP | C.ROBOT_TALKS | C.ROBOT_MAY_MOVE | C.TELEMETRY_FRESH,
    State.FAULT: C.LINK_UP | C.ROBOT_TALKS | C.ROBOT_IDLE | C.TELEMETRY_FRESH | C.WHEELS_STATIONARY,
}


def identify(row, source):
    return f"{source.value}-to-{row.target.value}-{row.reason.replace(' ', '_')}"


@pytest.mark.parametrize("state", State, ids=lambda state: state.value)
def test_nothing_happens_while_nothing_changes(state):
    assert next_transition(state, QUIET[state]) is None


@pytest.mark.parametrize(("row", "source"), ROWS, ids=itertools.starmap(identify, ROWS))
def test_each_row_fires_when_its_conditions_hold_and_not_when_one_is_missing_or_one_blocks(row, source):
    conditions = (QUIET[source] | row.needs) & ~row.blocked_by
    assert next_transition(source, conditions) is row
    for needed in bits(row.needs & ~QUIET[source]):
        assert next_transition(source, conditions & ~needed) is not row
    for blocker in bits(row.blocked_by):
        assert next_transition(source, conditions | blocker) is not row


@pytest.mark.parametrize("problem", PROBLEMS.values(), ids=PROBLEMS)
@pytest.mark.parametrize("source", [State.HANDSHAKE, State.READY, State.ARMED, State.STOPPING])
def test_every_problem_leads_to_fault_whatever_else_is_asked(source, problem):
    all_requests = C.ARM_PENDING | C.RESET_PENDING | C.DISARM_REQUESTED
    row = next_transition(source, QUIET[source] | all_requests | problem)
    assert row is not None
    assert row.target is State.FAULT


@pytest.mark.parametrize("problem", PROBLEMS.values(), ids=PROBLEMS)
def test_no_reset_while_a_problem_lasts(problem):
    assert next_transition(State.FAULT, QUIET[State.FAULT] | C.RESET_PENDING | problem) is None


def test_armed_can_be_entered_from_ready_only_and_only_on_request():
    ways = [row for row in TRANSITIONS if row.target is State.ARMED]
    assert [row.sources for row in ways] == [frozenset({State.READY})]
    assert all(C.ARM_PENDING & row.needs for row in ways)


def test_fault_is_left_by_a_reset_or_a_lost_link_only():
    for row in TRANSITIONS:
        if State.FAULT in row.sources:
            assert row.target is State.DISCONNECTED or C.RESET_PENDING & row.needs
