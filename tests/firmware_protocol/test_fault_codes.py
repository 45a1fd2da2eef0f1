"""The one table of faults: complete, and true to the C core."""

from dataclasses import replace

import pytest

from firmware_protocol import status_codes
from firmware_protocol.firmware_core import ResetCause
from firmware_protocol.status_codes import _REMEDIES, FAULTS, advice
from tests.firmware_protocol.bench import CODEC, CONFIG, MS, Bench

SIDES = {"LEFT": 0, "RIGHT": 1}


def test_every_code_of_the_dbc_has_a_row_and_no_other():
    choices = CODEC.choices("SYSTEM_STATE", "fault")
    assert {fault.code: fault.name for fault in FAULTS.values()} == {
        code: name for code, name in choices.items() if code
    }
    assert set(FAULTS) == set(_REMEDIES)
    assert all(name == fault.name and fault.hint for name, fault in FAULTS.items())


def disturbed(disturb, end=lambda bench: bench.inputs.clear()):
    """Return how a fault begins in a robot that drives, and how its cause ends."""

    def begin():
        bench = Bench.driving(4.0, 4.0)
        disturb(bench)
        return bench

    return begin, end


def bad_input(field, value):
    """A cause that lies in one measurement."""
    return disturbed(lambda bench: bench.inputs.update({field: value}))


def dead_wheel(side, current_a):
    """A driven wheel without ticks."""

    def disturb(bench):
        bench.inputs.update({f"{side}_current_a": current_a, f"{side}_ticks": int(bench.ticks[side == "right"])})

    return disturbed(disturb)


def jump(side):
    def disturb(bench):
        bench.ticks[side] += 5000

    return disturbed(disturb)


def turned_round(side):
    def disturb(bench):
        bench.wheels_follow = False
        bench.speeds[side] = -3.0

    return disturbed(disturb, lambda bench: setattr(bench, "wheels_follow", True))


def stranger(**changes):
    return lambda: Bench().hello(**changes), lambda bench: bench.hello()


def started_by(cause):
    class Started(Bench):
        def step(self, elapsed_us=None):
            self.inputs["reset_cause"] = cause
            return super().step(elapsed_us)

    return Started, lambda bench: None


PROVOKED = {
    "UNDER_VOLTAGE": bad_input("voltage_v", 12.0),
    "OVER_VOLTAGE": bad_input("voltage_v", 40.0),
    "BUS_OFF": bad_input("tx_error_count", 256),
    "SELF_TEST_FAILED": bad_input("self_test_failed", True),
    "DBC_HASH_MISMATCH": stranger(dbc_hash=1),
    "PROTOCOL_MAJOR_MISMATCH": stranger(protocol_major=99),
    "CLOCK_MISMATCH": disturbed(lambda bench: bench.step(50 * MS)),
    "CONFIG_INVALID": (lambda: Bench(replace(CONFIG, max_wheel_speed_rad_s=-1.0)), lambda bench: None),
    "ENTROPY_INVALID": (lambda: Bench(entropy=0), lambda bench: None),
    "WATCHDOG_RESET": started_by(ResetCause.WATCHDOG),
    "BROWN_OUT_RESET": started_by(ResetCause.BROWN_OUT),
    **{f"OVER_TEMPERATURE_{side}": bad_input(f"{side.lower()}_temperature_c", 100.0) for side in SIDES},
    **{f"OVER_CURRENT_{side}": bad_input(f"{side.lower()}_current_a", 99.0) for side in SIDES},
    **{f"STALL_{side}": dead_wheel(side.lower(), 16.0) for side in SIDES},
    **{f"ENCODER_MISSING_{side}": dead_wheel(side.lower(), 2.0) for side in SIDES},
    **{f"ENCODER_JUMP_{side}": jump(index) for side, index in SIDES.items()},
    **{f"WRONG_DIRECTION_{side}": turned_round(index) for side, index in SIDES.items()},
}


@pytest.mark.parametrize("fault", FAULTS.values(), ids=FAULTS)
def test_the_core_ends_each_fault_as_the_table_says(fault):
    begin, end = PROVOKED[fault.name]
    bench = begin()
    for _ in range(1500):
        if bench.out.fault == fault.code:
            break
        bench.step()
    assert bench.out.fault == fault.code
    assert bench.run(5).state == ("FAULT" if fault.latches else bench.out.state)
    bench.command = None
    end(bench)
    bench.set_request("STANDBY").run(1000)
    assert (bench.out.fault != 0, bench.out.state) == (fault.latches, "FAULT" if fault.latches else "STANDBY")
    bench.set_request("RESET").run(500)
    assert (bench.out.fault != 0, bench.out.state) == (fault.permanent, "FAULT" if fault.permanent else "STANDBY")


def test_what_ends_a_fault_is_said_with_the_remedy():
    assert FAULTS["STALL_LEFT"].advice.endswith("; then reset")
    assert FAULTS["OVER_TEMPERATURE_LEFT"].advice.endswith("; it clears by itself")
    assert FAULTS["SELF_TEST_FAILED"].advice.endswith("; then restart the controller")
    assert not any(term in fault.hint for fault in FAULTS.values() for term in ("reset", "clear"))
    assert advice("NONE") == advice("NO_SUCH_FAULT") == ""
    assert status_codes.fault("BUS_OFF") == f"BUS_OFF: {FAULTS['BUS_OFF'].advice}"
