"""A circle that is driven by poses of other sources than the robot's own, in simulated time.

The poses go as datagrams through a real socket and `drivers.pose.udp`, with the rate, noise, delay, losses and outliers
of the source; those without heading are driven by hand first, as a person would.
"""

from __future__ import annotations

import json
import math
import socket
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import msgspec
import numpy as np

from disco_hw.drive import ManualInput, RobotView
from disco_hw.drive.coverage import Coverage
from disco_hw.drive.hand_pilot import HandPilot, UntilHeading
from disco_hw.errors import WorkError
from disco_hw.experiments.simulated_time import SimulatedRun, virtual_robot
from disco_hw.experiments.virtual import true_parameters
from disco_hw.runtime.core import CoreTick, TaskPilot
from disco_hw.runtime.pipeline import Planner
from disco_hw.runtime.robot_setup import Setup
from disco_hw.runtime.supervisor import UserRequest
from drivers.pose.senders import SenderGate
from drivers.pose.udp import UdpPoses
from drivers.types import PoseSample
from sim.body_dynamics import BodyPose
from sim.plant_parameters import PlantParameters

_BY_HAND_LIMIT_S = 20.0
_NEES_EVERY = 25


@dataclass(frozen=True, slots=True)
class PoseKind:
    """Kind of a pose sensor: fields of PlantParameters, and whether it measures the heading."""

    sensor: dict[str, float]
    has_heading: bool = True
    by_datagram: bool = True


ROBOT = PoseKind({}, by_datagram=False)
RTK = PoseKind({"pose_rate_hz": 5.0, "pose_position_std_m": 0.02, "pose_delay_s": 0.15}, has_heading=False)
UDP = PoseKind(
    {"pose_rate_hz": 100.0, "pose_delay_s": 0.04, "pose_dropout_probability": 0.05, "pose_outlier_probability": 0.01}
)


@dataclass(frozen=True, slots=True)
class PoseFigures:
    """Figures of one drive with a pose source.

    `rms_m` of the true distance to the circle after a quarter of a lap, `nees` the mean normalised error squared of the
    estimate (3 where its covariance is right), `straight_m` driven by hand before.
    """

    rms_m: float
    nees: float
    straight_m: float


class Datagrams:
    """The robot's poses, sent to a port of this computer and taken from it; satisfies `drivers.types.PoseSource`."""

    def __init__(self, has_heading: bool) -> None:
        receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        receiver.setblocking(False)
        receiver.bind(("127.0.0.1", 0))
        self._source = UdpPoses(receiver, SenderGate())
        self._sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._sender.connect(receiver.getsockname())
        self._has_heading = has_heading

    def receive(self, now_ns: int, from_robot: Sequence[PoseSample]) -> Sequence[PoseSample]:
        """Send the robot's poses to the port, and return what came over it."""
        for pose in from_robot:
            message: dict[str, Any] = {
                "x_m": pose.x_m,
                "y_m": pose.y_m,
                "position_std_m": pose.position_std_m,
                "age_s": 1e-9 * (now_ns - pose.t_ns),
            }
            if self._has_heading:
                message |= {"yaw_rad": pose.yaw_rad, "yaw_std_rad": pose.yaw_std_rad}
            self._sender.send(json.dumps(message).encode())
        return self._source.receive(now_ns, ())

    def close(self) -> None:
        """Close both ends of the link."""
        self._source.close()
        self._sender.close()


class _Straight:
    """A person who drives straight on while `held`."""

    def __init__(self, wheel_rad_s: float) -> None:
        self.held = False
        self.ended: str | None = None
        self.completed, self.status_text, self.task = True, "", ""
        self._wheel_rad_s = wheel_rad_s

    def poll(self, now_ns: int, _robot: RobotView) -> ManualInput | None:
        return ManualInput(now_ns, self._wheel_rad_s, self._wheel_rad_s, self.held)

    def close(self) -> None:
        """Nothing is held open."""


