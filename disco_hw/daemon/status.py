"""The daemon's state as one JSON object for the control socket."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
from msgspec.structs import asdict as asdict_of

from disco_hw.daemon.loop import LoopStats
from disco_hw.log import records
from disco_hw.log.recorder import RecorderStats
from disco_hw.runtime.core import DaemonCore
from disco_hw.runtime.task_change import asked_of, limits
from drivers.types import Driver


def loop_figures(loop: LoopStats) -> dict[str, Any]:
    """Lateness and duration in microseconds, overruns and skipped periods; costs about a millisecond."""
    return {
        "lateness_us": _microseconds(loop.lateness.summary_s()),
        "duration_us": _microseconds(loop.duration.summary_s()),
        "overruns": loop.overruns,
        "skipped": loop.skipped_periods,
    }


def status(core: DaemonCore, loop: dict[str, Any], recorder: RecorderStats) -> dict[str, Any]:
    """Everything that a person or a page wants to know now; what does not exist is None.

    `robot_state_ns`: when the newest frame with the robot's state arrived, on the monotonic clock of this host.

    `loop` is from `loop_figures`.
    """
    tick = core.last
    if tick is None:
        return {"ok": False, "error": "the loop has not started yet"}
    estimate, robot, wheels = tick.pipeline.estimate, core.robot_status, core.newest_wheels
    task = core.task
    distance = float(core.course.off_m(np.array([[estimate.x_m, estimate.y_m]]))[0])
    plan = tick.pipeline.plan
    return {
        "ok": True,
        "state": tick.output.state.name,
        "detail": tick.output.detail,
        "running": tick.output.running,
        "estop": tick.output.estop,
        "link": core.transport.state.value,
        "link_error": core.transport.last_error,
        "driver_state": core.driver.state.name,
        "controller": _controller(core.driver),
        "robot_state": "UNKNOWN" if robot is None else robot.state,
        "robot_state_ns": None if robot is None else robot.t_ns,
        "fault": "UNKNOWN" if robot is None else robot.fault,
        "stop_cause": "UNKNOWN" if robot is None else robot.stop_cause,
        "pose": [estimate.x_m, estimate.y_m, estimate.yaw_rad],
        "pose_ok": estimate.pose_ok,
        "heading_known": estimate.heading_known,
        "wheels": None if wheels is None else [wheels.left_speed_rad_s, wheels.right_speed_rad_s],
        "command": [tick.pipeline.command.left_rad_s, tick.pipeline.command.right_rad_s],
        "source": tick.pipeline.source.value,
        "task": {
            "laps": core.progress.laps,
            "progress": core.progress.in_words(),
            "length_m": core.course.length_m,
            "distance_m": distance,
            "speed_m_s": estimate.speed_m_s,
            "asked": asked_of(task),
            "limits": limits(core.config.robot, task),
            "labels": {name: field.label for name, field in task.editable(core.config.robot).items()},
            "note": task.editing_note(core.config.robot),
        },
        "disturbance": None if tick.pipeline.disturbance is None else asdict_of(tick.pipeline.disturbance),
        "plan": None if plan is None else {"ess": plan.diagnostics.ess, "temperature": plan.diagnostics.temperature},
        "loop": loop,
        "transport": asdict(core.transport.stats),
        "driver": asdict(core.driver.stats),
        "fusion": asdict(core.pipeline.fusion.stats),
        "poses": _poses(core),
        "plausibility": asdict(core.plausibility.stats),
        "recorder": asdict(recorder),
        "adaptation": core.adaptation.status(),
    }


def _poses(core: DaemonCore) -> list[dict[str, Any]]:
    """Each pose source: its frame and place on the robot, and how it does."""
    tick, sources = core.last, core.pipeline.fusion.sources
    found = sources.status(0 if tick is None else tick.pipeline.t_ns)
    return [
        {**one, "origin": list(named.origin), "offset": list(named.offset)}
        for one, named in zip(found, core.config.pose.every(), strict=True)
    ]


def _controller(driver: Driver) -> dict[str, Any] | None:
    identity, kept = driver.identity, driver.limits
    if identity is None or kept is None:
        return None
    said = {name: asdict(limit) for name, limit in kept.known().items()}
    return {**asdict(identity), "words": identity.in_words(), "limits": said}


def _microseconds(summary: dict[str, float]) -> dict[str, float]:
    return {name.removesuffix("_s"): value * 1e6 for name, value in summary.items()}


def counters(
    core: DaemonCore, loop: LoopStats, recorder: RecorderStats, now_ns: int, stolen_ms: int = 0
) -> records.Counters:
    """Every counter of the stack as one record for the log; `stolen_ms` as of `realtime.stolen_ms`, since the start."""
    return records.Counters(
        t_ns=now_ns,
        transport=asdict(core.transport.stats),
        driver=asdict(core.driver.stats),
        fusion=asdict(core.pipeline.fusion.stats),
        plausibility=asdict(core.plausibility.stats),
        recorder={name: value for name, value in asdict(recorder).items() if type(value) is int},
        loop={"ticks": loop.ticks, "overruns": loop.overruns, "skipped": loop.skipped_periods, "stolen_ms": stolen_ms},
        adaptation=core.adaptation.counts(),
        entered=dict(core.entered),
        poses=core.pipeline.fusion.sources.counts(),
    )
