"""The imperfections a plant can hide: their names, equations, units and realistic sizes, and how they are written down.

An effect is `name=value` or `name=value,value`; each lives in one place of the chain command -> wheel -> body -> pose
sensor, given by its channel. Names that begin with `x_` are outside the list an identification is asked to know.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType


class HiddenEffectError(ValueError):
    """A hidden effect that does not exist or has an impossible value; the message is one line for the user."""


@dataclass(frozen=True, slots=True)
class EffectValue:
    """One number of an effect.

    `realistic` is the range of its magnitude seen on real robots; the model's figures stand apart from it, so that a
    search which knew them would gain nothing. `bounds` is what is physically possible (inclusive),
    `neutral` the value at which the effect does nothing, `default` what stands in when the number is left out (None:
    it must be given).
    """

    name: str
    unit: str
    realistic: tuple[float, float]
    bounds: tuple[float, float] = (-math.inf, math.inf)
    neutral: float = 0.0
    default: float | None = None


@dataclass(frozen=True, slots=True)
class EffectSpec:
    """Specification of one effect: place, equation in words, numbers; `lone` are the numbers a single value sets."""

    name: str
    channel: str
    meaning: str
    values: tuple[EffectValue, ...]
    lone: tuple[int, ...] = (0,)


# Ranges of a value: above 0 where it divides, and below 1 where it would leave nothing or turn round.
_POSITIVE = (1e-6, math.inf)
_NOT_NEGATIVE = (0.0, math.inf)
_RATIO = (-0.95, 0.95)
_FRACTION = (0.0, 0.95)

_WHEEL = "command_to_wheel"
_BODY = "wheel_to_body"
_POSE = "pose_sensor"

_SPECS = (
    EffectSpec(
        "motor_lag",
        _WHEEL,
        "the wheel speed follows its command as a first-order lag of this time constant",
        (EffectValue("tau_s", "s", (0.045, 0.215), _NOT_NEGATIVE),),
    ),
    EffectSpec(
        "command_delay",
        _WHEEL,
        "commands take effect this much later",
        (EffectValue("delay_s", "s", (0.035, 0.215), _NOT_NEGATIVE),),
    ),
    EffectSpec(
        "deadband",
        _WHEEL,
        "u -> sign(u) max(|u| - width, 0)",
        (EffectValue("width_rad_s", "rad/s", (0.215, 0.95), _NOT_NEGATIVE),),
    ),
    EffectSpec(
        "stiction",
        _WHEEL,
        "a wheel at rest stays at rest until |u| exceeds this; a turning wheel feels nothing",
        (EffectValue("threshold_rad_s", "rad/s", (0.45, 1.3), _NOT_NEGATIVE),),
    ),
    EffectSpec(
        "speed_limit",
        _WHEEL,
        "each wheel's command is cut at +- this speed",
        (EffectValue("limit_rad_s", "rad/s", (4.35, 7.1), _POSITIVE, neutral=math.inf),),
    ),
    EffectSpec(
        "yaw_rate_limit",
        _WHEEL,
        "the commanded yaw rate r (u_R - u_L) / a is cut at +- this, the mean wheel speed is kept",
        (EffectValue("limit_rad_s", "rad/s", (0.65, 1.25), _POSITIVE, neutral=math.inf),),
    ),
    EffectSpec(
        "yaw_acceleration_limit",
        _WHEEL,
        "the yaw rate r (w_R - w_L) / a that the motors are asked for changes by at most this, their mean is kept",
        (EffectValue("limit_rad_s2", "rad/s^2", (0.9, 3.2), _POSITIVE, neutral=math.inf),),
    ),
    EffectSpec(
        "acceleration_limit",
        _WHEEL,
        "the wheel's acceleration is cut at +- this, at (1 + more) times as much where no speed is asked for",
        (
            EffectValue("limit_rad_s2", "rad/s^2", (3.1, 12.5), _POSITIVE, neutral=math.inf),
            EffectValue("more", "1", (0.0, 0.0), _NOT_NEGATIVE, default=0.0),
        ),
        lone=(0,),
    ),
    EffectSpec(
        "battery_sag",
        _WHEEL,
        "u -> u (1 - loss t / duration): wheel speed falls linearly with the time since start",
        (
            EffectValue("loss", "1", (0.045, 0.158), _FRACTION),
            EffectValue("duration_s", "s", (150.0, 150.0), _POSITIVE, neutral=150.0, default=150.0),
        ),
    ),
    EffectSpec(
        "wheel_gain",
        _WHEEL,
        "u -> u (1 + gain); one number: both wheels, two: left, right",
        (
            EffectValue("left", "1", (0.018, 0.065), _RATIO),
            EffectValue("right", "1", (0.018, 0.065), _RATIO),
        ),
        lone=(0, 1),
    ),
    EffectSpec(
        "encoder_scale",
        _BODY,
        "the encoder counts (1 + scale) times the wheel's angle; one number: right wheel, two: left, right",
        (
            EffectValue("left", "1", (0.013, 0.054), _RATIO, default=0.0),
            EffectValue("right", "1", (0.013, 0.054), _RATIO),
        ),
        lone=(1,),
    ),
    EffectSpec(
        "wheel_radius_asymmetry",
        _BODY,
        "r_R = r (1 + s), r_L = r (1 - s)",
        (EffectValue("ratio", "1", (0.007, 0.035), _RATIO),),
    ),
    EffectSpec(
        "turn_slip",
        _BODY,
        "omega -> omega (1 - k |omega|), at most half of it lost",
        (EffectValue("k_s", "s/rad", (0.035, 0.16)),),
    ),
    EffectSpec(
        "acceleration_slip",
        _BODY,
        "v -> v - k |v| dv/dt: wheels run ahead of the body when speeding up and behind it when braking",
        (EffectValue("k_s2_m", "s^2/m", (0.0745, 0.265)),),
    ),
    EffectSpec(
        "side_slip",
        _BODY,
        "v_y -> v_y - k v omega: the body is carried outwards in a turn",
        (EffectValue("k_s", "s", (0.054, 0.215)),),
    ),
    EffectSpec(
        "lateral_icr",
        _BODY,
        "the centre of rotation lies this far to the left: v_x -> v_x + offset omega",
        (EffectValue("offset_m", "m", (0.013, 0.054)),),
    ),
    EffectSpec(
        "slope",
        _BODY,
        "a drift of this velocity in the world frame while the wheels turn; direction counter-clockwise from x",
        (
            EffectValue("drift_m_s", "m/s", (0.007, 0.03)),
            EffectValue("direction_rad", "rad", (0.0, math.pi), default=0.0),
        ),
    ),
    EffectSpec(
        "surface_change",
        _BODY,
        "from this time on the effective axial distance is (1 + track) and the wheel radius (1 + radius) times the old",
        (
            EffectValue("track", "1", (0.054, 0.2), _RATIO),
            EffectValue("time_s", "s", (35.0, 115.0), _NOT_NEGATIVE, neutral=math.inf, default=55.0),
            EffectValue("radius", "1", (0.0, 0.04), _RATIO, default=0.0),
        ),
    ),
    EffectSpec(
        "pose_latency",
        _POSE,
        "a pose is what was true this long before its time stamp",
        (EffectValue("latency_s", "s", (0.035, 0.215), _NOT_NEGATIVE),),
    ),
    EffectSpec(
        "pose_offset",
        _POSE,
        "the sensor sits beside the tracked point in the body frame; one number: to the left, two: forward, left",
        (
            EffectValue("forward_m", "m", (0.013, 0.054), default=0.0),
            EffectValue("left_m", "m", (0.013, 0.054)),
        ),
        lone=(1,),
    ),
    EffectSpec(
        "heading_bias",
        _POSE,
        "the measured yaw is the true one plus this",
        (EffectValue("bias_rad", "rad", (0.0235, 0.095)),),
    ),
    EffectSpec(
        "x_second_order_motor",
        _WHEEL,
        "the wheel speed follows its command as a second-order system",
        (
            EffectValue("natural_frequency_rad_s", "rad/s", (10.0, 25.0), _NOT_NEGATIVE),
            EffectValue("damping", "1", (0.5, 1.0), _POSITIVE, neutral=0.7, default=0.7),
        ),
    ),
    EffectSpec(
        "x_smooth_deadband",
        _WHEEL,
        "u -> u - width tanh(u / width)",
        (EffectValue("width_rad_s", "rad/s", (0.215, 0.95), _NOT_NEGATIVE),),
    ),
    EffectSpec(
        "x_motor_droop",
        _WHEEL,
        "u -> u - k u |u|",
        (EffectValue("k_s_rad", "s/rad", (0.005, 0.015)),),
    ),
    EffectSpec(
        "x_shared_supply",
        _WHEEL,
        "u -> u - k |u of the other wheel| sign(u), not past zero",
        (EffectValue("k", "1", (0.02, 0.06), _RATIO),),
    ),
    EffectSpec(
        "x_saturating_turn_slip",
        _BODY,
        "omega -> omega (1 - k |omega| / (1 + |omega| / omega_0))",
        (
            EffectValue("k_s", "s/rad", (0.1, 0.3)),
            EffectValue("omega_0_rad_s", "rad/s", (0.3, 0.6), _POSITIVE, neutral=0.4, default=0.4),
        ),
    ),
    EffectSpec(
        "x_wheel_ripple",
        _BODY,
        "wheels run out of true: rim speed times (1 + ratio sin(wheel angle))",
        (EffectValue("ratio", "1", (0.01, 0.03), _RATIO),),
    ),
    EffectSpec(
        "x_speed_squared_drag",
        _BODY,
        "v -> v (1 - k v^2): slip in proportion to a drag that grows with the speed squared",
        (EffectValue("k_s2_m2", "s^2/m^2", (0.2, 0.6)),),
    ),
    EffectSpec(
        "x_carpet_patch",
        _BODY,
        "within a disc of the floor the effective axial distance is (1 + track) times the usual",
        (
            EffectValue("track", "1", (0.1, 0.3), _RATIO),
            EffectValue("x_m", "m", (-1.0, 1.0), default=0.5),
            EffectValue("y_m", "m", (-1.0, 1.0), default=0.0),
            EffectValue("radius_m", "m", (0.5, 1.5), _NOT_NEGATIVE, default=0.75),
        ),
    ),
)

EFFECTS: Mapping[str, EffectSpec] = MappingProxyType({spec.name: spec for spec in _SPECS})


@dataclass(frozen=True, slots=True)
class HiddenEffects:
    """A checked set of effects; made by `hidden_effects` or `parse_hidden_effects`."""

    items: tuple[tuple[str, tuple[float, ...]], ...] = ()

    def values(self, name: str) -> tuple[float, ...]:
        """Return all numbers of an effect in the order of its spec; the neutral ones if it is not hidden."""
        for item_name, values in self.items:
            if item_name == name:
                return values
        return tuple(value.neutral for value in EFFECTS[name].values)

    def __contains__(self, name: object) -> bool:
        return any(item_name == name for item_name, _ in self.items)


def hidden_effects(effects: Mapping[str, float | Sequence[float]]) -> HiddenEffects:
    """Check effects given as name -> value or values (units of the table).

    Raises HiddenEffectError for a name that is not in `EFFECTS`, a wrong number of values, or a value that is not
    finite or physically impossible.
    """
    items = []
    for name, given in effects.items():
        numbers = tuple(float(number) for number in given) if isinstance(given, Sequence) else (float(given),)
        items.append((name, _complete(_spec(name), numbers)))
    return HiddenEffects(tuple(items))


def parse_hidden_effects(texts: Iterable[str]) -> HiddenEffects:
    """Read effects written as `name=value` or `name=value,value`.

    Raises what `hidden_effects` raises, and HiddenEffectError for anything that is not of this form or given twice.
    """
    effects: dict[str, tuple[float, ...]] = {}
    for text in texts:
        name, separator, numbers = text.partition("=")
        name = name.strip()
        spec = _spec(name)
        if not separator:
            raise HiddenEffectError(f"{name}: no value; write {name}=NUMBER ({_signature(spec)})")
        if name in effects:
            raise HiddenEffectError(f"{name}: given twice; give it once")
        try:
            effects[name] = tuple(float(number) for number in numbers.split(","))
        except ValueError:
            raise HiddenEffectError(f"{name}: {numbers!r} is not a number; write {_signature(spec)}") from None
    return hidden_effects(effects)


def effects_table() -> str:
    """Return every effect with meaning, units and realistic sizes, as text for `--help`."""
    lines = []
    for channel in (_WHEEL, _BODY, _POSE):
        lines.append(f"{channel}:")
        for spec in EFFECTS.values():
            if spec.channel != channel:
                continue
            lines.append(f"  {_signature(spec)}")
            lines.append(f"      {spec.meaning}")
            lines.extend(f"      {_describe(value)}" for value in spec.values)
    return "\n".join(lines)


def _spec(name: str) -> EffectSpec:
    try:
        return EFFECTS[name]
    except KeyError:
        near = "".join(f"did you mean {one}? " for one in difflib.get_close_matches(name, EFFECTS, n=1))
        raise HiddenEffectError(f"{name!r} is not an effect; {near}the names are {', '.join(EFFECTS)}") from None


def _complete(spec: EffectSpec, numbers: tuple[float, ...]) -> tuple[float, ...]:
    """Put the given numbers in their places, defaults in the others, and check them."""
    places = spec.lone if len(numbers) == 1 else range(len(numbers))
    given = numbers * len(spec.lone) if len(numbers) == 1 else numbers
    if not numbers or len(numbers) > len(spec.values):
        raise HiddenEffectError(f"{spec.name}: {len(numbers)} values; write {_signature(spec)}")
    by_place = dict(zip(places, given, strict=True))
    result = []
    for place, value in enumerate(spec.values):
        number = by_place.get(place, value.default)
        if number is None:
            raise HiddenEffectError(f"{spec.name}: {value.name} is missing; write {_signature(spec)}")
        low, high = value.bounds
        if not math.isfinite(number) or not low <= number <= high:
            raise HiddenEffectError(
                f"{spec.name}: {value.name} = {number:g} is impossible; write a value from {low:g} to {high:g}"
            )
        result.append(number)
    return tuple(result)


def _signature(spec: EffectSpec) -> str:
    """Return how an effect is written, with what may be left out in brackets."""
    if (len(spec.lone) == 1 and spec.lone[0] > 0) or len(spec.lone) > 1:
        names = ",".join(value.name for value in spec.values)
        return f"{spec.name}={'/'.join(spec.values[place].name for place in spec.lone)} or {spec.name}={names}"
    text = f"{spec.name}={spec.values[0].name}"
    for value in spec.values[1:]:
        text += f"[,{value.name}]"
    return text


def _describe(value: EffectValue) -> str:
    low, high = value.realistic
    default = "" if value.default is None else f"; {value.default:g} if left out"
    return f"{value.name}: {value.unit}, realistic {low:g} to {high:g}{default}"
