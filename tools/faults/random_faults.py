"""Schedules of random faults, the same from the same seed on any machine."""

from __future__ import annotations

import random
from collections.abc import Mapping, Sequence
from types import MappingProxyType

from sim.fault_schedule import KINDS, FaultParameter, FaultSchedule, ScheduledFault, in_order


def random_schedule(
    seed: int,
    duration_s: float,
    *,
    kinds: Sequence[str] = tuple(KINDS),
    quiet_s: tuple[float, float] = (4.0, 12.0),
    lasting_s: tuple[float, float] = (0.05, 3.0),
) -> FaultSchedule:
    """Draw faults of `kinds`, one after the other, until `duration_s`.

    Each lasts a log-uniform time within `lasting_s` and is followed by a uniform pause within `quiet_s`; parameters are
    drawn over ranges in which a robot may or may not go on. The same seed gives the same schedule on any machine.
    """
    chance = random.Random(seed)
    faults: list[ScheduledFault] = []
    now_s = chance.uniform(*quiet_s)
    while now_s < duration_s:
        kind = KINDS[chance.choice(list(kinds))]
        ratio = lasting_s[1] / lasting_s[0]
        for_s = lasting_s[0] * ratio ** chance.random() if kind.lasts else 0.0
        begin_ns = round(now_s * 1e6) * 1000
        values = {p.name: _drawn(kind.name, p, chance) for p in kind.parameters}
        faults.append(ScheduledFault(0, kind, begin_ns, begin_ns + round(for_s * 1e6) * 1000, values))
        now_s += for_s + chance.uniform(*quiet_s)
    return FaultSchedule(seed, in_order(faults))


_DRAWN: Mapping[tuple[str, str], tuple[float, ...]] = MappingProxyType(
    {
        ("delay", "delay_s"): (0.005, 0.3),
        ("reorder", "window_s"): (0.005, 0.1),
        ("babble", "rate_hz"): (50.0, 3000.0),
        ("encoder_jump", "ticks"): (-100_000, 100_000),
        ("motor_runaway", "speed_rad_s"): (-15.0, 15.0),
        ("encoder_wrap", "bits"): (6, 14),
        ("pose_jump", "dx_m"): (-3.0, 3.0),
        ("pose_jump", "dy_m"): (-3.0, 3.0),
        ("pose_jump", "dyaw_rad"): (-3.1, 3.1),
        ("pose_late", "delay_s"): (0.05, 1.5),
        ("clock_jump", "step_s"): (-100.0, 100.0),
        ("battery_sag", "drop_v"): (1.0, 12.0),
        ("cpu_hog", "cores"): (1, 2),
    }
)
# A delay that grows is not drawn: as short as drawn faults are, it would be one that stays.
_NOT_DRAWN = frozenset({("delay", "growth")})
_FRAME_IDS = (-1, -1, -1, 0x100, 0x101, 0x110, 0x111, 0x118, 0x119, 0x130, 0x133)
_BABBLED_IDS = (0x000, 0x080, 0x100, 0x101, 0x110, 0x130, 0x7FF)


def _drawn(kind: str, parameter: FaultParameter, chance: random.Random) -> float | str:
    if (kind, parameter.name) in _NOT_DRAWN:
        return parameter.default
    if parameter.choices:
        return chance.choice(parameter.choices)
    if parameter.name == "id":
        return chance.choice(_BABBLED_IDS if kind == "babble" else _FRAME_IDS)
    if parameter.name == "probability":
        return chance.choice((0.02, 0.2, 0.5, 1.0))
    least, most = _DRAWN[kind, parameter.name]
    return chance.randint(int(least), int(most)) if parameter.is_integer else round(chance.uniform(least, most), 6)
