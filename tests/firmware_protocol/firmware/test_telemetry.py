import dataclasses
import itertools
import math
import struct
from fractions import Fraction
from functools import cache

import pytest
from hypothesis import strategies as st

from firmware_protocol import _firmware
from firmware_protocol.codec import PROTOCOL_MAJOR, PROTOCOL_MINOR
from firmware_protocol.firmware_core import FirmwareCore
from tests.firmware_protocol.bench import CODEC, CONFIG, MS, STATIONARY, Bench
from tests.tables import examples

lib, ffi = _firmware.lib, _firmware.ffi
PERIODS_MS = {
    "WHEEL_SPEED": 10,
    "WHEEL_TICKS": 10,
    "MOTOR": 50,
    "SYSTEM_STATE": 100,
    "SESSION_STATE": 100,
    "POWER": 500,
    "LINK_HEALTH": 1000,
    "HELLO": 1000,
    "BUILD": 1000,
}


def last(bench, name):
    return bench.messages(name)[-1].values


def shown(bench, signal):
    """The name of what the last SYSTEM_STATE has in a signal."""
    return CODEC.choice_name("SYSTEM_STATE", signal, last(bench, "SYSTEM_STATE")[signal])


def sent_by_next_cycle(bench, name, elapsed_us=MS):
    """How many messages of this name the next cycle sends."""
    bench.step(elapsed_us)
    return len(bench.messages(name, bench.now_us))


@pytest.fixture(scope="module")
def idle():
    """A controller that has told of itself for so long that the counters of its rarest messages came round."""
    bench = Bench()
    bench.run(20_000)
    return bench


@pytest.mark.parametrize("name", [*PERIODS_MS, "LIMITS"])
def test_each_message_comes_at_its_period_with_a_counter_that_goes_up_by_one(name, idle):
    sent = [(t_us, message.counter) for t_us, message in idle.sent if message.name == name]
    assert len(sent) > 16
    assert all((after - before) % 16 == 1 for (_, before), (_, after) in itertools.pairwise(sent))
    if name in PERIODS_MS:
        times = [t_us for t_us, _ in sent if t_us > 100 * MS]
        assert {after - before for before, after in itertools.pairwise(times)} == {PERIODS_MS[name] * MS}


