"""The named effects as they compete: which entries of a channel's parameter vector each frees, and where to start."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from disco_hw.gap.channels import BodyChannel, Channel, WheelChannel
from disco_hw.gap.free_runs import BODY, WHEEL

Array = NDArray[np.float64]
Starts = tuple[tuple[float, ...], ...]


@dataclass(frozen=True, slots=True)
class Candidate:
    """An effect in the competition.

    `columns` are fitted, `profiled` (one or none) is searched over values because the residual is not smooth in it;
    `values` gives those. `starts` gives start values of the columns for a channel.
    """

    name: str
    columns: tuple[str, ...]
    starts: Callable[[Channel], Starts]
    profiled: str | None = None
    values: Callable[[Channel], tuple[float, ...]] | None = None
    refine: float = 0.0

    @property
    def parameters(self) -> int:
        """Number of parameters that its evidence must pay for."""
        return len(self.columns) + (self.profiled is not None)


def _fixed(*starts: tuple[float, ...]) -> Callable[[Channel], Starts]:
    return lambda channel: starts


def _below_largest(turning: bool) -> Callable[[Channel], Starts]:
    """Limits start where they cut a part of what was commanded."""

    def starts(channel: Channel) -> Starts:
        assert isinstance(channel, WheelChannel)
        command = channel.timeline.command_rad_s
        command = command[np.isfinite(command[:, 0])]
        size = np.abs(0.5 * (command[:, 1] - command[:, 0])) if turning else np.abs(command).max(axis=1)
        largest = float(size.max()) if size.size else 0.0
        if largest < 0.2:
            return ()
        return tuple((share * largest,) for share in (0.92, 0.75, 0.5))

    return starts


def _stiction_values(channel: Channel) -> tuple[float, ...]:
    return tuple(np.arange(0.1, 2.05, 0.1).tolist())


def _change_times(channel: Channel) -> tuple[float, ...]:
    assert isinstance(channel, BodyChannel)
    first, last = float(channel.samples.t_s[0]), float(channel.samples.t_s[-1])
    if last - first < 30.0:
        return ()
    return tuple(np.arange(first + 10.0, last - 10.0, max(4.0, (last - first) / 40.0)).tolist())


WHEEL_CANDIDATES: Mapping[str, Candidate] = {
    candidate.name: candidate
    for candidate in (
        Candidate("motor_lag", ("tau_s",), _fixed((0.05,), (0.25,))),
        Candidate("command_delay", ("delay_s",), _fixed((0.03,), (0.12,), (0.3,))),
        Candidate("deadband", ("deadband_rad_s",), _fixed((0.2,))),
        Candidate("stiction", (), _fixed(()), "stiction_rad_s", _stiction_values, 0.02),
        Candidate("speed_limit", ("speed_limit_rad_s",), _below_largest(False)),
        Candidate("yaw_rate_limit", ("turn_limit_rad_s",), _below_largest(True)),
        Candidate("battery_sag", ("sag_per_s",), _fixed((0.0,))),
        Candidate("wheel_gain", ("gain_left", "gain_right"), _fixed((0.0, 0.0))),
    )
}

BODY_CANDIDATES: Mapping[str, Candidate] = {
    candidate.name: candidate
    for candidate in (
        Candidate("wheel_radius_asymmetry", ("asymmetry",), _fixed((0.0,))),
        Candidate("turn_slip", ("turn_slip_s",), _fixed((0.0,))),
        Candidate("acceleration_slip", ("acceleration_slip_s2_m",), _fixed((0.0,))),
        Candidate("side_slip", ("side_slip_s",), _fixed((0.0,))),
        Candidate("lateral_icr", ("lateral_icr_m",), _fixed((0.0,))),
        Candidate("slope", ("drift_x_m_s", "drift_y_m_s"), _fixed((0.0, 0.0))),
        Candidate(
            "surface_change",
            ("change_track", "change_radius"),
            _fixed((0.0, 0.0)),
            "change_time_s",
            _change_times,
            0.25,
        ),
        Candidate("pose_latency", ("latency_s",), _fixed((0.0,))),
        Candidate("heading_bias", ("heading_bias_rad",), _fixed((0.0,))),
    )
}

BODY_BASE = (0, 1, 2)


def candidates_of(channel: Channel) -> Mapping[str, Candidate]:
    """The named effects of a channel."""
    return WHEEL_CANDIDATES if channel.columns == WHEEL else BODY_CANDIDATES


def base_of(channel: Channel) -> tuple[int, ...]:
    """Entries of the parameter vector that are always free."""
    return () if channel.columns == WHEEL else BODY_BASE


def indices(channel: Channel, names: tuple[str, ...]) -> tuple[int, ...]:
    """Places in the parameter vector of the entries that a set of effects frees, with the base."""
    order = WHEEL if channel.columns == WHEEL else BODY
    candidates = candidates_of(channel)
    freed = [order.index(column) for name in names for column in candidates[name].columns]
    return (*base_of(channel), *freed)
