"""One tick: who asks for the wheel speeds, what the governor makes of it, and what the planner is given."""

from __future__ import annotations

import math

import numpy as np
import pytest

from disco_hw.config import Estimation
from disco_hw.control import Diagnostics, NoValidControl
from disco_hw.control.past_motion import DriveMeans
from disco_hw.estimation import PoseFusion
from disco_hw.estimation.odometry import OdometryParameters
from disco_hw.fence import Fence, Footprint
from disco_hw.fence.clearance import Boundaries
from disco_hw.model import EffectSetting, Model
from disco_hw.runtime.fence_guard import FenceGuard, StoppingSettings
from disco_hw.runtime.pipeline import (
    FollowTask,
    Governor,
    Limited,
    Manual,
    Off,
    Pipeline,
    Source,
    Standstill,
    WheelLimits,
)
from drivers.types import PoseSample, Readings, WheelSample

PERIOD_NS = 20_000_000


class StraightPlan:
    """A plan of one speed for both wheels."""

    def __init__(self, t0_ns: int, speed: float) -> None:
        self.t0_ns, self.speed = t0_ns, speed
        self.diagnostics = Diagnostics(1.0, 0.0, 0.0, 0.0, 0.0, 1)

    def at(self, t_ns: int) -> tuple[float, float]:
        return self.speed, self.speed


class Scripted:
    """A planner whose plans are given: a speed, or None for no valid control."""

    def __init__(self, *speeds: float | None) -> None:
        self.speeds = list(speeds)
        self.states = []
        self.resets = 0

    def plan(self, now_ns, state):
        self.states.append(state)
        speed = self.speeds.pop(0) if self.speeds else None
        if speed is None:
            raise NoValidControl("nothing left")
        return StraightPlan(now_ns, speed)

    def reset(self) -> None:
        self.resets += 1


def create_pipeline(planner, plan_tail_s: float = 0.06, means: DriveMeans | None = None) -> Pipeline:
    fusion = PoseFusion(Estimation(), OdometryParameters(0.06, 0.4, 0.0), 0.05)
    guard = FenceGuard(Boundaries(Footprint(0.5, 0.4, 0.1), Fence()), StoppingSettings(0.05, 0.1, 20.0, 0.02), 0.05)
    return Pipeline(fusion, planner, Governor(WheelLimits(8.0, 20.0, 20.0), 0.02), plan_tail_s, guard, means=means)


def run(pipeline: Pipeline, motions, start: int = 0):
    return [pipeline.step((start + k) * PERIOD_NS, Readings(), motion) for k, motion in enumerate(motions)]


def test_standing_and_off_ask_for_zero():
    ticks = run(create_pipeline(Scripted()), [Off(), Standstill()])
    assert [tick.source for tick in ticks] == [Source.OFF, Source.HOLD]
    assert [(tick.requested, tick.plan) for tick in ticks] == [((0.0, 0.0), None)] * 2


def test_a_plan_is_followed_within_the_acceleration_limit():
    ticks = run(create_pipeline(Scripted(2.0, 2.0, 2.0)), [Off(), FollowTask(), FollowTask()])
    assert ticks[1].source is Source.PLAN
    assert ticks[1].requested == (2.0, 2.0)
    assert ticks[1].command.left_rad_s == pytest.approx(0.4)
    assert ticks[2].command.left_rad_s == pytest.approx(0.8)
    assert Limited.ACCELERATION in ticks[2].command.limited


def test_a_missing_plan_is_followed_on_its_tail_then_the_wheels_ramp_to_zero():
    ticks = run(create_pipeline(Scripted(0.4), plan_tail_s=0.06), [Off(), *[FollowTask()] * 6])
    assert [tick.source for tick in ticks[1:]] == [Source.PLAN, *[Source.TAIL] * 3, *[Source.RAMP] * 2]
    assert ticks[4].requested == (0.4, 0.4)
    assert ticks[5].requested == (0.0, 0.0)
    assert ticks[2].planner_failure == "nothing left"


def test_a_planner_that_never_found_anything_moves_nothing():
    ticks = run(create_pipeline(Scripted()), [Off(), *[FollowTask()] * 3])
    assert {tick.source for tick in ticks[1:]} == {Source.RAMP}
    assert all(tick.command.left_rad_s == 0.0 for tick in ticks)


def test_the_planner_starts_anew_after_every_pause_which_no_old_plan_outlives():
    planner = Scripted(*[1.0] * 10)
    run(create_pipeline(planner), [Off(), FollowTask(), FollowTask(), Standstill(), FollowTask()])
    assert planner.resets == 2
    ticks = run(create_pipeline(Scripted(1.0)), [Off(), FollowTask(), Standstill(), FollowTask()])
    assert ticks[3].source is Source.RAMP


