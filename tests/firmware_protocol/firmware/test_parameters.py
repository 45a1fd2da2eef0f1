import math
import struct

import pytest

from tests.firmware_protocol.bench import CODEC, CONFIG, MS, Bench, sealed

KEYS = CODEC.choices("PARAM_REQUEST", "key")
DEFAULTS = {
    "OVER_CURRENT": CONFIG.over_current_a,
    "OVER_TEMPERATURE": CONFIG.over_temperature_c,
    "UNDER_VOLTAGE": CONFIG.under_voltage_v,
    "STOP_DECELERATION": CONFIG.stop_deceleration_rad_s2,
    "MAX_WHEEL_SPEED": CONFIG.max_wheel_speed_rad_s,
    "MAX_WHEEL_ACCELERATION": CONFIG.max_wheel_acceleration_rad_s2,
}
BOUNDS = {
    "OVER_CURRENT": (0.5, 200.0),
    "OVER_TEMPERATURE": (30.0, 120.0),
    "UNDER_VOLTAGE": (5.0, 60.0),
    "STOP_DECELERATION": (1.0, 655.0),
}


def ask(bench, operation, key, value=0.0):
    bench.send("PARAM_REQUEST", operation=operation, key=key, value=value)
    bench.step()
    values = bench.messages("PARAM_RESPONSE")[-1].values
    return CODEC.choice_name("PARAM_RESPONSE", "status", values["status"]), values["key"], values["value"]


def test_every_key_of_the_table_can_be_read():
    assert set(KEYS.values()) == set(DEFAULTS)
    for key, name in KEYS.items():
        assert ask(Bench(), "READ", key) == ("OK", key, pytest.approx(DEFAULTS[name]))


@pytest.mark.parametrize("name", BOUNDS)
def test_write_within_bounds_is_read_back(name):
    key = CODEC.choice_value("PARAM_REQUEST", "key", name)
    bench = Bench()
    for value in BOUNDS[name]:
        assert ask(bench, "WRITE", key, value) == ("OK", key, value)
        assert ask(bench, "READ", key) == ("OK", key, value)
    low, high = BOUNDS[name]
    for value in (low * 0.999, high * 1.001, -1.0):
        assert ask(bench, "WRITE", key, value) == ("OUT_OF_RANGE", key, high)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_not_a_number_is_refused(value):
    bench = Bench()
    body = bytes((0x10, 1, 0)) + struct.pack("<f", value)
    bench.core.receive(bench.now_us, 0x160, sealed(0x160, body))
    bench.step()
    values = bench.messages("PARAM_RESPONSE")[-1].values
    assert CODEC.choice_name("PARAM_RESPONSE", "status", values["status"]) == "NOT_FINITE"
    assert values["value"] == CONFIG.over_current_a


@pytest.mark.parametrize("name", ["MAX_WHEEL_SPEED", "MAX_WHEEL_ACCELERATION"])
def test_hard_limits_are_read_only(name):
    key = CODEC.choice_value("PARAM_REQUEST", "key", name)
    assert ask(Bench(), "WRITE", key, 1.0) == ("READ_ONLY", key, DEFAULTS[name])


def test_unknown_key_and_operation():
    assert ask(Bench(), "READ", 99) == ("UNKNOWN_KEY", 99, 0.0)
    assert ask(Bench(), "WRITE", 0, 1.0) == ("UNKNOWN_KEY", 0, 0.0)
    assert ask(Bench(), 2, 1, 1.0) == ("UNKNOWN_OPERATION", 1, CONFIG.over_current_a)


@pytest.mark.parametrize("state", ["READY", "ARMED", "STOPPING", "moving ESTOP"])
def test_writing_is_refused_unless_disarmed(state):
    bench = Bench()
    if state == "READY":
        bench.to_ready()
    else:
        bench.to_driving()
    if state == "STOPPING":
        bench.ask("STANDBY")
        bench.run_until("STOPPING")
    elif state == "moving ESTOP":
        bench.core.receive(bench.now_us, 0x080, b"")
        bench.step()
    assert ask(bench, "WRITE", 4, 50.0)[0] == "REFUSED_ARMED"
    assert ask(bench, "READ", 4)[2] == CONFIG.stop_deceleration_rad_s2


@pytest.mark.parametrize("state", ["FAULT", "ESTOP"])
def test_writing_is_allowed_in_a_state_that_does_not_move(state):
    bench = Bench()
    if state == "FAULT":
        bench.inputs["left_current_a"] = 40.0
        bench.run_until("FAULT")
    else:
        bench.core.receive(bench.now_us, 0x080, b"")
        bench.step()
    assert ask(bench, "WRITE", 1, 60.0) == ("OK", 1, 60.0)


def test_a_written_value_is_in_force_and_told_in_limits():
    bench = Bench()
    bench.run(100)
    before = bench.now_us
    assert ask(bench, "WRITE", 4, 40.0)[0] == "OK"
    bench.run(100)
    pages = [message.values for message in bench.messages("LIMITS", since_us=before)]
    assert [page["page"] for page in pages] == [0, 1]
    assert pages[1]["stop_deceleration"] == 40.0
    bench.to_driving()
    start = bench.now_us
    bench.core.receive(bench.now_us, 0x080, b"")
    while bench.step().driver_enabled:
        pass
    assert bench.now_us - start == pytest.approx(100 * MS, abs=3 * MS)


def test_a_damaged_request_is_not_answered():
    bench = Bench()
    bench.core.receive(bench.now_us, 0x160, bytes(8))
    bench.step()
    assert bench.messages("PARAM_RESPONSE") == []
    assert bench.core.rejections["CRC"] == 1
