"""Tests of what a model remembers where a plan begins: from commands and wheels, in the runtime and in the planner."""

import math

import numpy as np
import pytest

from disco_hw.control import PlannerState, SentCommand
from disco_hw.control.past_motion import DriveMeans, PastMotion
from disco_hw.model import EffectSetting, Model
from disco_hw.model.step import FreeRun

DIRECTION, LOAD = "command += k sign(u - mean_0.3s(u))", "command += k u mean_1s(|u| + |u_other|)"
RUBBER = "omega += k (omega - mean_1s(omega))"
TICK_NS, TICK_S = 20_000_000, 0.02
DELAY_S = 0.08
MODEL = Model(
    0.06,
    0.4,
    effects=(
        EffectSetting("command_delay", {"delay_s": DELAY_S}),
        *(EffectSetting(name, {"k": 0.01}) for name in (DIRECTION, RUBBER, LOAD)),
    ),
)


def weaving(count):
    t_s = TICK_S * np.arange(count)
    return np.round(np.column_stack([3.0 * np.sin(2.1 * t_s) + 1.0, 4.0 * np.sign(np.sin(1.3 * t_s))]), 3)


def driven(commands, kept_s=2.0):
    """The state after a drive under these commands, one a tick, wheels turning as commanded, as the runtime has it."""
    means, sent = DriveMeans.of(MODEL), []
    for k, (left, right) in enumerate(commands):
        means.add_wheels(left, right, TICK_S)
        sent.append(SentCommand(k * TICK_NS, left, right))
        if sent[-1].t_ns - sent[0].t_ns > kept_s * 1e9:
            gone = sent.pop(0)
            means.add_command(gone.left_rad_s, gone.right_rad_s, TICK_S)
    now_ns = len(commands) * TICK_NS
    left, right = commands[-1]
    return PlannerState(
        now_ns, 0.0, 0.0, 0.0, left, right, tuple(sent), command_means=means.commands, body_means=means.body
    )  # fmt: skip


def by_hand(commands, at_s, time_s, of):
    """A mean of both wheels after some seconds, command by command."""
    mean, end_s = np.zeros(2), 0.0
    for k, command in enumerate(commands):
        held_s = max(min(at_s - k * TICK_S, TICK_S), 0.0)
        mean = of(command) + (mean - of(command)) * math.exp(-held_s / time_s)
        end_s += held_s
    assert end_s == pytest.approx(min(at_s, TICK_S * len(commands)))
    return mean


def load_of(command):
    return np.repeat(np.abs(command).sum(), 2)


@pytest.mark.parametrize("count", [40, 100, 400])
@pytest.mark.parametrize("back_s", [0.0, 0.013, 0.1])
def test_what_is_remembered_is_what_acted_up_to_then(count, back_s):
    commands = weaving(count)
    state = driven(commands)
    point = MODEL.point()[None]
    past = PastMotion.of(MODEL, np.vstack([point, point + np.eye(1, point.size, 3) * 0.05]), point)
    begin_ns = state.t_ns - round(back_s * 1e9)
    means = past.of_mean(state, begin_ns)
    at_s = count * TICK_S - back_s - DELAY_S
    expected = [by_hand(commands, at_s, 0.3, lambda u: u), by_hand(commands, at_s, 1.0, load_of)]
    np.testing.assert_allclose(means[:4], np.concatenate(expected), atol=1e-9)
    later = past.of_points(state, begin_ns, means)
    np.testing.assert_allclose(later[0], means)
    np.testing.assert_allclose(later[1, :2], by_hand(commands, at_s - 0.05, 0.3, lambda u: u), atol=1e-9)
    assert (later[:, 4] == means[4]).all()
    assert np.abs(means[:2]).min() > 0.05


def test_the_body_s_mean_is_that_of_its_wheels():
    commands = weaving(150)
    past = PastMotion.of(MODEL, MODEL.point()[None], MODEL.point()[None])
    state = driven(commands)
    mean = past.of_mean(state, state.t_ns)[4]
    assert mean == pytest.approx(by_hand(commands, 3.0, 1.0, np.diff)[0])


@pytest.mark.thorough
def test_a_run_of_the_model_remembers_the_same():
    commands = weaving(150)
    undelayed = Model(0.06, 0.4, effects=MODEL.effects[1:])
    kept = np.zeros(5)
    FreeRun(undelayed, undelayed.point()[None], TICK_S).states(np.zeros(5), commands, 0, means=kept)
    past = PastMotion.of(undelayed, undelayed.point()[None], undelayed.point()[None])
    state = driven(commands)
    found = past.of_mean(state, state.t_ns)
    np.testing.assert_allclose(found[:4], kept[:4], atol=1e-9)
    # The wheels of the run turn by what its terms add.
    assert found[4] == pytest.approx(kept[4], rel=0.1)


def test_what_a_model_without_memory_remembers_is_nothing():
    plain = Model(0.06, 0.4, effects=(EffectSetting("command += k u |u|", {"k": 0.01}),))
    assert DriveMeans.of(plain) is None
    assert PastMotion.of(plain, plain.point()[None], plain.point()[None]) is None


def test_nothing_was_before_a_drive_and_speeds_that_are_none_count_as_standing():
    past = PastMotion.of(MODEL, MODEL.point()[None], MODEL.point()[None])
    start = PlannerState(0, 0.0, 0.0, 0.0, 3.0, 3.0)
    assert not past.of_mean(start, 0).any()
    means = DriveMeans.of(MODEL)
    means.add_wheels(math.nan, 3.0, 10.0)
    assert means.body == pytest.approx((3.0,), rel=1e-3)


def test_of_tyres_that_slip_it_is_kept_how_fast_the_robot_really_is():
    slipping = Model(0.06, 0.4, effects=(EffectSetting("v_x += k (v - slewed_2(v))", {"k": -1.0}),))
    means = DriveMeans.of(slipping)
    # 0.1 m/s in 0.05 s: of wheels of 60 mm 10/3 rad/s in the sum of both.
    for gained in (10.0 / 3.0, 20.0 / 3.0, 8.0):
        means.add_wheels(4.0, 4.0, 0.05)
        assert means.body == pytest.approx((gained,))
    means.add_wheels(0.0, 0.0, 0.05)
    assert means.body == pytest.approx((8.0 - 10.0 / 3.0,))
    means.add_wheels(0.0, 0.0, -1.0)
    assert means.body == pytest.approx((8.0 - 10.0 / 3.0,))