def test_wheel_frames_of_one_sample_have_one_counter_and_one_instant():
    bench = Bench.driving()
    speeds, ticks = ([(t, m) for t, m in bench.sent if m.name == name] for name in ("WHEEL_SPEED", "WHEEL_TICKS"))
    assert [(t, m.counter) for t, m in speeds] == [(t, m.counter) for t, m in ticks]
    assert all(m.values["sample_time"] == t_us // 20 % 65536 * 20 for t_us, m in speeds)


def test_wheel_values(bench):
    bench.wheels_follow = False
    speeds = {"left_speed_rad_s": 1.2345, "right_speed_rad_s": -99.0}
    bench.inputs = {"left_ticks": (1 << 24) + 5, "right_ticks": -1} | speeds
    bench.core = FirmwareCore(CONFIG)
    bench.now_us = 0
    bench.step()
    assert last(bench, "WHEEL_TICKS") == {"left_ticks": 5, "right_ticks": (1 << 24) - 1}
    flags = {"left_valid": 1, "right_valid": 1, "driver_enabled": 0, "limited": 0}
    speeds = {"left_speed": 1.234, "right_speed": -65.536}
    assert last(bench, "WHEEL_SPEED") == pytest.approx(flags | speeds | {"sample_time": 1000})


@pytest.mark.parametrize("bad", [math.nan, math.inf])
@pytest.mark.parametrize("side", ["left", "right"])
def test_a_speed_that_is_not_known_is_not_valid(side, bad, bench):
    bench.inputs[f"{side}_speed_rad_s"] = bad
    bench.run(20)
    values = last(bench, "WHEEL_SPEED")
    other = "right" if side == "left" else "left"
    assert (values[f"{side}_valid"], values[f"{other}_valid"]) == (0, 1)
    assert values["left_speed" if side == "left" else "right_speed"] == (0.0 if math.isnan(bad) else 65.534)
    bench.inputs = {f"{side}_encoder_valid": False}
    bench.run(20)
    assert last(bench, "WHEEL_SPEED")[f"{side}_valid"] == 0


def test_driver_and_limited_bits():
    bench = Bench.armed()
    bench.command = {"left": 40.0, "right": 40.0}
    bench.run(100)
    values = last(bench, "WHEEL_SPEED")
    assert (values["driver_enabled"], values["limited"]) == (1, 1)


def test_motor_and_power_values(bench):
    bench.inputs.update(
        left_current_a=-1.239,
        right_current_a=400.0,
        left_temperature_c=-200.0,
        right_temperature_c=25.6,
        voltage_v=24.567,
        battery_current_a=-2.5,
        battery_temperature_c=300.0,
    )
    bench.run(600)
    motor = last(bench, "MOTOR")
    assert motor == pytest.approx(
        {"left_current": -1.24, "right_current": 327.67, "left_temperature": -128, "right_temperature": 26}
    )
    assert last(bench, "POWER") == pytest.approx({"voltage": 24.57, "current": -2.5, "temperature": 127})


def test_values_are_rounded_to_the_nearest_step_and_end_at_zero_where_there_is_no_less(bench):
    bench.inputs.update(
        left_temperature_c=20.496, right_temperature_c=20.504, voltage_v=0.0, battery_temperature_c=100.0
    )
    bench.run(600)
    motor, power = last(bench, "MOTOR"), last(bench, "POWER")
    assert (motor["left_temperature"], motor["right_temperature"]) == (20, 21)
    assert (power["voltage"], power["temperature"]) == (0.0, 100)


def test_system_state_tells_every_change_at_once(bench):
    bench.run(105)
    bench.core.receive(bench.now_us, 0x080, b"")
    assert sent_by_next_cycle(bench, "SYSTEM_STATE") == 1
    assert (shown(bench, "state"), shown(bench, "estop_source")) == ("ESTOP", "FRAME")


def test_a_session_that_changes_within_one_cycle_is_told():
    bench = Bench.ready(session=7)
    bench.run(5)
    bench.host_state(request="READY", session=8)
    assert sent_by_next_cycle(bench, "SYSTEM_STATE") == 1
    assert (bench.out.state, bench.out.session) == ("READY", 8)


def test_system_state_follows_session_fault_and_stop_cause():
    bench = Bench.driving()
    assert last(bench, "SYSTEM_STATE")["session"] == 7
    bench.command = None
    bench.run_until("STANDBY")
    assert shown(bench, "stop_cause") == "COMMAND_TIMEOUT"
    bench.inputs["tx_error_count"] = 256
    bench.step()
    assert shown(bench, "fault") == "BUS_OFF"


def test_rejections_are_counted_modulo_256_with_the_newest_reason(bench):
    bench.run(50)
    for _ in range(300):
        bench.core.receive(bench.now_us, 0x100, b"\0")
    bench.run(100)
    assert last(bench, "SYSTEM_STATE")["rejected_count"] == 300 % 256
    assert shown(bench, "reject_reason") == "LENGTH"
    assert bench.out.rejected_frames == 300


def test_session_state_tells_challenge_session_acceptance_and_blockers_and_the_end_of_a_session_at_once(bench):
    bench.run(105)
    assert sent_by_next_cycle(bench.hello(), "SESSION_STATE") == 1
    assert last(bench, "SESSION_STATE")["host_accepted"] == 1
    bench.to_ready()
    values = last(bench, "SESSION_STATE")
    assert (values["session"], values["challenge"]) == (7, bench.core.challenge)
    assert values["blockers"] == bench.out.blockers
    bench.run(5)
    bench.core.receive(bench.now_us, 0x080, b"")
    assert sent_by_next_cycle(bench, "SESSION_STATE") == 1
    assert last(bench, "SESSION_STATE")["session"] == 0


def test_cycles_whose_clock_goes_back_are_counted_and_others_are_not(bench):
    bench.run(150)
    assert last(bench, "SESSION_STATE")["clock_error_count"] == 0
    for elapsed_us in (-1, -50_000, 0):
        bench.step(elapsed_us)
    bench.run(150)
    assert last(bench, "SESSION_STATE")["clock_error_count"] == 2


def test_link_health(bench):
    bench.run(1000)
    assert set(last(bench, "LINK_HEALTH").values()) == {0}
    bench.inputs.update(rx_error_count=130)
    for tx_error_count in (300, 255, 256):
        bench.inputs.update(tx_error_count=tx_error_count)
        bench.run(10)
    for _ in range(3):
        bench.core.receive(bench.now_us, 0x100, bytes(8))
    bench.host_state()
    bench.counters["HOST_STATE"] -= 1
    bench.host_state()
    bench.run(1000)
    errors = {"tx_error_count": 255, "rx_error_count": 130, "bus_off_count": 2, "watchdog_count": 0}
    assert last(bench, "LINK_HEALTH") == errors | {"crc_error_count": 3, "sequence_error_count": 1}


def test_handshake_is_offered_until_accepted_and_answered_ever_after(bench):
    assert len(bench.messages("HELLO")) == 1
    bench.run(2500)
    assert len(bench.messages("HELLO")) == 3
    bench.hello().run(1)
    assert len(bench.messages("HELLO")) == 4
    # Two pages with each, and no more.
    bench.run(100)
    assert len(bench.messages("LIMITS")) == 8
    bench.request = {"request": "STANDBY", "session": 0}
    bench.run(4000)
    assert len(bench.messages("HELLO")) == 4


def test_what_the_handshake_says():
    own = {"board_id": 77, "firmware_version": (3, 4, 5), "capabilities": 8, "command_timeout_s": 0.08}
    bench = Bench(dataclasses.replace(CONFIG, **own))
    bench.run(3)
    protocol = {"protocol_major": PROTOCOL_MAJOR, "protocol_minor": PROTOCOL_MINOR}
    firmware = {"firmware_major": 3, "firmware_minor": 4, "firmware_patch": 5, "capabilities": 8}
    assert last(bench, "HELLO") == protocol | firmware
    assert last(bench, "BUILD") == {"dbc_hash": CODEC.dbc_hash, "board_id": 77}
    first, second = (message.values for message in bench.messages("LIMITS"))
    assert first == pytest.approx(
        {"page": 0, "max_wheel_speed": 8.0, "max_wheel_acceleration": 20.0, "ticks_per_rev": 2048}
    )
    assert second == pytest.approx(
        {"page": 1, "command_timeout": 0.08, "drive_off_timeout": 0.5, "stop_deceleration": 20.0}
    )


def names_by_cycle(bench, since_us):
    names = {}
    for t_us, message in bench.sent:
        if t_us >= since_us:
            names.setdefault((t_us - since_us) // MS, []).append(message.name)
    return names


HANDSHAKE = ["HELLO", "BUILD", "LIMITS", "LIMITS"]


def test_the_introduction_comes_a_frame_a_cycle(bench):
    """So that no cycle takes much longer than the others."""
    bench.run(42)
    bench.hello()
    start = bench.now_us + MS
    bench.run(20)
    sent = names_by_cycle(bench, start)
    assert [[name for name in sent.get(cycle, []) if name in HANDSHAKE] for cycle in range(5)] == [
        ["HELLO"], ["BUILD"], ["LIMITS"], ["LIMITS"], [],
    ]  # fmt: skip
    assert [int(message.values["page"]) for message in bench.messages("LIMITS", start)] == [0, 1]


@pytest.mark.parametrize(
    ("after_cycles", "pages"), [(0, [0, 1]), (1, [0, 1]), (2, [0, 1]), (3, [0, 0, 1]), (4, [0, 1, 0, 1])]
)
def test_limits_that_change_during_the_introduction_are_told_once_more_if_at_all(after_cycles, pages, bench):
    bench.run(42)
    bench.hello()
    start = bench.now_us + MS
    bench.run(after_cycles)
    bench.send("PARAM_REQUEST", operation="WRITE", key=4, value=2.5)
    bench.run(10)
    limits = bench.messages("LIMITS", start)
    assert [int(message.values["page"]) for message in limits] == pages
    assert limits[-1].values["stop_deceleration"] == pytest.approx(2.5)


def test_what_is_due_together_goes_out_two_a_cycle_the_wheels_first():
    bench = Bench().hello()
    bench.run(100)
    start = bench.now_us + 5_000 * MS
    bench.step(elapsed_us=5_000 * MS)
    bench.run(4)
    sent = names_by_cycle(bench, start)
    # After a pause the first cycle has more to tell: the clocks have come apart.
    assert [set(sent[cycle]) - {"SYSTEM_STATE", "SESSION_STATE", "HELLO"} for cycle in (0, 1, 2, 3)] == [
        {"WHEEL_SPEED", "WHEEL_TICKS", "MOTOR"}, {"BUILD"}, {"POWER", "LIMITS"}, {"LINK_HEALTH", "LIMITS"},
    ]  # fmt: skip
    assert {"SYSTEM_STATE", "SESSION_STATE"} <= set(sent[1])


def test_no_cycle_sends_more_than_six_frames():
    bench = Bench.driving()
    bench.command = None
    bench.run(2500)
    most = max(len(names) for names in names_by_cycle(bench, 0).values())
    assert 3 <= most <= 6


@cache
def before_power():
    """Return a bench shortly before it sends what is sent least often of what it measures."""
    bench = Bench()
    bench.run(460)
    return bench


@examples(
    quick=60, every=100, value=st.floats(width=32) | st.integers(-40_000, 40_000).map(lambda halves: halves / 1000)
)
def test_values_are_rounded_exactly_halves_up(value):
    """As the 64-bit formula floor(value / scale + 1/2), without its 64 bits."""
    bench = before_power().copy()
    bench.wheels_follow = False
    bench.inputs.update(left_speed_rad_s=value, voltage_v=value, left_current_a=value, left_temperature_c=value)
    bench.run(50)
    # A float is what the board's sensors give.
    (single,) = struct.unpack("f", struct.pack("f", value)) if abs(value) < 3e38 else (value,)

    def expected(per_unit, least, most):
        if math.isnan(single):
            return 0
        if math.isinf(single):
            return most if single > 0 else least
        return min(max(math.floor(Fraction(single) * per_unit + Fraction(1, 2)), least), most)

    assert round(last(bench, "WHEEL_SPEED")["left_speed"] * 500) == expected(500, -32768, 32767)
    assert round(last(bench, "POWER")["voltage"] * 100) == expected(100, 0, 65535)
    assert round(last(bench, "MOTOR")["left_current"] * 100) == expected(100, -32768, 32767)
    assert last(bench, "MOTOR")["left_temperature"] == expected(1, -128, 127)


@pytest.mark.parametrize(
    "now_us", [*(n << 32 for n in (1, 2, 255, 256)), (1 << 40) - 1, (1 << 40) + 19, 0xFFFFFFFF, 123_456_789_012]
)
@pytest.mark.parametrize("before_us", [0, 1, 3, 19, 20, 21])
def test_sample_times_are_those_of_the_40_bit_clock(now_us, before_us, bench):
    bench.now_us = now_us - before_us - MS
    # The core's own time has not come so far yet when it is told of a pose.
    bench.step()
    bench.core.pose(0.0, 0.0, 0.0, now_us, 0.0, 0.0)
    pose_us = now_us
    bench.step(elapsed_us=10 * MS)
    assert last(bench, "WHEEL_SPEED")["sample_time"] == bench.now_us % (1 << 40) // 20 % 65536 * 20
    assert last(bench, "POSE_HEADING")["sample_time"] == pose_us % (1 << 40) // 100 % 65536 * 100


def test_a_hello_is_answered_from_20_ms_after_the_answer_before():
    bench = Bench().hello()
    bench.run(100)
    assert sent_by_next_cycle(bench.hello(), "HELLO") == 1
    before = len(bench.messages("HELLO"))
    bench.hello().run(19)
    bench.step(elapsed_us=999)
    assert len(bench.messages("HELLO")) == before
    bench.step(elapsed_us=1)
    assert len(bench.messages("HELLO")) == before + 1
    answers = sum(sent_by_next_cycle(bench.hello(), "HELLO") for _ in range(200))
    assert answers == pytest.approx(10, abs=1), "every 20 ms in a flood"


def test_time_is_that_of_reception_in_40_bits(bench):
    bench.run(10)
    bench.now_us += 321
    bench.send("TIME_REQUEST", sequence=200)
    bench.now_us += 500
    bench.step()
    assert last(bench, "TIME_RESPONSE") == {"sequence": 200, "receive_time": 10 * MS + MS + 321}
    bench.now_us = (1 << 40) + 1234
    bench.send("TIME_REQUEST", sequence=0)
    bench.step()
    assert last(bench, "TIME_RESPONSE")["receive_time"] == 1234


def pose(**changes):
    """What is sent of a pose at the origin, but for these arguments."""
    arguments = {"x_m": 0.0, "y_m": 0.0, "yaw_rad": 0.0, "sample_us": 0, "position_std_m": 0.0, "yaw_std_rad": 0.0}
    bench = Bench()
    bench.core.pose(**arguments | changes)
    bench.step()
    position, heading = bench.messages("POSE_POSITION")[-1], bench.messages("POSE_HEADING")[-1]
    assert position.counter == heading.counter
    assert position.values["valid"] == heading.values["valid"]
    return position.values | heading.values


def test_pose_values():
    position = {"x_m": 1.23456, "y_m": -800.0, "position_std_m": 0.0104}
    heading = {"yaw_rad": -3.14159, "sample_us": 6_700_049, "yaw_std_rad": 0.0206}
    expected_position = {"x": 1.2346, "y": -800.0, "position_std": 0.010}
    expected_heading = {"yaw": -3.1416, "sample_time": 6_700_000 % 6_553_600, "yaw_std": 0.021}
    expected = {"valid": 1} | expected_position | expected_heading
    assert pose(**position, **heading) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("x_m", (math.nan, 839.0)),
        ("y_m", (math.inf, -839.0)),
        ("yaw_rad", (math.nan, 3.2768)),
        ("position_std_m", (-0.001,)),
        ("yaw_std_rad", (math.nan,)),
    ],
)
def test_a_pose_that_does_not_fit_is_not_valid(name, values):
    assert [pose(**{name: value})["valid"] for value in values] == [0] * len(values)


