"""Poses in other units and about other axes, and the line of robot.toml that says so."""

from __future__ import annotations

import math

import pytest

from disco_hw.config import load_robot_config
from disco_hw.errors import InputError
from disco_hw.runtime.assembly import driver_of, pose_source_of
from drivers.motor.wiring import RewiredDriver
from drivers.pose.convention import PoseConvention
from drivers.types import PoseSample

ROBOT = """[robot]
name = "bench"
wheel_radius_m = 0.06
axial_distance_m = 0.31
ticks_per_rev = 2048
max_wheel_speed_rad_s = 8.0
"""


@pytest.fixture
def load(tmp_path):
    def loaded(text):
        path = tmp_path / "robot.toml"
        path.write_text(ROBOT + text, encoding="utf-8")
        return load_robot_config(path)

    return loaded


def test_millimetres_degrees_and_a_compass():
    told = PoseSample(1, 2, 1500.0, -200.0, 30.0, 5.0, 2.0)
    found = PoseConvention("mm", "deg", clockwise=True, mirrored=True, yaw_offset_rad=math.pi / 2).converted(told)
    assert (found.t_ns, found.received_ns) == (1, 2)
    assert (found.x_m, found.y_m, found.yaw_rad) == pytest.approx((1.5, 0.2, math.pi / 3))
    assert (found.position_std_m, found.yaw_std_rad) == pytest.approx((0.005, math.radians(2.0)))


def test_a_yaw_beyond_a_turn_is_the_same_yaw():
    told = PoseSample(1, 2, 0.0, 0.0, 350.0, 0.0, 0.0)
    assert PoseConvention(yaw_unit="deg").converted(told).yaw_rad == pytest.approx(math.radians(-10.0))


def test_robot_toml_says_it_and_the_source_converts(load):
    source = pose_source_of(load('[pose]\nposition_unit = "mm"\nclockwise = true\n'))
    (found,) = source.receive(3, [PoseSample(1, 2, 1000.0, 2000.0, 0.5, 5.0, 0.1)])
    assert (found.x_m, found.y_m, found.yaw_rad) == pytest.approx((1.0, 2.0, -0.5))
    source.close()


def test_robot_toml_says_how_the_wheels_are_wired(load):
    assert isinstance(driver_of(load("[wheels]\nsides_swapped = true\nmotor_direction = [1, -1]\n")), RewiredDriver)
    assert not isinstance(driver_of(load("")), RewiredDriver)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("[wheels]\nmotor_direction = [1, 2]\n", "wheels.motor_direction"),
        ("[wheels]\nturn_ratio = 0.0\n", "wheels.turn_ratio"),
        ('[pose]\nposition_unit = "inch"\n', "pose.position_unit"),
    ],
)
def test_a_wrong_one_is_refused_by_its_name(load, text, named):
    with pytest.raises(InputError, match=named):
        load(text)
