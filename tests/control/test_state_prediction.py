"""Where a plan begins: from commands that the wheels follow as far as the model says that they do."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from disco_hw.config import SHIPPED_ROBOT, load_robot_config
from disco_hw.control import CommandLimits, DiscoSettings
from disco_hw.control.plan import PlannerState, PlanOutcome, SentCommand
from disco_hw.control.rollout_points import RolloutPoints
from disco_hw.control.state_prediction import StatePrediction
from disco_hw.model import EffectSetting, Model
from disco_hw.model.step import FreeRun
from disco_hw.runtime.assembly import create_planner
from disco_hw.tasks.circle import CircleTask

LIMITS, USUAL = CommandLimits(8.0, 2.0), DiscoSettings()
DEAD_BAND = EffectSetting("deadband", {"width_rad_s": 0.8})
MODEL = Model(0.06, 0.31, 0.0)


def anchor(*effects, sent=(0.7, -0.7), wheels=(0.0, 0.0), settings=USUAL):
    model = replace(MODEL, effects=effects)
    prediction = StatePrediction(RolloutPoints(model, settings, LIMITS, 1), settings, LIMITS)
    state = PlannerState(0, 0.0, 0.0, 0.0, *wheels, sent=(SentCommand(0, *sent),))
    return prediction.anchor(state, 0.0)


def test_without_commands_before_it_is_what_the_wheels_do():
    prediction = StatePrediction(RolloutPoints(MODEL, USUAL, LIMITS, 1), USUAL, LIMITS)
    assert prediction.anchor(PlannerState(0, 0.0, 0.0, 0.0, 0.3, -0.2), 0.0) == (0.3, -0.2)


def test_wheels_that_are_held_back_hold_the_plan_back():
    # In a step of 0.1 s the wheels change by 0.2 rad/s.
    assert anchor() == pytest.approx((0.2, -0.2))
    assert anchor(wheels=(0.6, -0.6)) == pytest.approx((0.7, -0.7))
    # The wheels of this model turn at 4.2: what keeps them from that is none of the dead band's.
    assert anchor(DEAD_BAND, sent=(5.0, -5.0)) == pytest.approx((1.0, -1.0))


def test_wheels_that_stand_as_the_model_says_do_not():
    assert anchor(DEAD_BAND) == pytest.approx((0.7, -0.7))
    assert anchor(EffectSetting("stiction", {"threshold_rad_s": 1.0})) == pytest.approx((0.7, -0.7))
    assert anchor(EffectSetting("wheel_gain", {"left": -0.5, "right": -0.5}), sent=(1.0, 1.0), wheels=(0.5, 0.5)) == (
        1.0,
        1.0,
    )


def test_the_papers_mode_is_as_it_was():
    assert anchor(DEAD_BAND, settings=DiscoSettings.paper()) == anchor(settings=DiscoSettings.paper())


def driven(effects, model, robot, task, duration_s):
    """The way (m) of a robot that is as the model says, and how far off the circle its second half is (RMS, m)."""
    config = load_robot_config(SHIPPED_ROBOT)
    robot = msgspec.structs.replace(
        config.robot,
        wheel_radius_m=model.wheel_radius_m,
        axial_distance_m=model.axial_distance_m,
        x_icr_m=model.x_icr_m,
        **robot,
    )
    config = msgspec.structs.replace(config, robot=robot, task=task)
    model = replace(model, effects=effects)
    planner, step_s = create_planner(config, model), 1.0 / config.control.rate_hz
    run = FreeRun(model, model.point()[None], step_s)
    state = np.array([*config.task_start, 0.0, 0.0])
    history, sent, way_m, away_m = [np.zeros(2)] * run.past_rows, [], 0.0, []
    change = robot.max_wheel_acceleration_rad_s2 * step_s
    command = np.zeros(2)
    for k in range(round(duration_s / step_s)):
        now_ns = round(k * step_s * 1e9)
        plan = planner.plan(now_ns, PlannerState(now_ns, *state, sent=tuple(sent[-100:]), elapsed_s=k * step_s))
        assert plan.diagnostics.outcome is not PlanOutcome.STOPPING
        command = command + np.clip(np.subtract(plan.at(now_ns), command), -change, change)
        sent.append(SentCommand(now_ns, *command))
        history.append(command)
        before, state = state, run.states(state, np.array(history[-run.past_rows - 1 :]), run.past_rows, k * step_s)[-1]
        way_m += np.hypot(*(state - before)[:2])
        away_m.append(np.hypot(state[0] - task.center_x_m, state[1] - task.center_y_m) - task.radius_m)
    return way_m, float(np.sqrt(np.mean(np.square(away_m[len(away_m) // 2 :]))))


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("effect", "acceleration_rad_s2"),
    [
        (DEAD_BAND, 2.0),
        (EffectSetting("stiction", {"threshold_rad_s": 1.3}), 4.0),
        (EffectSetting("wheel_gain", {"left": -0.3, "right": -0.3}), 2.0),
    ],
    ids=lambda one: getattr(one, "name", str(one)),
)
def test_a_robot_whose_wheels_do_not_turn_as_commanded_drives_where_the_model_knows_it(effect, acceleration_rad_s2):
    limits = {"max_wheel_speed_rad_s": 8.0, "max_wheel_acceleration_rad_s2": acceleration_rad_s2}
    way_m, rms_m = driven((effect,), MODEL, limits, CircleTask(), 15.0)
    assert way_m > 0.85 * 0.2 * 15.0
    assert rms_m < 0.005


@pytest.mark.thorough
@pytest.mark.parametrize(("x_icr_m", "radius_m", "speed_m_s"), [(0.8, 2.0, 0.2), (1.2, 3.0, 0.5)])
def test_a_robot_whose_tracked_point_lies_far_behind_stays_on_its_circle(x_icr_m, radius_m, speed_m_s):
    limits = {"max_wheel_speed_rad_s": 8.0, "max_wheel_acceleration_rad_s2": 20.0}
    task = CircleTask(radius_m=radius_m, speed_m_s=speed_m_s)
    way_m, rms_m = driven((), Model(0.3, 2.0, x_icr_m), limits, task, 60.0)
    assert way_m > 0.9 * speed_m_s * 60.0
    assert rms_m < 0.01
