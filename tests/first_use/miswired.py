"""A virtual robot whose wiring, ticks or poses are wrong, and a person who looks at its wheels; in simulated time."""

from __future__ import annotations

import math
import socket
from dataclasses import dataclass, replace

import msgspec

from disco_hw.drive import ManualInput
from disco_hw.errors import WorkError
from disco_hw.experiments import with_device
from disco_hw.experiments.simulated_time import SimulatedRun
from disco_hw.first_use.commission import as_sent
from disco_hw.first_use.procedure import CommissionPilot, DriveWheels, Procedure, Prompt, speed_of
from disco_hw.runtime import State
from disco_hw.runtime.pipeline import NoPlanner
from disco_hw.runtime.robot_setup import load_setup
from drivers.motor import find_driver
from firmware_protocol.firmware_core import FirmwareConfig
from sim.body_dynamics import BodyPose
from sim.devices import find_controller
from sim.effects import hidden_effects
from sim.plant import Plant
from sim.plant_parameters import PlantParameters
from sim.process import PoseSender
from sim.virtual_robot import STEP_US, RobotInProcess, VendorRobot, VirtualRobot
from tests.drivers.waiting import free_port
from tests.runtime.simulated import ROBOT_TEXT


@dataclass(frozen=True)
class Miswiring:
    """What is wrong, in the robot's own terms: signs and places of motors and encoders, true turns for each told one.

    `dead_encoders`: sides whose encoder stands still. `pose`: what the sensor makes of (x, y, yaw).
    """

    swapped: bool = False
    crossed: bool = False
    motors: tuple[int, int] = (1, 1)
    encoders: tuple[int, int] = (1, 1)
    ratio: float = 1.0
    dead_encoders: tuple[int, ...] = ()
    pose: object = None


class MiswiredPlant:
    """A plant behind the wrong wires: everything but `physical` is as its controller sees it."""

    def __init__(self, plant, wrong, sink):
        self._plant, self._wrong, self._sink = plant, wrong, sink

    def __getattr__(self, name):
        return getattr(self._plant, name)

    @property
    def physical(self):
        return self._plant.truth

    def step(self, until_us, left, right, enabled=True, brake=False):
        wrong = self._wrong
        if wrong.swapped:
            left, right = right, left
        turned = [way * speed * wrong.ratio for way, speed in zip(wrong.motors, (left, right), strict=True)]
        for pose in self._plant.step(until_us, *turned, enabled, brake):
            x, y, yaw = (pose.x_m, pose.y_m, pose.yaw_rad)
            if wrong.pose is not None:
                x, y, yaw = wrong.pose(x, y, yaw)
            self._sink(msgspec.structs.replace(pose, x_m=x, y_m=y, yaw_rad=yaw), until_us)
        return []

    def _reported(self, of_sides):
        wrong = self._wrong
        reported = [
            0 if side in wrong.dead_encoders else way * value / wrong.ratio
            for side, (way, value) in enumerate(zip(wrong.encoders, of_sides, strict=True))
        ]
        return reported[::-1] if wrong.swapped != wrong.crossed else reported

    @property
    def encoder_ticks(self):
        left, right = self._reported(self._plant.encoder_ticks)
        return round(left), round(right)

    @property
    def measured_wheel_speeds_rad_s(self):
        return tuple(self._reported(self._plant.measured_wheel_speeds_rad_s))

    @property
    def truth(self):
        """For a released motor, which rolls on as it did, as its own channel would say it."""
        true = self._plant.truth
        speeds = [
            way * speed / self._wrong.ratio
            for way, speed in zip(self._wrong.motors, (true.left_speed_rad_s, true.right_speed_rad_s), strict=True)
        ]
        if self._wrong.swapped:
            speeds.reverse()
        return msgspec.structs.replace(true, left_speed_rad_s=speeds[0], right_speed_rad_s=speeds[1])


class MiswiredRobot:
    """On an in-process link; its poses come by datagrams."""

    def __init__(self, setup, plant, wrong, effects=None, seed=1, step_us=STEP_US):
        self.sender = PoseSender((setup.config.pose.address, setup.config.pose.port))
        self.plant = MiswiredPlant(
            Plant(plant, hidden_effects(effects or {}), seed, BodyPose(0.3, -0.2, 0.5)), wrong, self.sender.send
        )
        config = setup.config
        name = config.link.driver
        if name in (None, "reference"):
            # It allows what robot.toml asks for, in turns as it counts them: as `check` says where a ratio is written.
            robot, ratio = config.robot, config.wheels.turn_ratio
            firmware = FirmwareConfig(
                ticks_per_rev=plant.ticks_per_rev,
                max_wheel_speed_rad_s=robot.max_wheel_speed_rad_s / ratio,
                max_wheel_acceleration_rad_s2=robot.max_wheel_acceleration_rad_s2 / ratio,
                cycle_s=1e-6 * step_us,
            )
            self.board = VirtualRobot(self.plant, firmware)
        else:
            self.board = VendorRobot(self.plant, find_controller(name)(config.link.settings(), plant.ticks_per_rev))
        # VESC speaks on CAN and on a serial line, and asks for answers on the latter only.
        exchange = find_driver(name).exchange if config.link.kind == "serial" else None
        exchange = None if exchange is None else exchange(config.link.settings())
        self._process = RobotInProcess(self.board, exchange, step_us)
        self.host = self._process.host

    def advance(self, until_us):
        self._process.advance(until_us)

    def close(self):
        self.sender.close()


