"""What has no name goes into the model: the free run errs less, and DISCO plans with it."""

import math
from functools import cache

import numpy as np
import pytest

from disco_hw.control import CommandLimits, Disco, DiscoSettings, PlannerState, Sampler, SentCommand
from disco_hw.gap import find_gap
from disco_hw.model import Model, load_model, save_model
from disco_hw.model.step import FreeRun
from disco_hw.tasks.circle import CircleCost
from tools.gap.logs import simulated_drive

pytestmark = pytest.mark.long

MODEL = Model(0.061, 0.415, 0.238)
AHEAD_S, STEP_S = 2.0, 0.02


@cache
def report_of(name, size, seed=902):
    return find_gap(simulated_drive({name: size}, seed=seed), MODEL)


def rms_error_m(model, log):
    """Error of free runs of the whole model from the commands alone, 2 s ahead, by the model's own step (FreeRun)."""
    run = FreeRun(model, model.point()[None], STEP_S)
    ahead, squares = round(AHEAD_S / STEP_S), []
    for t0 in np.arange(3.0, log.poses.t_s[-1] - AHEAD_S - 1.0, 1.0):
        grid = t0 + STEP_S * np.arange(-50, ahead)
        index = np.clip(np.searchsorted(log.commands.t_s, grid + 1e-3, side="right") - 1, 0, None)
        commands = np.column_stack([log.commands.left_rad_s[index], log.commands.right_rad_s[index]])
        before, after = (int(np.argmin(np.abs(log.poses.t_s - t))) for t in (t0, t0 + AHEAD_S))
        wheel = int(np.argmin(np.abs(log.wheels.t_s - t0)))
        start = [
            log.poses.x_m[before], log.poses.y_m[before], log.poses.yaw_rad[before],
            log.wheels.left_speed_rad_s[wheel], log.wheels.right_speed_rad_s[wheel],
        ]  # fmt: skip
        states = run.states(np.array(start), commands, 50, float(t0))
        at = (log.poses.t_s[after] - log.poses.t_s[before]) / STEP_S
        end = [np.interp(at, np.arange(states.shape[0]), states[:, axis]) for axis in (0, 1)]
        squares.append((end[0] - log.poses.x_m[after]) ** 2 + (end[1] - log.poses.y_m[after]) ** 2)
    return math.sqrt(np.mean(squares))


@pytest.mark.parametrize(
    ("name", "size", "term"),
    [("x_speed_squared_drag", 0.6, "v_x += k v^3"), ("x_motor_droop", 0.012, "command += k u |u|")],
)
def test_the_form_that_was_found_closes_the_gap_on_another_drive(name, size, term, tmp_path):
    report = report_of(name, size)
    assert [setting.name for setting in report.model.effects] == [term]
    log, reach = simulated_drive({name: size}, seed=902), report.model.effects[0].values["reach"]
    if term.startswith("command"):
        # Of commands in force over a step, which is their mean.
        fastest = np.abs([log.commands.left_rad_s, log.commands.right_rad_s]).max()
        assert reach == pytest.approx(fastest**2, rel=1e-3)
    else:
        # Single readings scatter by a few percent, their cubes by three times that.
        fastest = np.abs(log.wheels.left_speed_rad_s + log.wheels.right_speed_rad_s).max()
        assert reach == pytest.approx((0.5 * report.model.wheel_radius_m * fastest) ** 3, rel=0.15)
    save_model(report.model, tmp_path / "model.toml")
    amended = load_model(tmp_path / "model.toml")
    other = simulated_drive({name: size}, seed=903, robot=902)
    plain = Model(amended.wheel_radius_m, amended.axial_distance_m, amended.x_icr_m)
    # The same robot without the effect: what the noise alone makes.
    floor = rms_error_m(plain, simulated_drive({}, seed=903, robot=902))
    before, after = rms_error_m(plain, other), rms_error_m(amended, other)
    assert before - after >= 0.7 * (before - floor), (before, after, floor)


def test_all_parameters_are_believed_jointly():
    belief = report_of("x_speed_squared_drag", 0.6).model.belief
    names = belief.names
    assert names == ("wheel_radius_m", "axial_distance_m", "x_icr_m", "v_x += k v^3.k")
    covariance = belief.covariance()
    assert np.linalg.eigvalsh(covariance).min() > 0.0
    # More drag and larger wheels look alike.
    correlation = covariance[0, 3] / math.sqrt(covariance[0, 0] * covariance[3, 3])
    assert correlation < -0.3


def test_a_term_that_the_model_has_already_is_not_found_again():
    amended = report_of("x_speed_squared_drag", 0.6).model
    again = find_gap(simulated_drive({"x_speed_squared_drag": 0.6}, seed=902), amended)
    assert not again.unnamed
    assert not again.effects
    assert again.gap["nominal"][2.0].position_m < 1.1 * again.gap["amended"][2.0].position_m
    assert again.model.effects[0].values["k"] == pytest.approx(amended.effects[0].values["k"], rel=0.05)
    assert "v_x += k v^3.k" in again.model.belief.names


def test_disco_plans_with_it_and_commands_what_the_term_takes_away():
    model = report_of("x_motor_droop", 0.012).model
    bare = Model(model.wheel_radius_m, model.axial_distance_m, model.x_icr_m)
    robot = FreeRun(model, model.point()[None], 0.1)
    commanded = {}
    for name, known in (("amended", model), ("bare", bare)):
        disco = Disco(
            known, CircleCost(speed_m_s=0.3), DiscoSettings(sampler=Sampler(samples=160, horizon=30), retries=0),
            CommandLimits(8.0, 20.0), 1,
        )  # fmt: skip
        state, sent = np.array([0.75, 0.0, math.pi / 2, 3.6, 6.3]), [(3.6, 6.3)] * 12
        for k in range(60):
            now_ns = k * 100_000_000
            last = SentCommand(now_ns, *sent[-1])
            plan = disco.plan(now_ns, PlannerState(now_ns, *state.tolist(), sent=(last,), elapsed_s=0.1 * k))
            sent.append(tuple(np.asarray(plan.wheel_speeds)[0].tolist()))
            state = robot.states(state, np.array(sent[-12:]), 11, 0.1 * k)[-1]
        assert math.hypot(*state[:2]) == pytest.approx(0.75, abs=0.02)
        commanded[name] = np.mean(sent[-40:])
    # Of 3.7 rad/s the term takes 4 %, of 6.4 rad/s 8 %.
    assert commanded["amended"] > 1.03 * commanded["bare"]
