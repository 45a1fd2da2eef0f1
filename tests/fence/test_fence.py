"""A fence that cannot be meant is refused in one line that says what to write; the footprint has a sensible default."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from disco_hw.config import SHIPPED_ROBOT, load_daemon_address, load_robot_config
from disco_hw.errors import InputError
from disco_hw.fence import Circle, Fence, Footprint, area_m2, fence_fault

FOOTPRINT = Footprint(0.5, 0.4, 0.05)
ROOM = ((-2.0, -1.5), (2.0, -1.5), (2.0, 1.5), (-2.0, 1.5))
ROBOT_TEXT = (SHIPPED_ROBOT).read_text()


CROSSED = (ROOM[0], ROOM[2], ROOM[1], ROOM[3])


@pytest.mark.parametrize(
    ("fence", "field", "expected_fault"),
    [
        (Fence(keep_in=ROOM[:2]), "keep_in", "2 points make no polygon"),
        (Fence(keep_in=(*ROOM, ROOM[0])), "keep_in", "points 4 and 0 are the same, (-2, -1.5)"),
        (Fence(keep_in=CROSSED), "keep_in", "crosses itself near (0.00, 0.00): edges 0 and 2"),
        (Fence(keep_in=((0, 0), (4, 0), (2, 0), (2, 3))), "keep_in", "crosses itself near (4.00, 0.00): edges 0 and 1"),
        (Fence(keep_in=((2, 3), (0, 0), (4, 0), (2, 0))), "keep_in", "crosses itself near (4.00, 0.00): edges 1 and 2"),
        (Fence(keep_in=((4, 0), (2, 0), (2, 3), (0, 0))), "keep_in", "crosses itself near (4.00, 0.00): edges 0 and 3"),
        (Fence(keep_in=((0, 0), (4, 0), (4, 4), (2, 0), (0, 4))), "keep_in", "crosses itself near (2.00, 0.00)"),
        (Fence(keep_in=((-2000, -1500), (2000, -1500), (0, 1500))), "keep_in", "over 838 m from the origin"),
        (Fence(keep_in=((47.28, 8.56), (47.29, 8.56), (47.28, 8.57))), "keep_in", "too small for the robot"),
        (Fence(keep_in=((0, 0), (4, 0), (4, 0.3), (0, 0.3))), "keep_in", "too small for the robot"),
        (Fence(keep_in=((0, 0), (2, 2), (2, 2.05), (0, 0.05))), "keep_in", "too small for the robot"),
        (Fence(keep_in=Circle((0, 0), 0.31)), "keep_in", "too small for the robot, whose footprint is 0.5 m x 0.4 m"),
        (Fence(keep_in=ROOM, keep_out=(Circle((900, 0), 1.0),)), "keep_out[0]", "over 838 m"),
        (Fence(keep_out=(Circle((0, 0), 1.0), ROOM[:2])), "keep_out[1]", "2 points make no polygon"),
        (Fence(keep_out=(Circle((math.nan, 0), 1.0),)), "keep_out[0]", "point 0 is not a finite number"),
        (Fence(keep_in=((0, 0), (math.inf, 0), (1, 1))), "keep_in", "point 1 is not a finite number"),
    ],
)  # fmt: skip
def test_a_fence_that_cannot_be_meant_is_named(fence, field, expected_fault):
    fault = fence_fault(fence, FOOTPRINT)
    assert fault is not None
    assert (fault.field, expected_fault in fault.fault) == (field, True), fault
    assert fault.hint


@pytest.mark.parametrize(
    "fence",
    [
        Fence(),
        Fence(keep_in=ROOM),
        Fence(keep_in=ROOM[::-1]),
        Fence(keep_in=Circle((0, 0), 0.33)),
        Fence(keep_in=((0, 0), (4, 0), (4, 4), (2, 1), (0, 4))),
        Fence(keep_in=((838, 838), (0, 838), (838, 0))),
        Fence(keep_out=(ROOM, Circle((0, 0), 1.0))),
        # Half a metre and half a millimetre are both sizes of something that stands in the way.
        Fence(keep_out=(((0, 0), (0.002, 0), (0, 0.002)),)),
    ],
)
def test_a_fence_that_can_be_meant_is_taken(fence):
    assert fence_fault(fence, FOOTPRINT) is None


def test_a_fence_of_too_many_corners_is_refused():
    ring = tuple((2 * math.cos(k / 50 * math.pi), 2 * math.sin(k / 50 * math.pi)) for k in range(100))
    assert fence_fault(Fence(keep_in=ring, keep_out=(ring,)), FOOTPRINT) is None
    fault = fence_fault(Fence(keep_in=ring, keep_out=(ring, ring)), FOOTPRINT)
    assert fault is not None
    assert fault.fault == "300 corners in all are too many"


def test_the_area_is_that_of_the_shoelace():
    assert area_m2(ROOM) == pytest.approx(12.0)
    assert area_m2(ROOM[::-1]) == pytest.approx(12.0)
    assert area_m2(((1, 1), (3, 1), (1, 4))) == pytest.approx(3.0)


def test_the_footprint_knows_its_corners():
    corners = [value for corner in FOOTPRINT.corners_m() for value in corner]
    assert corners == pytest.approx([-0.2, -0.2, 0.3, -0.2, 0.3, 0.2, -0.2, 0.2])
    assert FOOTPRINT.reach_m == pytest.approx(math.hypot(0.3, 0.2))
    assert Footprint(0.5, 0.4, -0.05).reach_m == pytest.approx(math.hypot(0.3, 0.2))


def robot_toml(tmp_path, fence: str, task: str = "radius_m = 0.75", robot: str = "") -> Path:
    path = tmp_path / "robot.toml"
    text = ROBOT_TEXT.replace("radius_m = 0.75", task).replace('file = "wombot_model.toml"', "")
    path.write_text(text.replace("[prior]", f"{robot}\n[prior]", 1) + "\n[fence]\n" + fence)
    return path


def test_the_usual_footprint_is_made_from_the_wheels(tmp_path):
    robot = load_robot_config(robot_toml(tmp_path, "")).robot
    assert robot.footprint_m is None
    assert robot.footprint == Footprint(0.31 + 2 * 0.06, 0.31 + 0.06, 0.0)
    given = robot_toml(tmp_path, "", robot="footprint_m = { length = 0.50, width = 0.40, ahead = 0.05 }")
    assert load_robot_config(given).robot.footprint == FOOTPRINT


@pytest.mark.parametrize(
    ("fence", "expected_error"),
    [
        ("keep_in = [[-2, -1], [2, -1], [2, 1]]\nkeep_inn = 3", "keep_inn: no such field; did you mean keep_in?"),
        ("keep_in = [[-2, -1], [2]]", "fence.keep_in"),
        ("keep_in = { centre = [0, 0], radius_m = 2.0 }", "centre: no such field; did you mean center?"),
        ("keep_in = { center = [0, 0], radius_m = -2.0 }", "fence.keep_in.radius_m"),
        ("margin_m = -0.1", "fence.margin_m"),
        ("margin_m = nan", "fence.margin_m"),
        ("max_breach_probability = 0.0", "fence.max_breach_probability"),
        ("keep_in = [[-2, -1], [2, 1], [2, -1], [-2, 1]]", "fence.keep_in: crosses itself near (0.00, 0.00)"),
        ("keep_in = { center = [0, 0], radius_m = 0.9 }", "fence: the task starts at (0.75, 0.00), where"),
        ("keep_in = [[-0.9, -1.5], [1.5, -1.5], [1.5, 1.5], [-0.9, 1.5]]", "the task's line crosses it near (-0.7"),
        ("keep_out = [{ center = [0.0, 0.95], radius_m = 0.1 }]", "near (-0.16, 0.73): the footprint is 0.11 m"),
        ("keep_out = [[[-0.80, -0.05], [-0.7, -0.05], [-0.7, 0.05]]]", "the task's line crosses it near (-0.7"),
    ],
)  # fmt: skip
def test_robot_toml_says_what_is_wrong_with_a_fence(tmp_path, fence, expected_error):
    path = robot_toml(tmp_path, fence)
    with pytest.raises(InputError) as refusal:
        load_robot_config(path)
    assert str(refusal.value).startswith(f"{path}: ")
    assert expected_error in str(refusal.value)
    assert "\n" not in str(refusal.value)
    # Whoever asks the running daemon to stop does not have to mend it first.
    assert load_daemon_address(path)[0] == "wombot"


@pytest.mark.parametrize("task", ["radius_m = 0.75", "# radius_m = 0.75"])
def test_a_fence_around_the_task_is_taken(tmp_path, task):
    fence = "keep_in = { center = [0, 0], radius_m = 2.0 }\nkeep_out = [{ center = [0, 0], radius_m = 0.4 }]"
    config = load_robot_config(robot_toml(tmp_path, fence, task))
    assert config.fence.keep_in == Circle((0.0, 0.0), 2.0)
    assert config.fence.keep_out == (Circle((0.0, 0.0), 0.4),)
    assert (config.fence.margin_m, config.fence.max_breach_probability) == (0.05, 1e-3)