@pytest.mark.parametrize("name", ["x_m", "y_m", "yaw_rad"])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_pose_is_valid_up_to_the_largest_that_its_frames_hold(name, sign):
    largest = 0.0001 * (0x7FFF if name == "yaw_rad" else 0x7FFFFF)
    for value, valid in ((largest, 1), (math.nextafter(largest, math.inf), 0)):
        assert pose(**{name: sign * value})["valid"] == valid


@pytest.mark.parametrize(("name", "unit"), [("position_std", "m"), ("yaw_std", "rad")])
@pytest.mark.parametrize("value", [0.0, 0.255, 0.256, math.inf])
def test_a_pose_is_valid_as_long_as_its_deviations_fit(name, unit, value):
    sent = pose(**{f"{name}_{unit}": value})
    assert sent["valid"] == (value <= 0.255)
    assert sent[name] == pytest.approx(min(value, 0.255))


def test_a_pose_beyond_its_frames_ends_at_their_edge():
    low, high = pose(x_m=-900.0, y_m=-900.0, yaw_rad=-4.0), pose(x_m=900.0, y_m=900.0, yaw_rad=4.0)
    assert (low["x"], low["y"], low["yaw"]) == pytest.approx((-838.8608, -838.8608, -3.2768), abs=1e-9)
    assert (high["x"], high["y"], high["yaw"]) == pytest.approx((838.8607, 838.8607, 3.2767), abs=1e-9)