def drive_circle(setup: Setup, planner: Planner, kind: PoseKind, seed: int, laps: float = 1.25) -> PoseFigures:
    """Drive the circle of robot.toml by such poses; raises WorkError if it cannot be started, or is stopped.

    The robot's geometry is drawn from the model's belief by `seed`, and it slips as much as [estimation] expects.
    """
    task = setup.config.task
    x_m, y_m, yaw_rad = task.course().start
    plant = replace(true_parameters(setup, seed), **_as_slippery(setup), **kind.sensor)  # type: ignore[arg-type]
    run = SimulatedRun(setup, virtual_robot(setup, plant, BodyPose(x_m, y_m, yaw_rad), seed=seed), planner)
    hand = _Straight(0.5 * task.speed_m_s / setup.config.robot.wheel_radius_m)
    run.pilot = UntilHeading(TaskPilot(), HandPilot(hand, Coverage(setup.config.robot.max_wheel_speed_rad_s)))
    if kind.by_datagram:
        run.core.pose_source = Datagrams(kind.has_heading)
    try:
        run.run(2.0)
        before = run.robot.truth
        for _ in range(round(_BY_HAND_LIMIT_S / 0.5)):
            if _estimate(run).heading_known:
                break
            hand.held = True
            run.run(0.5)
        hand.held = False
        run.run(2.0)
        straight_m = math.hypot(run.robot.truth.x_m - before.x_m, run.robot.truth.y_m - before.y_m)
        started = run.run(1.5, UserRequest.ARM, UserRequest.START)
        refused = [reply.text for tick in started for reply in tick.output.replies if not reply.accepted]
        if refused or not started[-1].output.running:
            raise WorkError(f"the virtual robot was not started: {refused}")
        return _driven(run, laps, straight_m)
    finally:
        run.core.pose_source.close()


def _as_slippery(setup: Setup) -> dict[str, float]:
    """Slip of the plant that spreads the body in a metre of the circle as much as [estimation] expects.

    Noise of standard deviation s that is correlated over tau spreads by 2 s^2 tau in a second (Ornstein-Uhlenbeck).
    """
    expected, task = setup.config.estimation, setup.config.task
    per_s = task.speed_m_s / (2.0 * PlantParameters().slip_correlation_s)
    turn_rad_per_m = 2.0 * math.pi / task.course().length_m
    yaw_rad2_per_m = expected.slip_std_rad_per_sqrt_m**2 + expected.slip_std_rad_per_sqrt_rad**2 * turn_rad_per_m
    position = expected.slip_std_m_per_sqrt_m * math.sqrt(per_s)
    return {
        "slip_std_x_m_s": position,
        "slip_std_y_m_s": position,
        "slip_std_yaw_rad_s": math.sqrt(yaw_rad2_per_m * per_s),
    }


def _estimate(run: SimulatedRun) -> Any:
    last: CoreTick | None = run.core.last
    assert last is not None
    return last.pipeline.estimate


def _driven(run: SimulatedRun, laps: float, straight_m: float) -> PoseFigures:
    task: Any = run.core.task
    lap_s = math.tau * task.radius_m / task.speed_m_s
    run.run(0.25 * lap_s)
    off, nees = [], []
    for number, tick in enumerate(run.ticks(laps * lap_s)):
        if not tick.output.running:
            raise WorkError(f"the task was stopped: {tick.events}")
        truth, estimate = run.robot.truth, tick.pipeline.estimate
        off.append(math.hypot(truth.x_m - task.center_x_m, truth.y_m - task.center_y_m) - task.radius_m)
        if number % _NEES_EVERY == 0:
            yaw = math.remainder(estimate.yaw_rad - truth.yaw_rad, math.tau)
            error = np.array([estimate.x_m - truth.x_m, estimate.y_m - truth.y_m, yaw])
            nees.append(float(error @ np.linalg.solve(np.array(estimate.covariance), error)))
    return PoseFigures(float(np.sqrt(np.mean(np.square(off)))), float(np.mean(nees)), straight_m)


def with_circle(setup: Setup, radius_m: float, speed_m_s: float) -> Setup:
    """The robot with this task and with wheels that are fast enough for it."""
    config = setup.config
    fast = 1.6 * speed_m_s / config.robot.wheel_radius_m
    robot = msgspec.structs.replace(config.robot, max_wheel_speed_rad_s=max(fast, config.robot.max_wheel_speed_rad_s))
    circle: Any = config.task
    task = msgspec.structs.replace(circle, radius_m=radius_m, speed_m_s=speed_m_s)
    return replace(setup, config=msgspec.structs.replace(config, robot=robot, task=task))