class SimulatedOperator:
    """Holds the deadman while something is to be driven, looks at the wheels, answers; satisfies ManualSource."""

    completed, status_text, task, ended = True, "a person", "", None

    def __init__(self, plant):
        self.plant, self.pilot = plant, None
        self.angles, self.last_us = [0.0, 0.0], None
        self._open_ns = self._requested_ns = None
        self._from, self._pressed_ns, self._let_go = (0.0, 0.0), None, False

    @property
    def action(self):
        return self.pilot.procedure.action

    def look(self):
        true = self.plant.physical
        now = true.t_us
        if self.last_us is not None:
            for side, speed in enumerate((true.left_speed_rad_s, true.right_speed_rad_s)):
                self.angles[side] += speed * (now - self.last_us) * 1e-6
        self.last_us = now
        return list(self.angles)

    def turned(self):
        return [now - before for now, before in zip(self.angles, self._from, strict=True)]

    def poll(self, now_ns, robot):
        self.look()
        needs_driving = self.action is not None and not isinstance(self.action, Prompt)
        counting = isinstance(self.action, DriveWheels) and "exactly one turn" in self.action.todo
        if counting and max(map(abs, self.turned())) >= 2.0 * math.pi:
            self._let_go = True
        if not counting:
            self._let_go = False
        pressed = needs_driving and not self._let_go and robot.state in (State.READY, State.ARMED)
        if pressed and self._pressed_ns is None:
            # Open once, then pressed.
            self._pressed_ns, self._from = now_ns, tuple(self.angles)
            return ManualInput(now_ns, 0.0, 0.0, deadman=False)
        if (
            pressed
            and not robot.driving
            and isinstance(self.action, DriveWheels)
            and now_ns - self._pressed_ns > 3_000_000_000
        ):
            pressed = False
        if not pressed:
            self._pressed_ns = None
        return ManualInput(now_ns, 0.0, 0.0, deadman=pressed)

    def keys(self):
        if not isinstance(self.action, Prompt):
            self._requested_ns = None
            return ""
        if "exactly" in self.action.prompt or "one turn" in self.action.prompt:
            self._let_go, self._from = False, tuple(self.angles)
            return "y"
        turned = self.turned()
        side = max((0, 1), key=lambda k: abs(turned[k]))
        if abs(turned[side]) < 0.05:
            return "0"
        return str(1 + 2 * side + (turned[side] < 0.0))

    def close(self):
        pass


def robot_file(directory, driver=None):
    """The shipped robot with poses by datagrams and another controller."""
    if driver not in (None, "reference"):
        text = with_device(ROBOT_TEXT, driver)
    else:
        text = ROBOT_TEXT + f'\n[pose]\nsource = "udp"\nport = {free_port(socket.SOCK_DGRAM)}\n'
    path = directory / "robot.toml"
    path.write_text(text, encoding="utf-8")
    return path


def stage(path, steps, wrong, plant=None, effects=None, raw_poses=False, limit_s=300.0, **options):
    """Go through one stage of the guided drive; its result and the run."""
    setup = load_setup(path)
    # As in `commission`, nothing is learnt while wheels are off the ground.
    setup = replace(
        setup,
        config=msgspec.structs.replace(
            setup.config, control=msgspec.structs.replace(setup.config.control, adaptation="off")
        ),
    )
    if raw_poses:
        setup = as_sent(setup)
    robot = MiswiredRobot(setup, plant or PlantParameters(), wrong, effects, **options)
    operator = SimulatedOperator(robot.plant)
    slowest_rad_s = setup.config.slowest_wheel_rad_s
    pilot = CommissionPilot(Procedure(steps(setup.config.robot, slowest_rad_s)), operator, operator.keys)
    operator.pilot = pilot
    run = SimulatedRun(setup, robot, NoPlanner(), pilot)
    run.where, run.slow_rad_s = [], speed_of(setup.config.robot, slowest_rad_s)
    try:
        for tick in run.ticks(limit_s):
            run.where.append((tick.command, robot.plant.physical))
            if pilot.done:
                break
    finally:
        robot.close()
        run.core.pose_source.close()
    assert pilot.done, f"stuck at {pilot.procedure.action}: {run.core.last.output}"
    if pilot.fault_text is not None:
        raise WorkError(pilot.fault_text)
    return pilot.procedure.result, run, operator