def in_units(x, y, yaw, position_std=0.0, yaw_std=0.0):
    made = lib.disco_pose(x, y, yaw, position_std, yaw_std)
    return bool(made.valid), (made.x, made.y, made.yaw, made.position_std, made.yaw_std)


def test_a_board_that_reckons_in_floats_gets_the_units_of_the_frames_halves_going_up():
    assert in_units(1.23456, -800.0, -3.14159, 0.0104, 0.0206) == (True, (12346, -8_000_000, -31416, 10, 21))
    assert in_units(0.03125, -0.03125, 0.03125)[1][:3] == (313, -312, 313)


@pytest.mark.parametrize("far", [900.0, 2.0**23, 1e30])
def test_a_pose_in_floats_ends_one_unit_beyond_its_frames_however_far_it_is(far):
    assert in_units(far, far, far) == (True, (0x800000, 0x800000, 0x8000, 0, 0))
    assert in_units(-far, -far, -far) == (True, (-0x800000, -0x800000, -0x8000, 0, 0))


@pytest.mark.parametrize("place", range(5))
def test_a_pose_in_floats_that_is_not_finite_fits_nowhere_nor_a_deviation_below_zero(place):
    for bad in (math.nan, math.inf, -math.inf, -0.001 if place in (3, 4) else math.nan):
        valid, units = in_units(*(bad if at == place else 0.0 for at in range(5)))
        # An infinite deviation is one beyond its frame.
        assert not valid or (math.isinf(bad) and units[place] > 255), bad


