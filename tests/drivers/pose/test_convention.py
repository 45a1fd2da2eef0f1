"""Poses in other units and about other axes, and the line of robot.toml that says so."""

from __future__ import annotations

import math

import pytest

from disco_hw.config import load_robot_config
from disco_hw.errors import InputError
from disco_hw.runtime import assembly
from disco_hw.runtime.assembly import driver_of, pose_source_of
from drivers.motor import RewiredDriver
from drivers.pose import PoseConvention
from drivers.pose.robot import RobotPoses
from drivers.types import PoseSample
from tests.config.test_robot import GOOD


@pytest.fixture
def load(tmp_path):
    def loaded(text):
        path = tmp_path / "robot.toml"
        path.write_text(GOOD + text, encoding="utf-8")
        return load_robot_config(path)

    return loaded


def test_millimetres_degrees_and_a_compass():
    reported = PoseSample(1, 2, 1500.0, -200.0, 30.0, 5.0, 2.0)
    found = PoseConvention("mm", "deg", clockwise=True, mirrored=True, yaw_offset_rad=math.pi / 2).converted(reported)
    assert (found.t_ns, found.received_ns) == (1, 2)
    assert (found.x_m, found.y_m, found.yaw_rad) == pytest.approx((1.5, 0.2, math.pi / 3))
    assert (found.position_std_m, found.yaw_std_rad) == pytest.approx((0.005, math.radians(2.0)))


def test_a_yaw_beyond_a_turn_is_the_same_yaw():
    reported = PoseSample(1, 2, 0.0, 0.0, 350.0, 0.0, 0.0)
    assert PoseConvention(yaw_unit="deg").converted(reported).yaw_rad == pytest.approx(math.radians(-10.0))


def test_robot_toml_says_it_and_the_source_converts(load):
    source = pose_source_of(load('[pose]\nposition_unit = "mm"\nclockwise = true\n'))
    (found,) = source.receive(3, [PoseSample(1, 2, 1000.0, 2000.0, 0.5, 5.0, 0.1)])
    assert (found.x_m, found.y_m, found.yaw_rad) == pytest.approx((1.0, 2.0, -0.5))
    source.close()


def test_a_source_takes_the_deviations_of_robot_toml_in_the_units_of_its_poses(load, monkeypatch):
    given = {}
    monkeypatch.setattr(assembly, "create_pose_source", lambda **fields: given.update(fields) or RobotPoses())
    text = 'source = "natnet"\nposition_unit = "mm"\nyaw_unit = "deg"\nposition_std_m = 0.02\nyaw_std_rad = 0.03\n'
    source = pose_source_of(load(f"[pose]\n{text}"))
    sample = PoseSample(1, 2, 1500.0, 200.0, 30.0, given["position_std_m"], given["yaw_std_rad"])
    (found,) = source.receive(3, [sample])
    assert (found.position_std_m, found.yaw_std_rad) == pytest.approx((0.02, 0.03))


def test_robot_toml_says_how_the_wheels_are_wired(load):
    assert isinstance(driver_of(load("[wheels]\nsides_swapped = true\nmotor_direction = [1, -1]\n")), RewiredDriver)
    assert not isinstance(driver_of(load("")), RewiredDriver)


@pytest.mark.parametrize(
    ("text", "expected_error"),
    [
        ("[wheels]\nmotor_direction = [1, 2]\n", "wheels.motor_direction"),
        ("[wheels]\nturn_ratio = 0.0\n", "wheels.turn_ratio"),
        ('[pose]\nposition_unit = "inch"\n', "pose.position_unit"),
        ("[pose]\noffset = [nan, 0.0]\n", r"pose\.offset: not a finite number; write"),
        ("[pose]\norigin = [0.0, inf, 0.0]\n", r"pose\.origin: not a finite number; write"),
    ],
)
def test_a_wrong_one_is_refused_by_its_name(load, text, expected_error):
    with pytest.raises(InputError, match=expected_error):
        load(text)


def test_a_sensor_ahead_of_the_tracked_point_in_a_frame_of_its_own():
    """Body at (3, 1) facing 120 degrees, sensor 0.5 m ahead and 0.2 m to the left, frame at (1, 2) turned by 90."""
    body, yaw = (3.0, 1.0), math.radians(120.0)
    cosine, sine = math.cos(yaw), math.sin(yaw)
    sensor = (body[0] + 0.5 * cosine - 0.2 * sine, body[1] + 0.5 * sine + 0.2 * cosine)
    # Turned back by 90 degrees: x' = y, y' = -x.
    reported = PoseSample(10**9, 2 * 10**9, sensor[1] - 2.0, -(sensor[0] - 1.0), yaw - math.pi / 2, 0.03, 0.1)
    convention = PoseConvention(origin=(1.0, 2.0, math.pi / 2), offset=(0.5, 0.2), latency_s=0.25)
    found = convention.converted(reported)
    assert (found.x_m, found.y_m, found.yaw_rad) == pytest.approx((*body, yaw))
    assert (found.t_ns, found.received_ns) == (750_000_000, 2 * 10**9)
    # Where the sensor is says less of where the tracked point is, the less certain the heading.
    assert found.position_std_m == pytest.approx(math.hypot(0.03, 0.1 * math.hypot(0.5, 0.2)))
    assert (found.lever_x_m, found.lever_y_m) == (0.0, 0.0)
    bare = convention.converted(PoseSample(10**9, 2 * 10**9, reported.x_m, reported.y_m, math.nan, 0.03, math.nan))
    assert (bare.x_m, bare.y_m) == pytest.approx(sensor)
    assert (bare.lever_x_m, bare.lever_y_m, bare.position_std_m) == (0.5, 0.2, 0.03)
    assert not bare.has_heading


def test_robot_toml_says_where_the_sensor_is(load):
    source = pose_source_of(load("[pose]\norigin = [1.0, 0.0, 0.0]\noffset = [0.5, 0.0]\nlatency_s = 0.1\n"))
    (found,) = source.receive(3, [PoseSample(10**9, 2, 1.0, 2.0, 0.0, 5.0, 0.1)])
    assert (found.t_ns, found.x_m, found.y_m) == (900_000_000, 1.5, 2.0)


@pytest.mark.parametrize(
    ("line", "other"), [('device = "/dev/ttyUSB1"', "nmea"), ("port = 5006", "udp"), ("datum = [47.0, 8.0]", "nmea")]
)
def test_a_field_of_another_source_is_refused_by_name(load, line, other):
    field = line.split()[0]
    with pytest.raises(InputError, match=rf'pose\.{field}: belongs to the source ".*", but pose\.source is "robot"'):
        load(f"[pose]\n{line}\n")
    assert load(f'[pose]\nsource = "{other}"\n{line}\n').pose.source == other
