"""A robot of which a wheel ceases to obey, in simulated time: any driver with its simulated controller, and the tick.

The daemon's own tick drives a circle or a straight line by a simple law. The plant says what truly happened: a fault
shows from when it is there while a wheel is commanded, and the robot is stopped when all wheels stand.
"""

from __future__ import annotations

import math
import shutil
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from disco_hw.config import SHIPPED_ROBOT
from disco_hw.control.plan import LawController
from disco_hw.experiments.simulated_time import SimulatedRun, virtual_robot
from disco_hw.runtime import State
from disco_hw.runtime.robot_setup import Setup, load_setup
from drivers.motor import find_driver
from drivers.types import PoseSample
from sim.body_dynamics import BodyPose
from sim.devices import find_controller
from sim.effects import hidden_effects
from sim.fault_schedule import KINDS, ScheduledFault
from sim.plant import Plant
from sim.plant_parameters import PlantParameters
from sim.sensors import PoseMeasurement
from sim.virtual_robot import RobotInProcess, VendorRobot

ROBOTS = SHIPPED_ROBOT.parent
RADIUS_M = 0.75
STATIONARY_RAD_S = 0.1
FAULTS: Mapping[str, tuple[str, dict[str, Any]]] = {
    "frozen": ("encoder_stuck", {}),
    "disconnected": ("encoder_disconnected", {}),
    "reversed": ("encoder_reversed", {}),
    "blocked": ("motor_stall", {}),
    "runs away": ("motor_runaway", {"speed_rad_s": 15.0}),
}
_FOREVER_NS = 1 << 62


class _Poses:
    """Pose source of what the robot's own sensor measured (a `drivers.types.PoseSource`)."""

    def __init__(self) -> None:
        self._waiting: list[PoseSample] = []

    def take(self, pose: PoseMeasurement, now_us: int) -> None:
        """Store one measured pose."""
        self._waiting.append(
            PoseSample(
                1000 * pose.sample_us, 1000 * now_us, pose.x_m, pose.y_m, pose.yaw_rad, pose.position_std_m,
                pose.yaw_std_rad,
            )
        )  # fmt: skip

    def receive(self, now_ns: int, from_robot: Sequence[PoseSample]) -> Sequence[PoseSample]:
        """All since the last call."""
        poses, self._waiting = self._waiting, []
        return poses

    def close(self) -> None:
        """Do nothing, because the source holds no resources."""


def vendor_robot(setup: Setup, plant: Plant, pose_sink: Callable[[PoseMeasurement, int], None]) -> RobotInProcess:
    """Return a vendor's simulated controllers on an in-process link."""
    link = setup.config.link
    create_controller = find_controller(str(link.driver))
    assert create_controller is not None
    controller: Any = create_controller(link.settings(), plant.parameters.ticks_per_rev)
    exchange = find_driver(link.driver).exchange if link.kind == "serial" else None
    board = VendorRobot(plant, controller, pose_sink)
    return RobotInProcess(board, None if exchange is None else exchange(link.settings()))


def setup_of(driver: str, speed_m_s: float) -> Setup:
    """The shipped robot with this driver's example for [link]."""
    text = (ROBOTS / "wombot.toml").read_text()
    text = text.replace("speed_m_s = 0.2", f"speed_m_s = {speed_m_s}")
    begin, end = text.index("[link]"), text.index("[control]")
    found = find_driver(driver)
    if driver != "reference":
        medium = 'interface = "virtual"\nchannel = "none"\n' if "can" in found.kinds else 'port = "/dev/none"\n'
        kind = found.kinds[0]
        text = f'{text[:begin]}[link]\ndriver = "{driver}"\nkind = "{kind}"\n{medium}{found.example}\n{text[end:]}'
        # At the slowest speeds a VESC has to be set for less than its usual 900 electrical rpm.
        text = text.replace("pole_pairs = 7", "pole_pairs = 7\nmin_erpm = 200.0")
    with tempfile.TemporaryDirectory() as folder:
        robot = Path(folder) / "robot.toml"
        robot.write_text(text)
        shutil.copy(ROBOTS / "wombot_model.toml", folder)
        return load_setup(robot)


class Law:
    """Drives the circle or straight on along the x axis, by the estimate."""

    def __init__(self, track: str, speed_m_s: float, wheels: tuple[float, float]) -> None:
        self._track, self._speed_m_s = track, speed_m_s
        self._radius_m, self._axial_m = wheels

    def __call__(self, state: Any, task: Any, model: Any) -> tuple[float, float]:
        """Wheel speeds, left and right."""
        if self._track == "circle":
            bearing = math.atan2(state.y_m, state.x_m) + 0.35
            ahead = (RADIUS_M * math.cos(bearing) - state.x_m, RADIUS_M * math.sin(bearing) - state.y_m)
            error = math.remainder(math.atan2(ahead[1], ahead[0]) - state.yaw_rad, 2.0 * math.pi)
            turn = self._speed_m_s / RADIUS_M * (1.0 + 2.0 * (error - 0.175))
        else:
            turn = -self._speed_m_s * (2.0 * math.remainder(state.yaw_rad, 2.0 * math.pi) + 2.0 * state.y_m)
        turn = max(-2.0 * self._speed_m_s / RADIUS_M, min(2.0 * self._speed_m_s / RADIUS_M, turn))
        half = 0.5 * self._axial_m * turn
        return (self._speed_m_s - half) / self._radius_m, (self._speed_m_s + half) / self._radius_m