def sent_pose(**changes):
    """Return whether the core sent a pose in units as valid, and the values of its messages."""
    bench = Bench()
    units = {"x": 0, "y": 0, "yaw": 0, "position_std": 0, "yaw_std": 0, "valid": True} | changes
    lib.disco_firmware_pose(bench.core._core, ffi.new("disco_pose_t *", units), 0)
    bench.step()
    values = last(bench, "POSE_POSITION") | last(bench, "POSE_HEADING")
    return int(values["valid"]), values


FARTHEST = {"x": 0x7FFFFF, "y": 0x7FFFFF, "yaw": 0x7FFF}


@pytest.mark.parametrize("name", FARTHEST)
@pytest.mark.parametrize("sign", [1, -1])
def test_a_pose_in_units_is_valid_to_the_edge_of_its_frames(name, sign):
    scale = 0.0001
    valid, values = sent_pose(**{name: sign * FARTHEST[name]})
    assert (valid, values[name]) == (1, pytest.approx(sign * FARTHEST[name] * scale))
    assert sent_pose(**{name: sign * (FARTHEST[name] + 1)})[0] == 0
    for beyond in (FARTHEST[name] + 2, 2**31 - 1):
        valid, values = sent_pose(**{name: sign * beyond})
        edge = FARTHEST[name] if sign > 0 else -FARTHEST[name] - 1
        assert (valid, values[name]) == (0, pytest.approx(edge * scale))


