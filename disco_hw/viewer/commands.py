"""What `disco-hw view` does: one function for the live page, one for each use of a log."""

from __future__ import annotations

from pathlib import Path

from disco_hw.config import load_robot_config
from disco_hw.daemon.client import socket_path
from disco_hw.daemon.signals import StopSignals
from disco_hw.viewer.live import LivePage, run_live
from disco_hw.viewer.recording import Recording
from disco_hw.viewer.replay import ReplayPage, run_replay
from disco_hw.viewer.server import DEFAULT_PORT, LOOPBACK, serving
from disco_hw.viewer.stage import stage_of_robot


def view_live(robot: Path, model: Path | None = None, host: str = LOOPBACK, port: int = DEFAULT_PORT) -> int:
    """Serve the live page of this robot's daemon until SIGTERM or SIGINT; returns the exit code.

    The daemon may come and go. Raises InputError for a bad file, or a host or port that cannot be listened to.
    """
    stage = stage_of_robot(robot, model)
    socket = socket_path(load_robot_config(robot))
    with StopSignals() as signals, serving(f"disco-hw: {stage.name}", host, port) as page:
        live = LivePage(page.server, stage, socket, robot)
        print(f"page: {page.url}", flush=True)
        run_live(live, lambda: signals.received is not None)
    return 0


def view_log(log: Path, robot: Path | None = None, host: str = LOOPBACK, port: int = DEFAULT_PORT) -> int:
    """Serve the replay of a log until SIGTERM or SIGINT; returns the exit code.

    `robot` replaces the robot.toml kept in the log. Raises InputError for a bad file, host or port.
    """
    with (
        StopSignals() as signals,
        Recording(log, robot) as recording,
        serving(f"disco-hw: {log.name}", host, port) as page,
    ):
        replay = ReplayPage(page.server, recording)
        print(f"page: {page.url}", flush=True)
        run_replay(replay, lambda: signals.received is not None)
    return 0
