"""One scenario for each row of the table, on the running core, and the table's own properties."""

import dataclasses

import pytest

from firmware_protocol import _firmware
from tests.firmware_protocol.bench import CODEC, CONFIG, Bench, transitions

ffi, lib = _firmware.ffi, _firmware.lib
STATES = CODEC.choices("SYSTEM_STATE", "state")
ALL_BUT_BOOT_AND_ESTOP = ("STANDBY", "READY", "ARMED", "STOPPING", "FAULT")


def latched_fault(bench):
    bench.inputs["right_current_a"] = -100.0
    bench.run(110)


def reset_fault(bench):
    bench.inputs.clear()
    assert bench.set_request("STANDBY").run(300).state == "FAULT"
    bench.set_request("RESET").run(60)


def reset_estop(bench):
    assert bench.set_request("STANDBY").run(700).state == "ESTOP"
    bench.set_request("RESET").run(60)


def armed(bench):
    bench.set_request("ARM")
    bench.command = {}
    bench.run_until("ARMED")


def passing_fault(bench):
    bench.inputs["voltage_v"] = 10.0
    bench.run_until("STOPPING")


def bad_commands(bench):
    for _ in range(5):
        bench.core.receive(bench.now_us, 0x100, bytes(8))
    bench.step()


def expired_command(bench):
    bench.command = None
    bench.wheel_command(4.0, 2.0, valid_for=0.03)
    bench.run_until("STOPPING", within_ms=31)


def silent_commands(bench):
    bench.command = None
    bench.run_until("STOPPING", within_ms=101)


def silent_host(bench):
    bench.request = None
    bench.command = {"left": 4.0, "right": 2.0, "session": 7}
    bench.run_until("STOPPING", within_ms=560)


def changed_session(bench):
    bench.set_request("ARM", session=8)
    bench.command = {"left": 4.0, "right": 2.0, "session": 7}
    bench.run_until("STOPPING", within_ms=60)


def requests(within_ms, request, to, **changes):
    """The scenario of a request that ends in a state in time."""
    return lambda bench: bench.set_request(request, **changes).run_until(to, within_ms=within_ms)


SCENARIOS = {
    (ALL_BUT_BOOT_AND_ESTOP, "ESTOP", "ESTOP"): Bench.estop,
    (("BOOT", "STANDBY", "READY", "ARMED", "STOPPING"), "FAULT", "FAULT"): latched_fault,
    (("BOOT",), "STANDBY", "NONE"): lambda bench: None,
    (("FAULT",), "STANDBY", "NONE"): reset_fault,
    (("ESTOP",), "STANDBY", "NONE"): reset_estop,
    (("READY",), "STANDBY", "NONE"): requests(60, "STANDBY", "STANDBY"),
    (("STANDBY",), "READY", "NONE"): Bench.to_ready,
    (("READY",), "ARMED", "NONE"): armed,
    (("ARMED",), "STOPPING", "FAULT"): passing_fault,
    (("ARMED",), "STOPPING", "E2E_DISQUALIFIED"): bad_commands,
    (("ARMED",), "STOPPING", "COMMAND_EXPIRED"): expired_command,
    (("ARMED",), "STOPPING", "COMMAND_TIMEOUT"): silent_commands,
    (("ARMED",), "STOPPING", "HOST_FAULT"): requests(60, "ARM", "STOPPING", host_fault=3),
    (("ARMED",), "STOPPING", "HOST_SILENT"): silent_host,
    (("ARMED",), "STOPPING", "SESSION_CHANGED"): changed_session,
    (("ARMED",), "STOPPING", "REQUESTED"): requests(60, "STANDBY", "STOPPING"),
    (("STOPPING",), "STANDBY", "NONE"): lambda bench: bench.run_until("STANDBY", within_ms=300),
}
CASES = [(row, state) for row in SCENARIOS for state in row[0]]


def test_every_row_of_the_table_has_a_scenario():
    assert transitions() == list(SCENARIOS)


@pytest.mark.parametrize(("row", "state"), CASES, ids=[f"{state}-{row[1]}-{row[2]}" for row, state in CASES])
def test_row(row, state):
    _, to, cause = row
    if (state, to) == ("BOOT", "FAULT"):
        bench = Bench(dataclasses.replace(CONFIG, ticks_per_rev=0))
    else:
        # A bench has made its first cycle, which takes the core out of BOOT.
        bench = Bench.in_state("STANDBY" if state == "BOOT" else state)
        SCENARIOS[row](bench)
    assert bench.out.state == to
    if state == "ARMED":
        assert bench.out.stop_cause == cause


