"""Records for the log that are made of one tick."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence

import numpy as np

from disco_hw.control import Rollouts
from disco_hw.estimation.correction import PoseUpdate
from disco_hw.log import records
from disco_hw.runtime.pipeline import Limited, Source, Tick
from drivers.types import Identity, Limits, OutgoingFrame, Readings, ReceivedFrame, SaidBy, WheelCommand, socketcan_id

# One number for each of x, y and yaw.
_NO_NUMBERS = (float("nan"),) * 3
# Chosen: enough for the curve on the page; each costs space in the log of every plan.
_FAN_POINTS = 11
# To a millimetre: the page shows no more, and shorter numbers take less space.
_FAN_DIGITS = 3


def frames_in(frames: Sequence[ReceivedFrame]) -> Iterator[records.Record]:
    """Yield one record for each received frame."""
    for received in frames:
        yield records.FrameIn(received.t_ns, socketcan_id(received.frame), received.frame.data)


def frame_out(now_ns: int, outgoing: OutgoingFrame, sent: bool) -> records.Record:
    """One frame handed to the link."""
    return records.FrameOut(now_ns, socketcan_id(outgoing.frame), outgoing.frame.data, outgoing.deadline_ns, sent)


def controller(now_ns: int, identity: Identity, limits: Limits) -> records.Record:
    """Return the record of the controller that answers, and of its limits."""
    by_origin: dict[SaidBy, dict[str, float]] = {"device": {}, "fixed": {}, "robot.toml": {}}
    for name, limit in limits.known().items():
        by_origin[limit.said_by][name] = limit.value
    return records.Controller(
        now_ns,
        identity.controller,
        identity.firmware,
        identity.details,
        identity.said_by,
        by_origin["device"],
        by_origin["fixed"],
        by_origin["robot.toml"],
    )


def samples(readings: Readings) -> Iterator[records.Record]:
    """Yield the samples that the received frames contained."""
    yield from readings.wheels
    yield from readings.poses
    yield from readings.motors
    yield from readings.power
    yield from readings.status
    yield from readings.link_health


def tick(result: Tick, command: WheelCommand | None, valid_for_s: float) -> Iterator[records.Record]:
    """Estimate, innovations, plan and command of one tick; `command` is None while nothing is commanded."""
    estimate = result.estimate
    yield records.Estimate(
        t_ns=estimate.t_ns,
        x_m=estimate.x_m,
        y_m=estimate.y_m,
        yaw_rad=estimate.yaw_rad,
        covariance=tuple(value for row in estimate.covariance for value in row),
        speed_m_s=estimate.speed_m_s,
        yaw_rate_rad_s=estimate.yaw_rate_rad_s,
        left_speed_rad_s=estimate.left_speed_rad_s,
        right_speed_rad_s=estimate.right_speed_rad_s,
        wheels_healthy=estimate.wheels_ok,
        pose_healthy=estimate.pose_ok,
    )
    for update in result.pose_updates:
        yield _innovation(update)
    if result.plan is not None:
        plan, found = result.plan, result.plan.diagnostics
        left, right = plan.wheel_speeds.T.tolist()
        path_x, path_y, path_yaw = plan.trajectory.T.tolist()
        yield records.Plan(
            t_ns=result.t_ns,
            t0_ns=plan.t0_ns,
            step_s=plan.step_s,
            left_rad_s=tuple(left),
            right_rad_s=tuple(right),
            effective_samples=found.ess,
            temperature=found.temperature,
            min_cost=found.cost_min,
            mean_cost=found.cost_mean,
            path_x_m=tuple(path_x),
            path_y_m=tuple(path_y),
            path_yaw_rad=tuple(path_yaw),
        )
    governed = result.command
    yield records.Command(
        t_ns=result.t_ns,
        requested_left_rad_s=result.requested[0],
        requested_right_rad_s=result.requested[1],
        left_rad_s=governed.left_rad_s,
        right_rad_s=governed.right_rad_s,
        valid_for_s=valid_for_s,
        in_force=command is not None and result.source is not Source.OFF,
        source=result.source.value,
        limits=_names(governed.limited),
    )


def fan(t_ns: int, rollouts: Rollouts) -> records.Fan:
    """Return the rollouts of the plan made at `t_ns`, each thinned to 11 points from its first to its last."""
    steps = rollouts.trajectories.shape[1]
    kept = np.unique(np.linspace(0, steps - 1, min(_FAN_POINTS, steps)).astype(int))
    x, y = np.round(rollouts.trajectories[:, kept, :2], _FAN_DIGITS).reshape(-1, 2).T
    return records.Fan(t_ns, tuple(rollouts.weights.tolist()), tuple(x.tolist()), tuple(y.tolist()))


def _innovation(update: PoseUpdate) -> records.Record:
    return records.Innovation(
        t_ns=update.t_ns,
        innovation=update.innovation or _NO_NUMBERS,
        variance=update.innovation_variance or _NO_NUMBERS,
        test_ratio=float("nan") if update.test_ratio is None else update.test_ratio,
        accepted=update.accepted,
        reason=update.reason.value,
    )


@functools.cache
def _names(limited: Limited) -> tuple[str, ...]:
    return tuple(flag.name or "" for flag in Limited if flag in limited)
