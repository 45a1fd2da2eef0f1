import math

import pytest

from drivers.limits import check_limits
from drivers.types import Capabilities

ROBOT = Capabilities(1, 0, "0.1.0", 0x1234, 1, 8.0, 20.0, 2048, 0.1, 0.5, 20.0)


def test_within_or_equal_is_fine():
    assert check_limits(ROBOT, 8.0, 20.0, 2048) == []
    assert check_limits(ROBOT, 8.0019, 20.009, 2048) == []
    assert check_limits(ROBOT, 1.0, 1.0, 2048) == []


@pytest.mark.parametrize(
    ("speed", "acceleration", "ticks", "field", "remedy"),
    [
        (8.01, 20.0, 2048, "robot.max_wheel_speed_rad_s: 8.01", "write at most 8,"),
        (8.0, 25.0, 2048, "robot.max_wheel_acceleration_rad_s2: 25", "write at most 20,"),
        (8.0, 20.0, 1024, "robot.ticks_per_rev: 1024", "write 2048,"),
        (math.nan, 20.0, 2048, "robot.max_wheel_speed_rad_s: nan", "write at most 8,"),
    ],
)
def test_what_does_not_fit_is_one_line_with_field_and_remedy(speed, acceleration, ticks, field, remedy):
    (line,) = check_limits(ROBOT, speed, acceleration, ticks)
    assert field in line
    assert remedy in line
    assert "\n" not in line


def test_every_error_is_told_at_once():
    assert len(check_limits(ROBOT, 9.0, 21.0, 1)) == 3