def test_the_cause_of_a_stop_is_shown_until_the_next_arming_whatever_comes_in_between():
    bench = Bench.in_state("STOPPING")
    assert (bench.estop().state, bench.out.stop_cause) == ("ESTOP", "REQUESTED")
    bench = Bench.driving()
    bench.command = None
    bench.run_until("STANDBY")
    bench.to_ready(session=8)
    assert bench.out.stop_cause == "COMMAND_TIMEOUT"
    bench.to_armed(session=8)
    assert bench.out.stop_cause == "NONE"


def condition(name: str) -> int:
    return int(getattr(lib, f"DISCO_WHEN_{name}"))


def next_state(state: str, conditions: int) -> str:
    code = next(value for value, name in STATES.items() if name == state)
    row = lib.disco_next_transition(code, conditions)
    return state if row == ffi.NULL else STATES[row.to]


MAY_READY = ("HOST_ACCEPTED", "HOST_QUALIFIED", "REQUEST_READY", "SESSION_FRESH", "WHEELS_STILL")
MAY_ARM = ("HOST_ACCEPTED", "HOST_QUALIFIED", "REQUEST_ARM", "CHALLENGE_ANSWERED", "ZERO_COMMANDS", "WHEELS_STILL")
NO_MOTION = ("FAULT", "ESTOP_INPUT", "HOST_FAULT")


STOPS = [
    *((state, "ESTOP_LATCHED", "ESTOP") for state in ALL_BUT_BOOT_AND_ESTOP),
    *((state, "FAULT_LATCHED", "FAULT") for state in ("BOOT", "STANDBY", "READY", "ARMED", "STOPPING")),
    *(
        ("ARMED", name, "STOPPING")
        for name in ("FAULT", "COMMANDS_DISQUALIFIED", "HOST_DISQUALIFIED", "COMMAND_EXPIRED", "COMMAND_TIMEOUT")
    ),
    *(("ARMED", name, "STOPPING") for name in ("HOST_FAULT", "HOST_SILENT", "SESSION_CHANGED", "REQUEST_STOP")),
    ("STOPPING", "STOPPED", "STANDBY"),
    ("STOPPING", "STOP_TIMEOUT", "STANDBY"),
]


@pytest.mark.parametrize(("state", "name", "to"), [("BOOT", "SELF_TEST_PASSED", "STANDBY"), *STOPS])
def test_to_leave_boot_and_to_stop_needs_nothing_but_its_reason(state, name, to):
    assert next_state(state, condition(name)) == to
    assert next_state(state, 0) == state


@pytest.mark.parametrize(("state", "to", "needs"), [("STANDBY", "READY", MAY_READY), ("READY", "ARMED", MAY_ARM)])
def test_motion_needs_every_proof(state, to, needs):
    complete = sum(condition(name) for name in needs)
    assert next_state(state, complete) == to
    for name in needs:
        assert next_state(state, complete & ~condition(name)) == state, name
    for name in NO_MOTION:
        assert next_state(state, complete | condition(name)) != to, name


@pytest.mark.parametrize(
    ("condition_name", "state"),
    [
        ("COMMANDS_DISQUALIFIED", "READY"),
        *(
            (name, "STANDBY")
            for name in ("REQUEST_STOP", "HOST_SILENT", "HOST_DISQUALIFIED", "SESSION_CHANGED", *NO_MOTION)
        ),
    ],
)
def test_commands_that_no_longer_qualify_prevent_arming_and_any_other_doubt_gives_up_ready(condition_name, state):
    complete = sum(condition(name) for name in MAY_ARM)
    assert next_state("READY", complete | condition(condition_name)) == state


@pytest.mark.parametrize(
    ("state", "needs", "hindered_by"),
    [
        ("ESTOP", ("RESET", "HOST_QUALIFIED", "NO_MOTION_ASKED", "WHEELS_STILL"), "ESTOP_INPUT"),
        ("FAULT", ("RESET", "HOST_QUALIFIED"), "FAULT_LATCHED"),
    ],
)
def test_estop_and_fault_are_left_only_with_every_proof(state, needs, hindered_by):
    complete = sum(condition(name) for name in needs)
    assert next_state(state, complete) == "STANDBY"
    for missing in needs:
        assert next_state(state, complete & ~condition(missing)) == state, missing
    assert next_state(state, complete | condition(hindered_by)) == state


def test_nothing_leads_into_armed_but_ready_and_nothing_into_ready_but_standby():
    found = {(*left, to) for left, to, _ in transitions() if to in ("ARMED", "READY")}
    assert found == {("READY", "ARMED"), ("STANDBY", "READY")}


def test_estop_comes_before_everything_and_a_fault_before_all_else():
    everything = 2**25 - 1
    for state in ALL_BUT_BOOT_AND_ESTOP:
        assert next_state(state, everything) == "ESTOP"
    for state in ("BOOT", "STANDBY", "READY", "ARMED", "STOPPING"):
        assert next_state(state, everything & ~condition("ESTOP_LATCHED")) == "FAULT"
