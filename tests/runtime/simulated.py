"""The daemon's core and the virtual robot in one process and in simulated time, over an in-process link."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import disco_hw
from disco_hw.log.recorder import MemoryRecorder
from disco_hw.runtime.assembly import assemble_core, make_driver, make_pipeline, make_planner
from disco_hw.runtime.core import CoreTick, DaemonCore
from disco_hw.runtime.pilot import Pilot, TaskPilot
from disco_hw.runtime.pipeline import Planner
from disco_hw.runtime.robot_setup import load_setup
from disco_hw.runtime.supervisor import UserRequest
from drivers.transport import connect_pair
from drivers.types import OutgoingFrame
from firmware_protocol.firmware_core import FirmwareConfig
from sim.body_dynamics import Pose
from sim.effects import hidden_effects
from sim.plant import Plant
from sim.plant_parameters import PlantParameters
from sim.virtual_robot import STEP_US, VirtualRobot

FOREVER_NS = 1 << 62
ROBOT_FILE = Path(disco_hw.__file__).parent / "robots" / "wombot.toml"
START = Pose(0.75, 0.0, 1.5707963)


@dataclass
class SimulatedStack:
    """Everything of one run; `run` moves time on and keeps every tick."""

    core: DaemonCore
    robot: VirtualRobot
    recorder: MemoryRecorder
    robot_end: object
    pilot: Pilot = field(default_factory=TaskPilot)
    now_us: int = 0

    def run(self, duration_s: float, *requests: UserRequest) -> list[CoreTick]:
        """Let time pass; the requests come with the first tick."""
        ticks = []
        period_us = round(1e6 / self.core.config.control.rate_hz)
        end_us = self.now_us + round(duration_s * 1e6)
        while self.now_us < end_us:
            self.now_us += STEP_US
            for received in self.robot_end.receive():
                self.robot.receive(self.now_us, received.frame)
            for frame in self.robot.step(self.now_us):
                self.robot_end.send(OutgoingFrame(frame, FOREVER_NS), self.now_us * 1000)
            if self.now_us % period_us == 0:
                now_ns = self.now_us * 1000
                wanted = self.pilot.step(now_ns, self.core.last)
                tick = self.core.tick(now_ns, (*requests, *wanted.requests), motion=wanted.motion)
                self.pilot.learn(now_ns, tick, tick.replies[len(requests) :])
                ticks.append(tick)
                requests = ()
        return ticks


def simulated_stack(
    planner: Planner | None = None,
    seed: int = 1,
    needs_pose: bool = True,
    robot_file: Path = ROBOT_FILE,
    start: Pose = START,
    hide: dict[str, float] | None = None,
    **changes: float,
) -> SimulatedStack:
    """The shipped robot with a plant at the posterior's mean; `hide`: effects, `changes`: fields of PlantParameters."""
    setup = load_setup(robot_file)
    host_end, robot_end = connect_pair()
    recorder = MemoryRecorder()
    pipeline = make_pipeline(setup.config, setup.model, planner or make_planner(setup.config, setup.model))
    core = assemble_core(setup.config, host_end, make_driver(), pipeline, recorder, needs_pose)
    plant = Plant(replace(PlantParameters(), **changes), hidden_effects(hide or {}), seed, start)
    robot = VirtualRobot(plant, FirmwareConfig(ticks_per_rev=2048, max_wheel_speed_rad_s=8.0), seed=seed)
    host_end.open()
    robot_end.open()
    return SimulatedStack(core, robot, recorder, robot_end)