@pytest.mark.parametrize("name", ["position_std", "yaw_std"])
def test_a_deviation_in_units_is_valid_to_the_edge_of_its_frame_unless_its_sensor_is_lost(name):
    assert [sent_pose(**{name: value})[0] for value in (255, 256, 65535)] == [1, 0, 0]
    assert sent_pose(**{name: 65535})[1][name] == pytest.approx(0.255)
    assert sent_pose(valid=False)[0] == 0


def test_timeouts_beyond_their_frame_end_at_its_edge():
    bench = Bench(dataclasses.replace(CONFIG, drive_off_timeout_s=100.0, command_timeout_s=0.0204))
    bench.run(4)
    assert last(bench, "LIMITS")["drive_off_timeout"] == pytest.approx(65.535)
    assert last(bench, "LIMITS")["command_timeout"] == pytest.approx(0.020)


def test_pose_counters(bench):
    for _ in range(20):
        bench.core.pose(0.0, 0.0, 0.0, 0, 0.0, 0.0)
        bench.step()
    assert [message.counter for message in bench.messages("POSE_HEADING")] == [n % 16 for n in range(20)]


@pytest.mark.parametrize("late_ms", [20, 5_000])
def test_after_a_late_cycle_nothing_is_caught_up_in_a_burst(late_ms, bench):
    bench.run(100)
    while not sent_by_next_cycle(bench, "WHEEL_SPEED"):
        pass
    assert sent_by_next_cycle(bench, "WHEEL_SPEED", late_ms * MS) == 1
    assert [sent_by_next_cycle(bench, "WHEEL_SPEED") for _ in range(20)] == ([0] * 9 + [1]) * 2


def test_a_queue_that_nobody_empties_counts_what_it_drops():
    core = Bench().core
    for ms in range(2, 1000):
        core.step(ms * MS, STATIONARY)
    assert core.overflowed_frames > 100
    assert len(core.drain()) == 48
    assert core.drain() == []
