"""What `ctl` asks a daemon for, and what it does not even send."""

import pytest

from disco_hw.config import SHIPPED_ROBOT
from disco_hw.daemon import ask, describe_controller
from disco_hw.errors import InputError, WorkError


@pytest.mark.parametrize(
    ("action", "changes", "message"),
    [
        ("jump", (), "jump: no such request"),
        ("drive", ("forward=1",), "drive: no such request"),
        ("task", (), "name what to change"),
        ("arm", ("radius_m=1",), "arm takes no further arguments"),
        ("task", ("radius_m",), "radius_m: not a change"),
        ("task", ("radius_m=wide",), "radius_m=wide: not a change"),
        ("task", ("radius_m=nan",), "radius_m=nan: not a change"),
        ("task", ("do=1",), "do=1: not a change"),
    ],
)
def test_what_is_no_request_is_not_sent(action, changes, message):
    with pytest.raises(InputError, match=message):
        ask(SHIPPED_ROBOT, action, changes)


@pytest.mark.parametrize("robot", ["no daemon", "no robot.toml"])
def test_an_estop_that_reaches_nobody_says_what_does(tmp_path, robot):
    path = tmp_path / "my robot.toml"
    if robot == "no daemon":
        path.write_text(SHIPPED_ROBOT.read_text() + f'[daemon]\ncontrol_socket = "{tmp_path / "none"}"\n')
    error = WorkError if robot == "no daemon" else InputError
    with pytest.raises(error, match=rf"NOT SENT: use `disco-hw estop '{path}'` .*button, now"):
        ask(path, "estop")
    with pytest.raises((InputError, WorkError)) as other:
        ask(path, "status")
    assert "NOT SENT" not in str(other.value)


def test_only_arming_is_done_unrecorded():
    with pytest.raises(InputError, match="--unrecorded: belongs to arm, not to start"):
        ask(SHIPPED_ROBOT, "start", unrecorded=True)


def test_a_status_says_of_each_limit_who_says_it():
    assert describe_controller(None) == ()
    limits = {
        "max_wheel_speed_rad_s": {"value": 15.0, "said_by": "robot.toml"},
        "command_timeout_s": {"value": 0.5, "said_by": "fixed"},
        "stop_deceleration_rad_s2": {"value": 10.0, "said_by": "robot.toml"},
    }
    assert describe_controller({"words": "AgileX base", "limits": limits})[1] == (
        "limits: max_wheel_speed_rad_s 15, stop_deceleration_rad_s2 10 (declared in robot.toml, not reported by "
        "the controller); command_timeout_s 0.5 (which cannot be set otherwise)"
    )