@dataclass
class WheelRun:
    """Outcome of one run; times in s from when the fault showed, angles in rad of the worst wheel's true travel."""

    driver: str
    fault: str
    speed_m_s: float
    track: str
    side: str
    stopped_s: float = math.nan
    travel_rad: float = math.nan
    noticed_s: float = math.nan
    status_text: str = ""
    events: list[str] = field(default_factory=list)

    @property
    def is_missed(self) -> bool:
        """Whether the robot did not stop within 0.3 rad of true wheel travel or 1 s, whichever is later."""
        return not (self.stopped_s <= 1.0 or self.travel_rad <= 0.3)

    @property
    def is_wrong(self) -> bool:
        """Whether what was said names another wheel, or what cannot be the cause; a wiring advice always is wrong."""
        if not self.status_text:
            return False
        allowed = {
            "frozen": ("does not count", "does not turn although"),
            "disconnected": ("does not count", "does not turn although"),
            "reversed": ("counts backwards", "counts opposite", "runs away"),
            "blocked": ("does not turn although", "whether it turns"),
            "runs away": ("runs away",),
        }[self.fault]
        if self.driver == "reference":
            # What its firmware finds by itself.
            firmware = {"frozen": "ENCODER_MISSING", "disconnected": "ENCODER_MISSING", "reversed": "WRONG_DIRECTION",
                        "blocked": "STALL"}.get(self.fault, "WRONG_DIRECTION")  # fmt: skip
            if f"{firmware}_{self.side.upper()}" in self.status_text:
                return False
        other = {"left": "right", "right": "left"}[self.side]
        if self.fault in ("frozen", "disconnected", "reversed") and self.driver in ("odrive", "vesc"):
            # Turned by its encoder, such a motor locks: the wheel does stand.
            allowed = ("does not turn although", "does not count", "counts backwards", "counts opposite")
        named = f"the {self.side} " in self.status_text and f"the {other} " not in self.status_text
        return "robot.toml" in self.status_text or not named or not any(part in self.status_text for part in allowed)


class WheelFaultRun:
    """One robot with a driver and a plant, driving by a law."""

    def __init__(
        self, driver: str, speed_m_s: float, track: str, *, seed: int = 0, plant: PlantParameters | None = None,
        hide: Mapping[str, float | Sequence[float]] | None = None,
    ) -> None:  # fmt: skip
        setup = setup_of(driver, speed_m_s)
        plant = plant or PlantParameters()
        start = BodyPose(RADIUS_M, 0.0, 0.5 * math.pi) if track == "circle" else BodyPose()
        poses = _Poses()
        if driver == "reference":
            robot = virtual_robot(setup, plant, start, effects=hide, seed=seed)
        else:
            robot = vendor_robot(setup, Plant(plant, hidden_effects(hide or {}), seed, start), poses.take)
        law = Law(track, speed_m_s, (0.061, 0.415))
        planner = LawController(law, setup.model, setup.config.task.planned(setup.config.control.mode))
        self.stack = SimulatedRun(setup, robot, planner)
        if driver != "reference":
            self.stack.core.pose_source.close()
            self.stack.core.pose_source = poses
        self.board = robot.board

    def drive(self, seconds: float) -> list[str]:
        """Arm, start and drive; returns events of a robot that stopped by itself, none where it drove all the time."""
        self.stack.start()
        for tick in self.stack.ticks(seconds):
            if tick.output.state is not State.ARMED:
                return [*tick.events, tick.output.detail]
        return []

    def strike(self, run: WheelRun, seconds: float) -> WheelRun:
        """Let the fault happen and see what becomes of it."""
        kind, values = FAULTS[run.fault]
        fault = ScheduledFault(0, KINDS[kind], 0, _FOREVER_NS, {"wheel": run.side, **values})
        self.board.faults.set_active([fault])
        begun_us, shows_us, travel, last_us = self.stack.now_us, None, 0.0, self.stack.now_us
        stood_us: int | None = None
        for tick in self.stack.ticks(seconds):
            now_us = self.stack.now_us
            truth = self.board.plant.truth
            true = (truth.left_speed_rad_s, truth.right_speed_rad_s)
            if shows_us is None:
                commanded = (0.0, 0.0) if tick.command is None else (tick.command.left_rad_s, tick.command.right_rad_s)
                shows_us = begun_us if max(map(abs, commanded)) > 0.0 else None
            if shows_us is not None:
                travel += max(map(abs, true)) * 1e-6 * (now_us - last_us)
            last_us = now_us
            run.events += tick.events
            if math.isnan(run.noticed_s) and tick.output.state is not State.ARMED and shows_us is not None:
                run.noticed_s = 1e-6 * (now_us - shows_us)
                run.status_text = tick.output.detail
            is_stationary = max(map(abs, true)) < STATIONARY_RAD_S and not tick.output.motion_allowed
            stood_us = (stood_us or now_us) if is_stationary and not math.isnan(run.noticed_s) else None
            if stood_us == now_us:
                run.stopped_s, run.travel_rad = 1e-6 * (now_us - (shows_us or begun_us)), travel
            if stood_us is not None and now_us - stood_us > 500_000:
                return run
        if stood_us is None:
            run.stopped_s, run.travel_rad = math.nan, travel
        return run
