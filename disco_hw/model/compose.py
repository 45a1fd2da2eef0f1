"""The terms of all effects put in line, stage by stage, in the order that they ask for.

The lines are written from the registry: which effects there are is known there alone, and a tuple of their functions
could not be looped over in compiled code.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from disco_hw.effects.effect import Effect, Stage, asks_for
from disco_hw.effects.registry import DELAY, REGISTRY, in_stages
from disco_hw.jit import scalar_function
from disco_hw.model.terms import terms_need_change

_WHEELS = (Stage.COMMAND, Stage.RESPONSE)
_BODY = (Stage.ROLLING, Stage.VELOCITY, Stage.FORWARD, Stage.TURN, Stage.LATERAL)
_RETURNS = {
    Stage.ROLLING: "wheel_sum, difference",
    Stage.VELOCITY: "forward, turn",
    Stage.FORWARD: "forward",
    Stage.TURN: "turn",
    Stage.WORLD: "x, y",
}
_BOTH_RESPOND = "end_left, end_right, mean_left, mean_right"
_BEGIN_RESPONSE = "end_left, mean_left, end_right, mean_right = left, left, right, right"
_ROLL = ("forward = base.half_radius_m * wheel_sum", "turn = base.half_turn_ratio * difference")


def _asked(effect: Effect) -> tuple[str, ...]:
    assert effect.term is not None
    return asks_for(effect.term)


def _call(effect: Effect, **instead: str) -> str:
    arguments = (f"effects.{effect.name}" if a == "coefficients" else instead.get(a, a) for a in _asked(effect))
    return f"term_{effect.name}({', '.join(arguments)})"


def _wheel_lines() -> list[str]:
    lines: list[str] = []
    for effect in in_stages(Stage.COMMAND):
        if "command" not in _asked(effect):
            lines.append(f"left, right = {_call(effect)}")
            continue
        lines += [f"{side} = {_call(effect, command=side, speed=f'wheel_{side}')}" for side in ("left", "right")]
    lines.append(_BEGIN_RESPONSE)
    for effect in in_stages(Stage.RESPONSE):
        if "end" not in _asked(effect):
            lines.append(f"{_BOTH_RESPOND} = {_call(effect)}")
            continue
        for side in ("left", "right"):
            call = _call(effect, end=f"end_{side}", mean=f"mean_{side}", speed=f"wheel_{side}")
            lines.append(f"end_{side}, mean_{side} = {call}")
    return [*lines, "return end_left, end_right, mean_left, mean_right"]


def _body_lines() -> list[str]:
    # A lateral speed that is None at first and a number later needs a name of its own every time.
    lines, lateral = ["lateral0 = None"], 0
    lines += [f"{_RETURNS[Stage.ROLLING]} = {_call(effect)}" for effect in in_stages(Stage.ROLLING)]
    lines += _ROLL
    for effect in in_stages(*_BODY[1:]):
        if effect.stage is Stage.LATERAL:
            lines.append(f"lateral{lateral + 1} = plus(lateral{lateral}, {_call(effect)})")
            lateral += 1
        else:
            lines.append(f"{_RETURNS[effect.stage]} = {_call(effect)}")
    return [*lines, f"return forward, lateral{lateral}, turn"]


def _world_lines() -> list[str]:
    return [*(f"{_RETURNS[Stage.WORLD]} = {_call(effect)}" for effect in in_stages(Stage.WORLD)), "return x, y"]


def _change_lines() -> list[str]:
    asking = [f"effects.{effect.name} is not None" for effect in in_stages(*_BODY) if "change" in _asked(effect)]
    return [f"return {' or '.join([*asking, 'terms_need_change(effects.body_terms)'])}"]


def _follow_lines() -> list[str]:
    absent = [f"effects.{effect.name} is None" for effect in in_stages(Stage.DELAY, *_WHEELS)]
    return [f"return {' and '.join([*absent, 'effects.command_terms is None'])}"]


@scalar_function
def _plus(lateral: float | None, more: float | None) -> float | None:
    if lateral is None:
        return more
    if more is None:
        return lateral
    return lateral + more


@scalar_function
def _whole(coefficients: tuple[float, ...] | None) -> int:
    if coefficients is None:
        return 0
    return int(coefficients[0])


def _made(name: str, arguments: str, lines: list[str], summary: str) -> Callable[..., Any]:
    scope: dict[str, Any] = {f"term_{effect.name}": effect.term for effect in REGISTRY.values() if effect.moves}
    scope |= {"plus": _plus, "whole": _whole, "terms_need_change": terms_need_change}
    body = "\n".join(f"    {line}" for line in lines)
    exec(f"def {name}({arguments}):\n{body}", scope)
    scope[name].__doc__ = summary
    made: Callable[..., Any] = scalar_function(scope[name])
    return made


delay_steps = _made(
    "delay_steps",
    "effects",
    [f"return whole(effects.{DELAY.name})"],
    "Number of whole steps by which commands are held back.",
)
in_force = _made(
    "in_force",
    "recent, older, effects",
    [f"return {_call(DELAY)}"],
    "Mean command over a step, from the command after the whole steps of delay and the one before it.",
)
wheel_terms = _made(
    "wheel_terms",
    "left, right, wheel_left, wheel_right, time_s, effects",
    _wheel_lines(),
    "Wheel speeds at the end of a step, left and right, and their means over it (rad/s), from the commands in force.",
)
body_terms = _made(
    "body_terms",
    "wheel_sum, difference, change, time_s, base, effects",
    _body_lines(),
    "Forward speed (m/s), lateral speed of the axle (m/s) or None, half the yaw rate (rad/s), from the wheels' means.",
)
world_terms = _made(
    "world_terms",
    "x, y, wheel_sum, difference, time_s, effects",
    _world_lines(),
    "Position (m) at the end of a step.",
)
needs_change = _made(
    "needs_change",
    "effects",
    _change_lines(),
    "Whether the body's motion depends on the change of the wheel speeds; a constant to the compiler.",
)
wheels_follow = _made(
    "wheels_follow",
    "effects",
    _follow_lines(),
    "Whether the wheels turn as commanded, with nothing in between; a constant to the compiler.",
)
