"""The terms of all effects put in line, stage by stage, in the order that they ask for.

The lines are written from the registry: which effects there are is known there alone, and a tuple of their functions
could not be looped over in compiled code.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable
from typing import Any

from disco_hw.effects.effect import Stage
from disco_hw.effects.registry import REGISTRY, STEP_TERMS
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
_ROLL = ("forward = base.half_radius_m * wheel_sum", "turn = base.half_turn_ratio * difference")


def _asked(name: str) -> tuple[str, ...]:
    """What a term asks for, by name."""
    return tuple(inspect.signature(getattr(STEP_TERMS[name], "py_func", STEP_TERMS[name])).parameters)


def _call(name: str, **instead: str) -> str:
    arguments = (f"effects.{name}" if a == "coefficients" else instead.get(a, a) for a in _asked(name))
    return f"term_{name}({', '.join(arguments)})"


def _staged(stages: Iterable[Stage]) -> list[str]:
    return [name for name in STEP_TERMS if REGISTRY[name].stage in stages]


def _wheel_lines() -> list[str]:
    lines = ["end_left, mean_left, end_right, mean_right = left, left, right, right"]
    for name in _staged(_WHEELS):
        response = REGISTRY[name].stage is Stage.RESPONSE
        if "command" not in _asked(name):
            lines.append(f"{_BOTH_RESPOND if response else 'left, right'} = {_call(name)}")
            continue
        for side in ("left", "right"):
            got = f"end_{side}, mean_{side}" if response else side
            lines.append(f"{got} = {_call(name, command=side, speed=f'wheel_{side}')}")
    return [*lines, "return end_left, end_right, mean_left, mean_right"]


def _body_lines() -> list[str]:
    # A lateral speed that is None at first and a number later needs a name of its own every time.
    lines, rolled, lateral = ["lateral0 = None"], False, 0
    for name in _staged(_BODY):
        stage = REGISTRY[name].stage
        if not rolled and stage is not Stage.ROLLING:
            lines, rolled = [*lines, *_ROLL], True
        if stage is Stage.LATERAL:
            lines.append(f"lateral{lateral + 1} = plus(lateral{lateral}, {_call(name)})")
            lateral += 1
        else:
            lines.append(f"{_RETURNS[stage]} = {_call(name)}")
    return [*lines, *(() if rolled else _ROLL), f"return forward, lateral{lateral}, turn"]


def _world_lines() -> list[str]:
    return [*(f"{_RETURNS[Stage.WORLD]} = {_call(name)}" for name in _staged((Stage.WORLD,))), "return x, y"]


def _change_lines() -> list[str]:
    asking = [f"effects.{name} is not None" for name in _staged(_BODY) if "change" in _asked(name)]
    return [f"return {' or '.join([*asking, 'terms_need_change(effects.body_terms)'])}"]


def _follow_lines() -> list[str]:
    absent = [f"effects.{name} is None" for name in _staged(_WHEELS)]
    return [f"return {' and '.join([*absent, 'effects.command_delay is None', 'effects.command_terms is None'])}"]


@scalar_function
def _plus(lateral: Any, more: Any) -> Any:
    if lateral is None:
        return more
    if more is None:
        return lateral
    return lateral + more


def _made(name: str, arguments: str, lines: list[str], summary: str) -> Callable[..., Any]:
    scope: dict[str, Any] = {f"term_{effect}": term for effect, term in STEP_TERMS.items()}
    scope |= {"plus": _plus, "terms_need_change": terms_need_change}
    body = "\n".join(f"    {line}" for line in lines)
    exec(f"def {name}({arguments}):\n{body}", scope)
    scope[name].__doc__ = summary
    made: Callable[..., Any] = scalar_function(scope[name])
    return made


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
