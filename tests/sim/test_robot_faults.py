"""What sensors, motors and battery say under faults; the truth stays with the plant."""

import math

import pytest

from firmware_protocol.firmware_core import FirmwareInputs
from sim.fault_schedule import parse_schedule
from sim.pose_sensor import PoseMeasurement
from sim.robot_faults import RobotFaults


def fault(kind, **values):
    fields = "".join(f'{k} = "{v}"\n' if isinstance(v, str) else f"{k} = {v}\n" for k, v in values.items())
    lasts = "" if kind == "encoder_jump" else "for_s = 1\n"
    return parse_schedule(f'[[fault]]\nkind = "{kind}"\nat_s = 0\n{lasts}{fields}').faults[0]


def inputs(left, right=1000, speed=3.0):
    return FirmwareInputs(
        left_ticks=left, right_ticks=right, left_speed_rad_s=speed, right_speed_rad_s=speed, left_current_a=1.0
    )


def seen(faults, left, setpoints=(3.0, 3.0)):
    return faults.inputs(inputs(left), setpoints, True)


def pose(us, x=1.0):
    return PoseMeasurement(us, us, x, 2.0, 0.5, 0.01, 0.01)


def test_without_faults_nothing_is_touched():
    faults, given = RobotFaults(), inputs(500)
    assert faults.inputs(given, (3.0, 3.0), True) is given
    poses = [pose(0)]
    assert faults.poses(0, poses) is poses
    assert faults.setpoints(1.0, 2.0) == (1.0, 2.0)


def test_a_stuck_encoder_loses_what_it_did_not_count():
    faults = RobotFaults()
    faults.set_active([fault("encoder_stuck", wheel="left")])
    assert [seen(faults, ticks).left_ticks for ticks in (100, 200, 300)] == [100, 100, 100]
    assert seen(faults, 300).left_speed_rad_s == 0.0
    assert seen(faults, 300).right_speed_rad_s == 3.0
    faults.set_active([])
    assert [seen(faults, ticks).left_ticks for ticks in (300, 350)] == [100, 150]
    assert seen(faults, 350).left_speed_rad_s == 3.0


def test_a_reversed_encoder_counts_down_without_a_jump_and_up_again():
    faults = RobotFaults()
    faults.set_active([fault("encoder_reversed", wheel="left")])
    assert [seen(faults, ticks).left_ticks for ticks in (100, 110, 130)] == [100, 90, 70]
    assert seen(faults, 130).left_speed_rad_s == -3.0
    faults.set_active([])
    assert [seen(faults, ticks).left_ticks for ticks in (130, 140)] == [70, 80]


def test_a_jump_stays():
    faults = RobotFaults()
    faults.set_active([], [fault("encoder_jump", wheel="right", ticks=5000)])
    assert seen(faults, 0).right_ticks == 6000
    assert seen(faults, 0).right_ticks == 6000
    assert seen(faults, 0).left_ticks == 0


def test_a_short_counter_wraps():
    faults = RobotFaults()
    faults.set_active([fault("encoder_wrap", wheel="left", bits=8)])
    assert [seen(faults, ticks).left_ticks for ticks in (250, 255, 256, 600)] == [250, 255, 0, 88]


def test_a_stalled_motor_does_not_turn_and_draws_current_while_it_is_asked_to():
    faults = RobotFaults()
    faults.set_active([fault("motor_stall", wheel="left")])
    assert faults.setpoints(3.0, 3.0) == (0.0, 3.0)
    assert seen(faults, 0, (-3.0, 3.0)).left_current_a == -18.0
    assert seen(faults, 0, (0.0, 3.0)).left_current_a == 1.0
    assert faults.inputs(inputs(0), (3.0, 3.0), False).left_current_a == 1.0


def test_a_sagging_battery_stops_at_nothing():
    faults = RobotFaults()
    faults.set_active([fault("battery_sag", drop_v=6.0)])
    assert seen(faults, 0).voltage_v == 18.0
    faults.set_active([fault("battery_sag", drop_v=60.0)])
    assert seen(faults, 0).voltage_v == 0.0


@pytest.mark.parametrize(
    ("kind", "values", "expected"),
    [
        ("pose_jump", {"dx_m": 2.0, "dy_m": -1.0, "dyaw_rad": 3.0}, (3.0, 1.0, 3.5 - 2 * math.pi)),
        ("pose_swapped", {}, (2.0, 1.0, 0.5)),
        ("pose_nan", {}, (math.nan, 2.0, math.nan)),
    ],
)
def test_poses_that_are_wrong(kind, values, expected):
    faults = RobotFaults()
    faults.set_active([fault(kind, **values)])
    (found,) = faults.poses(0, [pose(0)])
    assert (found.x_m, found.y_m, found.yaw_rad) == pytest.approx(expected, nan_ok=True)
    assert found.sample_us == 0


def test_a_frozen_sensor_repeats_the_last_pose_under_new_stamps():
    faults = RobotFaults()
    faults.poses(0, [pose(0, 1.0)])
    faults.set_active([fault("pose_frozen")])
    (found,) = faults.poses(40, [pose(40, 1.5)])
    assert (found.x_m, found.sample_us) == (1.0, 40)


def test_late_poses_keep_their_stamps_and_their_order_and_none_is_lost():
    faults = RobotFaults()
    faults.set_active([fault("pose_late", delay_s=0.1)])
    assert faults.poses(0, [pose(0)]) == []
    assert faults.poses(99_999, [pose(40_000)]) == []
    assert [p.sample_us for p in faults.poses(100_000, [])] == [0]
    faults.set_active([])
    assert [p.sample_us for p in faults.poses(200_000, [pose(200_000)])] == [40_000, 200_000]


def test_a_silent_sensor_says_nothing():
    faults = RobotFaults()
    faults.set_active([fault("pose_silent")])
    assert faults.poses(0, [pose(0)]) == []
