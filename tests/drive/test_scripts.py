"""The scripts of `disco-hw drive`: within the limits, seeded, and driving what they say."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from disco_hw.config import Robot
from disco_hw.drive.script import room_needed
from disco_hw.drive.scripts import SCRIPTS, SEPARATING, STEP_S, STEPS, create_script
from disco_hw.effects.registry import REGISTRY
from disco_hw.errors import InputError
from disco_hw.estimation.odometry import OdometryParameters, Pose, arc, moved
from disco_hw.runtime.pipeline import Governor, WheelLimits
from disco_hw.tasks.circle import CircleTask


def robot(top=8.0, **fields):
    return Robot(
        name="r", wheel_radius_m=0.06, axial_distance_m=0.31, ticks_per_rev=2048, max_wheel_speed_rad_s=top, **fields
    )


@given(
    st.sampled_from(["steps", "excite", *SEPARATING]), st.floats(0.5, 60.0), st.floats(0.05, 1.0), st.integers(0, 1000)
)
def test_wheels_stay_within_the_share_of_the_limit(name, top, share, seed):
    script = create_script(name, robot(top), CircleTask(), share, seed)
    for k in range(0, math.ceil(script.duration_s * 5)):
        assert max(map(abs, script.at(k * 0.2))) <= top * share * (1 + 1e-12)


@pytest.mark.parametrize("name", SCRIPTS)
def test_scripts_end_at_rest_say_what_for_and_take_a_minute_at_most_where_a_report_asks_for_them(name):
    script = create_script(name, robot(), CircleTask(), 0.8)
    assert name not in SEPARATING or script.duration_s <= 60.0
    assert script.at(script.duration_s - 0.01) == (0.0, 0.0)
    assert all(manoeuvre.purpose for manoeuvre in script.manoeuvres)


def test_the_circle_is_the_tasks_circle():
    task = CircleTask(radius_m=0.75, speed_m_s=0.2)
    script = create_script("circle", robot(), task, 0.8)
    room = room_needed(script, robot())
    assert room.x_m == pytest.approx((-0.75, 0.75), abs=0.01)
    assert room.y_m == pytest.approx((0.0, 1.5), abs=0.01)


def test_a_circle_beyond_the_wheels_is_refused():
    with pytest.raises(InputError, match=r"max_wheel_speed_rad_s.*lower"):
        create_script("circle", robot(), CircleTask(radius_m=0.05, speed_m_s=0.3), 0.8)


def test_a_circle_beyond_the_share_of_the_limit_is_refused():
    task = CircleTask(radius_m=0.75, speed_m_s=0.38)
    fastest = (task.speed_m_s + task.speed_m_s / task.radius_m * 0.155) / 0.06
    create_script("circle", robot(), task, fastest / 8.0 + 1e-6)
    with pytest.raises(InputError, match=r"drive\.speed_share.*lower task\.speed_m_s"):
        create_script("circle", robot(), task, fastest / 8.0 - 1e-6)


def steps_of(seed):
    script = create_script("steps", robot(), CircleTask(), 1.0, seed)
    return script, [manoeuvre for manoeuvre in script.manoeuvres if manoeuvre.within_limits]


def test_steps_are_drawn_from_the_seed_and_spread_over_the_square():
    first, again, other = ([step.wheels(0.0) for step in steps_of(seed)[1]] for seed in (1, 1, 2))
    assert first == again != other
    script, steps = steps_of(1)
    assert [step.duration_s for step in steps] == [STEP_S] * STEPS
    begins_s = script.duration_s - 0.6 - STEPS * STEP_S
    assert script.at(begins_s) == script.at(begins_s + 5.99) == first[0] != script.at(begins_s + 6.01)
    assert len({(left > 0.0, right > 0.0) for left, right in first}) == 4


def test_steps_begin_with_the_search_for_the_limits_of_each_wheel_both_ways():
    script, _ = steps_of(1)
    search = [manoeuvre for manoeuvre in script.manoeuvres if manoeuvre.finds_limits]
    assert {manoeuvre.wheels(0.0) for manoeuvre in search} == {(8, 8), (-8, -8), (-8, 8), (8, -8)}
    # From rest to 8 rad/s at 20 rad/s^2, and 2 s to see what is reached.
    assert {manoeuvre.duration_s for manoeuvre in search} == {2.4}
    assert script.manoeuvres[:8:2] == tuple(search)


def test_excite_takes_about_two_minutes_and_little_room():
    script = create_script("excite", robot(), CircleTask(), 0.8)
    assert 100.0 < script.duration_s < 150.0
    room = room_needed(script, robot())
    assert room.x_m[1] - room.x_m[0] < 4.0
    assert room.y_m[1] - room.y_m[0] < 4.0


@pytest.mark.parametrize(
    ("name", "acceleration", "x_icr_m"),
    [("excite", 20.0, 0.0), ("excite", 5.0, 0.2), ("excite", 2.0, 0.0), ("steps", 2.0, 0.0), ("separate", 2.0, 0.2)],
)
def test_the_room_is_what_the_governor_lets_the_robot_take(name, acceleration, x_icr_m):
    slow = robot(max_wheel_acceleration_rad_s2=acceleration, x_icr_m=x_icr_m)
    script = create_script(name, slow, CircleTask(), 0.8)
    governor = Governor(WheelLimits(8.0, acceleration, acceleration), 0.02)
    geometry, pose, ways = OdometryParameters(0.06, 0.31, x_icr_m), Pose(0.0, 0.0, 0.0), [(0.0, 0.0)]
    for k in range(math.ceil(script.duration_s / 0.02)):
        sent = governor.step(*script.at(k * 0.02), 0.02)
        pose = moved(pose, arc(geometry, sent.left_rad_s * 0.02, sent.right_rad_s * 0.02))
        ways.append((pose.x_m, pose.y_m))
    room = room_needed(script, slow)
    assert [room.x_m, room.y_m] == pytest.approx(np.transpose([np.min(ways, 0), np.max(ways, 0)]), abs=0.06)


@pytest.mark.parametrize("name", SCRIPTS)
@pytest.mark.parametrize("acceleration", [20.0, 2.0])
def test_slow_wheels_reach_the_speed_of_each_held_manoeuvre_and_stand_after_each_rest(name, acceleration):
    script = create_script(name, robot(max_wheel_acceleration_rad_s2=acceleration), CircleTask(), 0.8)
    governor = Governor(WheelLimits(8.0, acceleration, acceleration), 0.02)
    for manoeuvre in script.manoeuvres:
        desired = [manoeuvre.wheels(k * 0.02) for k in range(round(manoeuvre.duration_s / 0.02))]
        sent = [governor.step(*wheels, 0.02) for wheels in desired][-1]
        if len(set(desired)) == 1:
            assert (sent.left_rad_s, sent.right_rad_s) == pytest.approx(desired[0])


def test_an_unknown_script_is_refused_with_the_names_there_are():
    with pytest.raises(InputError, match="circle, steps, excite"):
        create_script("dance", robot(), CircleTask(), 0.8)


def test_every_effect_names_a_script_that_can_be_driven():
    assert {effect.script for effect in REGISTRY.values()} <= set(SCRIPTS)
