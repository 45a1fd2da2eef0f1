"""A robot whose wheels depend on where their command comes from, driven by DISCO with a model that remembers that."""

from collections import deque
from dataclasses import replace

import numpy as np
import pytest

from disco_hw.control import CommandLimits, Disco, DiscoSettings, PlannerState, Sampler, SentCommand
from disco_hw.control.past_motion import DriveMeans
from disco_hw.model import EffectSetting, Model, load_model, plain, save_model
from disco_hw.tasks.circle import CircleCost

TICK_S, TICK_NS = 0.02, 20_000_000
HIDDEN = "command += k sign(u - mean_0.3s(u))"
# The last ones add nothing; the kernel is the one that other tests compile.
MODEL = Model(
    0.06, 0.5, 0.1,
    effects=(
        EffectSetting("motor_lag", {"tau_s": 0.1}), EffectSetting("command_delay", {"delay_s": 0.13}),
        EffectSetting(HIDDEN, {"k": -0.9}),
        *(
            EffectSetting(name, {"k": 0.0})
            for name in (
                "command += k u mean_1s(|u| + |u_other|)", "omega += k (omega - mean_1s(omega))",
                "v_x += k (v - slewed_1.25(v))", "v_x += k v^3",
            )
        ),
    ),
)  # fmt: skip
# What is sampled remembers; a refined plan is made anew in each tick.
SETTINGS = DiscoSettings(
    sampler=Sampler(samples=160, horizon=30), uncertainty="point", iterations_at_start=1, retries=0, refine=False
)
TURNING_S, AHEAD_STEPS = 1.0, 8


def misses(disco, model):
    """Drive to and fro between two circles; how far plans were off where the robot was 0.8 s later (m, rad)."""
    truth = plain.theta_of(MODEL.parameter_names, MODEL.point())
    state, means = plain.RobotState(0.75, 0.0, 1.6, 0.0, 0.0), DriveMeans.of(model)
    sent: deque[SentCommand] = deque()
    path, plans = [], []
    asked = [np.zeros(2)] * round(0.13 / TICK_S + 1.0)
    for k in range(260):
        path.append((state.x, state.y, state.yaw))
        if k and k % round(TURNING_S / TICK_S) == 0:
            radius_m = 0.75 if k // round(TURNING_S / TICK_S) % 2 == 0 else 0.3
            disco.set_task(CircleCost(path[-1][0] - radius_m, path[-1][1], radius_m))
        means.add_wheels(state.wheel_left, state.wheel_right, TICK_S)
        now = PlannerState(
            k * TICK_NS, state.x, state.y, state.yaw, state.wheel_left, state.wheel_right, tuple(sent), TICK_S * k,
            command_means=means.commands, body_means=means.body,
        )  # fmt: skip
        plan = disco.plan(k * TICK_NS, now)
        plans.append(plan.trajectory[AHEAD_STEPS])
        command = np.array(plan.at(k * TICK_NS))
        sent.append(SentCommand(k * TICK_NS, *command.tolist()))
        if len(sent) > 100:
            gone = sent.popleft()
            means.add_command(gone.left_rad_s, gone.right_rad_s, TICK_S)
        asked.append(command)
        # 0.13 s are six and a half ticks.
        left, right = 0.5 * (asked[-7] + asked[-8])
        state, _, _ = plain.step(truth, state, float(left), float(right), TICK_S, TICK_S * k)
    ahead = round(AHEAD_STEPS * SETTINGS.step_s / TICK_S)
    # A plan is what is meant to be driven; the next ones change it, alike for both models.
    off = np.array(plans[:-ahead]) - np.array(path[ahead:])
    return np.sqrt(np.mean(off[:, :2] ** 2)), np.sqrt(np.mean(off[:, 2] ** 2))


@pytest.mark.thorough
def test_plans_of_a_model_that_remembers_are_what_the_robot_then_does(tmp_path):
    save_model(MODEL, tmp_path / "model.toml")
    found = {}
    for name, k in (("written", -0.9), ("without", 0.0)):
        model = load_model(tmp_path / "model.toml")
        setting = EffectSetting(HIDDEN, {"k": k})
        model = replace(model, effects=tuple(setting if one.name == HIDDEN else one for one in model.effects))
        disco = Disco(model, CircleCost(0.0, 0.0, 0.75), SETTINGS, CommandLimits(8.0, 20.0), 1)
        found[name] = misses(disco, model)
    assert found["written"][0] < 0.7 * found["without"][0]
    assert found["written"][1] < 0.7 * found["without"][1]
