import math

import pytest
from hypothesis import strategies as st

from drivers.device_clock import DeviceClock
from drivers.motor import reference_frames as telemetry
from drivers.motor.reference_frames import (
    DISTRUST_CLOCK_AFTER,
    LONGEST_APART_NS,
    REANCHOR_AFTER,
    SLACK_TICKS,
    SPEED_MARGIN,
    TICKS_MODULUS,
    WHEEL_TIME_MODULUS_US,
    FramePairs,
    Telemetry,
    WheelTicks,
)
from firmware_protocol.codec import Decoded
from tests.tables import examples, thinned

MS = 1_000_000
BOOT_NS = 777 * MS
TICKS_PER_REV, MAX_SPEED_RAD_S = 2048, 8.0
PER_TICK = 2 * math.pi / TICKS_PER_REV


def synced_clock(now_ns):
    clock = DeviceClock()
    for number in range(4):
        t_ns = now_ns - (4 - number) * MS
        clock.add(t_ns - 1000, t_ns + 1000, (t_ns - BOOT_NS) // 1000)
    return clock


def create_telemetry(now_ns=None):
    made = Telemetry(synced_clock(now_ns) if now_ns is not None else DeviceClock())
    made.configure(TICKS_PER_REV, MAX_SPEED_RAD_S)
    return made


@pytest.fixture
def made():
    return create_telemetry()


def wheels(to, counter, t_ns, received_ns, ticks=(0, 0), valid=(1, 1)):
    """Feed one wheel sample measured at host time `t_ns`."""
    device_us = (t_ns - BOOT_NS) // 1000
    speed = {
        "left_valid": valid[0],
        "right_valid": valid[1],
        "left_speed": 1.0,
        "right_speed": -2.0,
        "sample_time": device_us % WHEEL_TIME_MODULUS_US // 20 * 20,
    }
    assert to.wheels(Decoded("WHEEL_SPEED", 0, counter, speed), received_ns) is None
    values = {"left_ticks": ticks[0] % 2**24, "right_ticks": ticks[1] % 2**24}
    return to.wheels(Decoded("WHEEL_TICKS", 0, counter, values), received_ns)


def pose(to, t_ns, received_ns, *, valid=1, yaw=0.5):
    device_us = (t_ns - BOOT_NS) // 1000
    position = {"valid": valid, "x": 1.5, "y": -2.5}
    sample_time = device_us % telemetry.POSE_TIME_MODULUS_US // 100 * 100
    heading = {"valid": 1, "yaw": yaw, "sample_time": sample_time, "position_std": 0.01, "yaw_std": 0.02}
    assert to.pose(Decoded("POSE_POSITION", 0, 3, position), received_ns) is None
    return to.pose(Decoded("POSE_HEADING", 0, 3, heading), received_ns)


@examples(quick=30, every=100, now_ms=st.integers(10_000, 10**9), age_ms=st.integers(0, 250))
def test_a_sample_is_stamped_with_its_measurement_whatever_its_delay(now_ms, age_ms):
    now_ns = now_ms * MS
    sample = wheels(create_telemetry(now_ns), 0, now_ns - age_ms * MS, now_ns)
    assert sample.t_ns == pytest.approx(now_ns - age_ms * MS, abs=25_000)
    assert sample.received_ns == now_ns
    measured = pose(create_telemetry(now_ns), now_ns - age_ms * MS, now_ns)
    assert measured.t_ns == pytest.approx(now_ns - age_ms * MS, abs=105_000)


def test_the_reception_counts_before_the_clock_is_known_and_for_a_sample_of_the_future():
    assert wheels(create_telemetry(), 0, 9_000 * MS, 9_100 * MS).t_ns == 9_100 * MS
    assert pose(create_telemetry(), 9_000 * MS, 9_100 * MS).t_ns == 9_100 * MS
    assert wheels(create_telemetry(9_000 * MS), 0, 9_005 * MS, 9_000 * MS).t_ns == 9_000 * MS


def test_stamps_that_contradict_the_clock_are_counted_and_end_the_trust_in_it():
    made = create_telemetry(9_000 * MS)
    for counter in range(DISTRUST_CLOCK_AFTER):
        assert not made.distrusts_clock
        t_ns = (9_000 + 10 * counter) * MS
        assert wheels(made, counter % 16, t_ns - 700 * MS, t_ns).t_ns == t_ns
    assert made.distrusts_clock
    assert made.implausible_values == DISTRUST_CLOCK_AFTER
    made.restart()
    assert not made.distrusts_clock


def test_a_stamp_that_fits_again_restores_the_trust_in_the_clock():
    made = create_telemetry(9_000 * MS)
    for number in range(3 * DISTRUST_CLOCK_AFTER):
        t_ns = (9_000 + 10 * number) * MS
        wheels(made, number % 16, t_ns - (700 * MS if number % 5 else 0), t_ns)
    assert not made.distrusts_clock


def test_angles_and_speeds(made):
    wheels(made, 0, 9_000 * MS, 9_000 * MS, ticks=(2**24 - 3, 5))
    sample = wheels(made, 1, 9_010 * MS, 9_010 * MS, ticks=(2**24 + 7, -5))
    assert (sample.left_angle_rad, sample.right_angle_rad) == pytest.approx((10 * PER_TICK, -10 * PER_TICK))
    assert (sample.left_speed_rad_s, sample.right_speed_rad_s) == (1.0, -2.0)


def ticks_of(speed_rad_s, elapsed_ms):
    return int(speed_rad_s * elapsed_ms * 1e-3 / PER_TICK)


def test_a_gap_longer_than_the_sample_times_wrap_allows_the_motion_of_its_length(made):
    """2.9 s at 8 rad/s; by the sample times alone it could have been 0.28 s."""
    wheels(made, 0, 9_000 * MS, 9_000 * MS)
    moved = ticks_of(8.0, 2_900)
    assert wheels(made, 1, 11_900 * MS, 11_900 * MS, ticks=(moved, moved)) is not None
    assert made.implausible_ticks == 0


def test_receptions_in_a_batch_do_not_make_motion_implausible(made):
    """A loop that was held up reads five samples at once; their own times say how far apart they are."""
    for counter in range(5):
        ticks = (counter * ticks_of(8.0, 10), 0)
        assert wheels(made, counter, (9_000 + 10 * counter) * MS, 9_050 * MS, ticks=ticks) is not None


@pytest.mark.parametrize("restarted_after_ms", range(30, 1300, 90))
def test_the_ticks_of_a_device_that_has_restarted_are_no_motion(restarted_after_ms, made):
    """Its sample times jump as well; they must not make room for the jump of the ticks."""
    wheels(made, 0, 9_000 * MS, 9_000 * MS, ticks=(2000, 2000))
    for number in range(1, 7):
        received_ns = (9_000 + 10 * number) * MS
        sample = wheels(made, number, received_ns + restarted_after_ms * MS, received_ns)
        assert sample is None or (sample.left_angle_rad, sample.right_angle_rad) == (0.0, 0.0)
    assert sample is not None


def test_implausible_ticks_and_invalid_halves_are_counted_and_dropped(made):
    wheels(made, 0, 9_000 * MS, 9_000 * MS)
    assert wheels(made, 1, 9_010 * MS, 9_010 * MS, ticks=(5000, 0)) is None
    assert made.implausible_ticks == 1
    assert wheels(made, 2, 9_020 * MS, 9_020 * MS, valid=(1, 0)) is None
    assert wheels(made, 3, 9_030 * MS, 9_030 * MS, valid=(0, 1)) is None
    assert pose(made, 9_000 * MS, 9_030 * MS, valid=0) is None
    assert made.implausible_values == 3
    assert wheels(made, 4, 9_040 * MS, 9_040 * MS, ticks=(1, 1)) is not None


def test_nothing_is_known_of_angles_before_the_handshake():
    assert wheels(Telemetry(DeviceClock()), 0, 9_000 * MS, 9_000 * MS) is None


@examples(
    quick=30,
    every=100,
    start_ms=st.integers(0, 10**7),
    steps=st.lists(st.tuples(st.integers(10, 4000), st.integers(0, 40)), min_size=1, max_size=20),
)
def test_motion_at_full_speed_is_plausible_over_any_gap_and_twice_that_is_not(start_ms, steps):
    """Samples 10 ms to 4 s apart, each received up to 40 ms late; their times on the wire wrap every 1.3 s."""
    made = create_telemetry()
    t_ms, ticks = start_ms, 0
    wheels(made, 0, t_ms * MS, t_ms * MS)
    for counter, (gap_ms, delay_ms) in enumerate(steps, 1):
        t_ms += gap_ms
        received_ns = (t_ms + delay_ms) * MS
        too_far = ticks + ticks_of(2.0 * 8.0, gap_ms + 90) + 10
        assert wheels(made, counter % 16, t_ms * MS, received_ns, ticks=(too_far, ticks)) is None
        ticks += ticks_of(8.0, gap_ms)
        assert wheels(made, (counter + 8) % 16, t_ms * MS, received_ns, ticks=(ticks, ticks)) is not None


@pytest.mark.parametrize(("restarts", "limits"), [(True, (TICKS_PER_REV, MAX_SPEED_RAD_S)), (False, (1024, 4.0))])
def test_angles_go_on_through_an_interruption_and_when_other_limits_are_reported(restarts, limits, made):
    wheels(made, 0, 9_000 * MS, 9_000 * MS)
    before = wheels(made, 1, 9_010 * MS, 9_010 * MS, ticks=(20, 20))
    if restarts:
        made.restart()
    made.configure(*limits)
    after = wheels(made, 2, 9_020 * MS, 9_020 * MS, ticks=(900_000, 3))
    assert (after.left_angle_rad, after.right_angle_rad) == (before.left_angle_rad, before.right_angle_rad)


def test_the_same_limits_reported_again_lose_no_motion(made):
    wheels(made, 0, 9_000 * MS, 9_000 * MS)
    made.configure(TICKS_PER_REV, MAX_SPEED_RAD_S)
    assert wheels(made, 1, 9_010 * MS, 9_010 * MS, ticks=(20, 20)).left_angle_rad > 0


@pytest.mark.parametrize(
    ("wire", "wrapped"),
    [(0.5, 0.5), (-3.1415, -3.1415), (3.2, 3.2 - 2 * math.pi), (-3.2, 2 * math.pi - 3.2), (math.pi, math.pi)],
)
def test_yaw_is_wrapped(wire, wrapped):
    assert pose(create_telemetry(), 0, 0, yaw=wire).yaw_rad == pytest.approx(wrapped)


def test_slow_telemetry():
    values = {"left_current": 1.5, "right_current": -0.5, "left_temperature": 40, "right_temperature": 41}
    motor = telemetry.motor(Decoded("MOTOR", 0, 0, values), 5)
    assert (motor.t_ns, motor.left_current_a, motor.right_temperature_c) == (5, 1.5, 41)
    power = telemetry.power(Decoded("POWER", 0, 0, {"voltage": 24.1, "current": 2.0, "temperature": 20}), 6)
    assert (power.t_ns, power.voltage_v, power.current_a, power.temperature_c) == (6, 24.1, 2.0, 20)
    names = ("tx_error", "rx_error", "bus_off", "crc_error", "sequence_error", "watchdog")
    counts = {f"{name}_count": number for number, name in enumerate(names)}
    health = telemetry.link_health(Decoded("LINK_HEALTH", 0, 0, counts), 7)
    assert (health.t_ns, health.tx_error_count, health.watchdog_count) == (7, 0, 5)


A1, B1, A2, B2 = (Decoded(name, 0, counter, {}) for counter in (1, 2) for name in "AB")


def pairs_in(*frames):
    """Return the pair, or None, that each of these frames completes."""
    pairs = FramePairs("A")
    return [pairs.add(frame, number) for number, frame in enumerate(frames)]


def test_pairs_by_counter_in_either_order():
    assert pairs_in(A1, B1, B2, A2) == [None, (A1, B1), None, (A2, B2)]


def test_a_lost_half_costs_its_own_sample_only():
    assert pairs_in(A1, A2, B2, B1, A2, B2) == [None, None, (A2, B2), None, None, (A2, B2)]


def test_the_same_counter_a_lap_later_is_another_sample():
    pairs = FramePairs("A")
    pairs.add(A1, 10**15)
    assert pairs.add(B1, 10**15 + LONGEST_APART_NS + 1) is None
    assert pairs.add(A1, 10**15 + 2 * LONGEST_APART_NS + 1) == (A1, B1)


TICKS_PER_REV = 2048
PERIOD_US = 10_000
LIMIT = int(SPEED_MARGIN * MAX_SPEED_RAD_S * PERIOD_US * 1e-6 / PER_TICK + SLACK_TICKS)


def wheel_ticks(left=0, right=0):
    """Return the ticks of two wheels, of which the counters were read once."""
    ticks = WheelTicks(TICKS_PER_REV, MAX_SPEED_RAD_S)
    ticks.update(left, right, 0)
    return ticks


@examples(
    quick=30,
    every=100,
    start=st.tuples(st.integers(0, TICKS_MODULUS - 1), st.integers(0, TICKS_MODULUS - 1)),
    steps=st.lists(st.tuples(st.integers(-LIMIT, LIMIT), st.integers(-LIMIT, LIMIT)), max_size=60),
)
def test_plausible_steps_add_up_wherever_the_ring_is_and_whichever_way_it_turns(start, steps):
    ticks = wheel_ticks(*start)
    left, right = start
    for number, (step_left, step_right) in enumerate(steps, 1):
        left, right = left + step_left, right + step_right
        angles = ticks.update(left % TICKS_MODULUS, right % TICKS_MODULUS, number * PERIOD_US)
        assert angles == ((left - start[0]) * PER_TICK, (right - start[1]) * PER_TICK)


@thinned(("step", "periods"), [(50 * LIMIT, 60), (LIMIT, 1), (-LIMIT, 1)], quick=1)
def test_once_round_the_whole_ring(step, periods):
    ticks = wheel_ticks()
    count = TICKS_MODULUS // abs(step) + 10
    for number in range(1, count + 1):
        angles = ticks.update(number * step % TICKS_MODULUS, 0, number * periods * PERIOD_US)
    assert angles == (count * step * PER_TICK, 0.0)


@examples(
    quick=30,
    every=100,
    jump=st.integers(LIMIT + 1, TICKS_MODULUS - LIMIT - 1),
    start=st.integers(0, TICKS_MODULUS - 1),
    wheel=st.sampled_from([0, 1]),
)
def test_a_jump_is_dropped_and_leaves_no_trace(jump, start, wheel):
    ticks = wheel_ticks(start, start)
    reading = [start, start]
    reading[wheel] = (start + jump) % TICKS_MODULUS
    assert ticks.update(*reading, PERIOD_US) is None
    back = ticks.update((start + 1) % TICKS_MODULUS, (start - 1) % TICKS_MODULUS, PERIOD_US)
    assert back == (PER_TICK, -PER_TICK)


def test_counters_that_stay_elsewhere_are_believed_after_a_while_without_motion():
    ticks = wheel_ticks(100, 100)
    ticks.update(110, 90, PERIOD_US)
    for number in range(2, REANCHOR_AFTER + 1):
        assert ticks.update(5_000_000 + number, 0, number * PERIOD_US) is None
    assert ticks.update(5_000_010, 0, 6 * PERIOD_US) == (10 * PER_TICK, -10 * PER_TICK)
    assert ticks.update(5_000_011, 1, 7 * PERIOD_US) == (11 * PER_TICK, -9 * PER_TICK)


def test_only_readings_in_a_row_make_the_counters_believed():
    ticks = wheel_ticks()
    for number in range(1, 20):
        odd = number % REANCHOR_AFTER
        angles = ticks.update(8_000_000 if odd else 0, 0, number * PERIOD_US)
        assert angles == (None if odd else (0.0, 0.0))


def test_more_time_since_the_last_good_reading_allows_more_motion():
    ticks = wheel_ticks()
    assert ticks.update(3 * LIMIT, 0, PERIOD_US) is None
    assert ticks.update(3 * LIMIT, 0, 4 * PERIOD_US) == (3 * LIMIT * PER_TICK, 0.0)


def test_the_angles_go_on_from_a_start_and_after_forgetting_from_where_they_are():
    ticks = WheelTicks(TICKS_PER_REV, MAX_SPEED_RAD_S, start=(3.0, -4.0))
    assert ticks.update(7, 7, 0) == ticks.angles == (3.0, -4.0)
    moved = pytest.approx((3.0 + 20 * PER_TICK, -4.0 + 10 * PER_TICK))
    assert ticks.update(27, 17, PERIOD_US) == moved
    ticks.clear()
    assert ticks.update(9_000_000, 77, 2 * PERIOD_US) == moved
