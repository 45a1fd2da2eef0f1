"""What effects say of themselves is so: by their own equations, and nothing that nobody shows."""

import numpy as np
import pytest

from disco_hw.effects import Stage, arguments_of
from disco_hw.effects.registry import REGISTRY, in_stages

GEOMETRY = (0.06, 0.4, 0.1)
TOP_RAD_S = 6.0


def sampled(effect, rng):
    """Values within what is physically possible, and not far out."""
    return tuple(rng.uniform(max(p.low, -0.5), min(p.high, 5.0)) for p in effect.parameters)


def called(effect, values, **motion):
    known = {**motion, "values": values, "geometry": GEOMETRY, "step_s": 0.1}
    return effect.plain(**{name: known[name] for name in arguments_of(effect.plain)})


def turns_more(effect, rng):
    """Whether it makes the robot turn faster than its wheels can, which go up to `TOP_RAD_S` either way."""
    left, right, was_left, was_right = rng.uniform(-TOP_RAD_S, TOP_RAD_S, 4)
    values, time_s = sampled(effect, rng), rng.uniform(0.0, 100.0)
    at_start = {"wheel_left": was_left, "wheel_right": was_right, "time_s": time_s}
    most = 2.0 * TOP_RAD_S + 1e-9
    if effect.stage is Stage.COMMAND:
        if "command" in arguments_of(effect.plain):
            left = called(effect, values, command=-TOP_RAD_S, speed=was_left, **at_start)
            right = called(effect, values, command=TOP_RAD_S, speed=was_right, **at_start)
        else:
            left, right = called(effect, values, left=-TOP_RAD_S, right=TOP_RAD_S, **at_start)
        return abs(right - left) > most
    if effect.stage is Stage.RESPONSE and "end" not in arguments_of(effect.plain):
        ends = {"end_left": left, "end_right": right, "mean_left": left, "mean_right": right}
        ends |= {"left": left, "right": right}
        end_left, end_right, mean_left, mean_right = called(effect, values, **ends, **at_start)
        return max(abs(end_right - end_left), abs(mean_right - mean_left)) > most
    if effect.stage is Stage.RESPONSE:
        end_left, mean_left = called(effect, values, end=left, mean=left, speed=was_left, time_s=time_s)
        end_right, mean_right = called(effect, values, end=right, mean=right, speed=was_right, time_s=time_s)
        return max(abs(end_right - end_left), abs(mean_right - mean_left)) > most
    rolling = {"wheel_sum": left + right, "difference": right - left, "change": 0.1, "time_s": time_s}
    if effect.stage is Stage.ROLLING:
        return abs(called(effect, values, **rolling)[1]) > abs(right - left) + 1e-9
    if effect.stage in (Stage.VELOCITY, Stage.TURN):
        turn = rng.uniform(-1.0, 1.0)
        found = called(effect, values, forward=0.2, turn=turn, **rolling)
        return abs(found[1] if effect.stage is Stage.VELOCITY else found) > abs(turn) + 1e-9
    return False


@pytest.mark.parametrize("effect", REGISTRY.values(), ids=lambda effect: effect.name)
def test_an_effect_says_whether_it_may_turn_the_robot_more(effect):
    rng = np.random.default_rng(0)
    assert any(turns_more(effect, rng) for _ in range(300)) == effect.may_turn_more


@pytest.mark.parametrize("effect", REGISTRY.values(), ids=lambda effect: effect.name)
def test_an_effect_says_whether_it_uses_the_geometry(effect):
    values = np.array([[parameter.start + 0.1 for parameter in effect.parameters]])
    one, other = (effect.coefficients(values, np.array([base]), 0.1) for base in ((0.1, 0.5, 0.1), (0.2, 0.7, 0.3)))
    assert any(not np.array_equal(a, b) for a, b in zip(one, other, strict=True)) == effect.uses_geometry


def test_what_makes_wheels_late_is_a_time():
    delaying = [effect for effect in REGISTRY.values() if effect.delayed_by is not None]
    assert len(delaying) == 2
    for effect in delaying:
        (unit,) = [parameter.unit for parameter in effect.parameters if parameter.name == effect.delayed_by]
        assert unit == "s"
        assert effect.delay_starts


def test_stages_come_one_after_the_other_whatever_the_order_of_their_effects():
    stages = [effect.stage for effect in in_stages(*Stage)]
    firsts = [stages.index(stage) for stage in (Stage.DELAY, Stage.COMMAND, Stage.RESPONSE, Stage.ROLLING, Stage.WORLD)]
    assert firsts == sorted(firsts)
    assert len(stages) == len(REGISTRY)