def test_manual_speeds_pass_the_governor_too():
    ticks = run(create_pipeline(Scripted()), [Off(), Manual(100.0, -50.0), Manual(float("nan"), 0.0)])
    assert ticks[1].source is Source.MANUAL
    assert Limited.SPEED in ticks[1].command.limited
    assert abs(ticks[1].command.left_rad_s) <= 0.4 + 1e-12
    assert Limited.NOT_FINITE in ticks[2].command.limited


def test_off_forgets_the_last_command():
    pipeline = create_pipeline(Scripted(*[3.0] * 10))
    ticks = run(pipeline, [Off(), *[FollowTask()] * 5, Off(), FollowTask()])
    assert ticks[5].command.left_rad_s == pytest.approx(2.0)
    assert ticks[6].command.left_rad_s == 0.0
    assert ticks[7].command.left_rad_s == pytest.approx(0.4)


def test_the_planner_sees_the_estimate_and_the_commands_sent():
    planner = Scripted(*[1.0] * 3)
    pipeline = create_pipeline(planner)
    for k in range(6):
        now_ns = k * PERIOD_NS
        wheels = WheelSample(now_ns, now_ns, 0.1 * k, 0.2 * k, 5.0, 10.0)
        pose = PoseSample(now_ns, now_ns, 1.0, 2.0, 0.5, 0.005, 0.01)
        pipeline.step(now_ns, Readings(wheels=(wheels,), poses=(pose,)), FollowTask() if k > 2 else Standstill())
    state = planner.states[-1]
    assert (state.x_m, state.y_m) == pytest.approx((1.0, 2.0), abs=0.05)
    assert (state.left_speed_rad_s, state.right_speed_rad_s) == (5.0, 10.0)
    assert [sent.t_ns for sent in state.sent] == [k * PERIOD_NS for k in range(5)]
    assert state.sent[-1].left_rad_s == pytest.approx(0.8)


def test_the_history_of_commands_is_bounded_to_two_seconds_and_no_more_is_remembered_by_default():
    planner = Scripted(*[0.0] * 300)
    run(create_pipeline(planner), [Off(), *[FollowTask()] * 250])
    state = planner.states[-1]
    assert state.sent[0].t_ns >= state.t_ns - 2_000_000_000 - PERIOD_NS
    assert np.all(np.diff([command.t_ns for command in state.sent]) == PERIOD_NS)
    assert (state.command_means, state.body_means) == ((), ())


def test_stages_are_marked_in_order():
    marked = []
    create_pipeline(Scripted()).step(0, Readings(), Off(), marked.append)
    assert marked == ["estimate", "plan"]


def test_what_terms_remember_is_kept_up_while_something_else_drives():
    terms = ("command += k u mean_30s(u^2)", "v_x += k (v - mean_3s(v))")
    model = Model(0.06, 0.4, effects=tuple(EffectSetting(name, {"k": 0.1}) for name in terms))
    planner = Scripted(1.0)
    pipeline = create_pipeline(planner, means=DriveMeans.of(model))
    ticks, turned = [], 0.0
    for k in range(200):
        speed = ticks[-1].command.left_rad_s if ticks else 0.0
        turned += 0.02 * speed
        wheels = WheelSample(PERIOD_NS * k, PERIOD_NS * k, turned, 0.0, speed, 0.0)
        motion = FollowTask() if k == 199 else Manual(3.0, 0.03 * k - 2.0)
        ticks.append(pipeline.step(PERIOD_NS * k, Readings(wheels=(wheels,)), motion))
    (state,) = planner.states
    # The commands since the state's first one are in `sent`; up to it they are averaged.
    gone = [tick.command for tick in ticks if tick.t_ns < state.sent[0].t_ns]
    expected, keep = [0.0, 0.0], math.exp(-0.02 / 30.0)
    for command in gone:
        speeds = command.left_rad_s, command.right_rad_s
        expected = [u * u + (mean - u * u) * keep for u, mean in zip(speeds, expected, strict=True)]
    assert len(gone) == 98
    assert state.command_means == (pytest.approx(tuple(expected)),)
    total = 0.0
    for tick in ticks[1:]:
        both = tick.estimate.left_speed_rad_s + tick.estimate.right_speed_rad_s
        total = both + (total - both) * math.exp(-0.02 / 3.0)
    assert state.body_means == pytest.approx((total,))
    assert total > 1.0
