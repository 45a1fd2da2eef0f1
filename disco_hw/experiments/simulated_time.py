"""The daemon's core and a virtual robot in one process and in simulated time: the robot's own tick, without a clock.

The one harness of experiments, tests and tools. What happens is recorded in memory and can be written as a log.
`drive_virtual` drives it by a control law of your own, or by DISCO beside it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from disco_hw.adaptation.guard import choose_adaptation
from disco_hw.config import RobotConfig
from disco_hw.control.plan import PLANNER_VERSION, Law
from disco_hw.errors import InputError, WorkError
from disco_hw.experiments.virtual import true_parameters
from disco_hw.log import MODEL_TOML, Attachment
from disco_hw.log.process_recorder import ProcessRecorder, RecordingSettings
from disco_hw.log.recorder import MemoryRecorder
from disco_hw.model import model_text
from disco_hw.reports import refuse_file
from disco_hw.runtime.assembly import assemble_core, create_fast_adaptation, create_pipeline, driver_of, planner_of
from disco_hw.runtime.core import CoreTick, DaemonCore, FindsWiring, Pilot, TaskPilot
from disco_hw.runtime.pipeline import Planner
from disco_hw.runtime.robot_setup import Setup, kept_files, load_setup
from disco_hw.runtime.supervisor import UserRequest
from firmware_protocol.firmware_core import FirmwareConfig
from sim.body_dynamics import BodyPose
from sim.effects import HiddenEffectError, hidden_effects
from sim.plant import Plant
from sim.plant_parameters import PlantParameters
from sim.virtual_robot import STEP_US, RobotInProcess, VirtualRobot

# Chosen: handshake and first poses, and arming, take less.
_READY_S, _ARMED_S = 1.5, 0.5
# Chosen: simulated time makes a log faster than a disk takes it.
_CLOSING_S = 60.0


def virtual_robot(
    setup: Setup,
    plant: PlantParameters,
    start: BodyPose,
    *,
    effects: Mapping[str, float | Sequence[float]] | None = None,
    seed: int = 1,
) -> RobotInProcess:
    """Return a robot with this plant whose controller has the limits of robot.toml.

    `effects`: hidden ones, as in `sim.effects`. Raises HiddenEffectError.
    """
    robot = setup.config.robot
    firmware = FirmwareConfig(
        ticks_per_rev=plant.ticks_per_rev,
        max_wheel_speed_rad_s=robot.max_wheel_speed_rad_s,
        max_wheel_acceleration_rad_s2=robot.max_wheel_acceleration_rad_s2,
    )
    return RobotInProcess(VirtualRobot(Plant(plant, hidden_effects(effects or {}), seed, start), firmware))


class SimulatedRun:
    """A virtual robot, driven by the daemon's core with this planner and pilot.

    Without `needs_pose` motion needs no pose, whatever robot.toml says.
    """

    def __init__(
        self,
        setup: Setup,
        robot: RobotInProcess,
        planner: Planner,
        pilot: Pilot | None = None,
        *,
        needs_pose: bool | None = None,
        recorder: MemoryRecorder | None = None,
    ) -> None:
        self.robot = robot
        self.pilot = pilot or TaskPilot()
        self.recorder = recorder or MemoryRecorder()
        self.now_us = 0
        self._setup = setup
        pipeline = create_pipeline(setup.config, setup.model, planner)
        chosen = choose_adaptation(setup.config.control, setup.config.pose, setup.model)
        self.core: DaemonCore = assemble_core(
            setup.config,
            robot.host,
            driver_of(setup.config),
            pipeline,
            self.recorder,
            self.pilot.needs_pose if needs_pose is None else needs_pose,
            adaptation=create_fast_adaptation(setup, pipeline) if chosen.kind == "fast" else None,
        )
        if isinstance(self.pilot, FindsWiring):
            self.core.directions = None
        self._period_us = round(1e6 / setup.config.control.rate_hz)

    def ticks(self, duration_s: float, *requests: UserRequest) -> Iterator[CoreTick]:
        """Let time pass and give every tick as it comes; the requests come with the first one."""
        end_us = self.now_us + round(duration_s * 1e6)
        while self.now_us < end_us:
            self.now_us += STEP_US
            self.robot.advance(self.now_us)
            # At rates whose period is no whole number of steps a tick comes with the first step that is due.
            if self.now_us // self._period_us == (self.now_us - STEP_US) // self._period_us:
                continue
            now_ns = self.now_us * 1000
            desired = self.pilot.step(now_ns, self.core.last)
            tick = self.core.tick(
                now_ns, (*requests, *desired.requests), motion=desired.motion, by_hand=desired.by_hand
            )
            self.pilot.learn(now_ns, tick, tick.output.replies[len(requests) :])
            requests = ()
            yield tick

    def run(self, duration_s: float, *requests: UserRequest) -> list[CoreTick]:
        """Run for a duration and return all ticks; the requests come with the first one."""
        return list(self.ticks(duration_s, *requests))

    def start(self) -> None:
        """Arm and start the task; raises WorkError if the robot refuses."""
        self.run(_READY_S)
        for tick in self.ticks(_ARMED_S, UserRequest.ARM):
            for reply in tick.output.replies:
                if not reply.accepted:
                    raise WorkError(f"the virtual robot could not be armed: {reply.text}")
        self.run(self._period_us * 1e-6, UserRequest.START)

    def drive(self, limit_s: float) -> None:
        """Let the pilot drive to its end; raises WorkError if it takes longer."""
        for _ in self.ticks(limit_s):
            if self.pilot.done:
                return
        raise WorkError(f"the drive was not over after {limit_s:.0f} s")

    def write_log(self, path: Path) -> None:
        """Write what was recorded as a log that every verb reads; raises WorkError if that fails."""
        setup = replace(self._setup, model_file=None)
        model = Attachment(MODEL_TOML, "application/toml", model_text(setup.model).encode())
        attachments = (*kept_files(setup), model)
        ticks = self.recorder.ticks
        recorder = ProcessRecorder(
            RecordingSettings(
                path,
                self._setup.config.robot.name,
                planner=PLANNER_VERSION,
                attachments=attachments,
                queue_ticks=len(ticks) + 1,
            )
        )
        for now_ns, records in ticks:
            recorder.put(now_ns, records)
        stats = recorder.close(_CLOSING_S)
        if stats.missing_ticks or stats.refused:
            raise WorkError(f"{path}: could not be written completely; check the disk")


Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class VirtualDrive:
    """Record of a virtual robot's drive, tick by tick: `t_s` (N,) since the start, and the true motion.

    `poses` (N, 3): x, y (m), yaw (rad) of the tracked point; `speeds` (N,) m/s forward; `commands` (N, 2): wheel speeds
    sent, left and right (rad/s), NaN where none was. `laps` of the task; `events`: what the daemon said.
    """

    t_s: Array
    poses: Array
    speeds: Array
    commands: Array
    laps: float
    events: tuple[str, ...]


def drive_virtual(
    robot: Path | str,
    law: Law | None = None,
    seconds: float = 60.0,
    *,
    model: Path | str | None = None,
    hide: Mapping[str, float | Sequence[float]] | None = None,
    log: Path | str | None = None,
    seed: int = 1,
) -> VirtualDrive:
    """Drive the task of a robot.toml on a virtual robot, in simulated time, from the task's start; see `VirtualDrive`.

    The daemon's own tick: estimation, limits and supervision are those of the real robot. Its controller is the
    reference firmware, which sends the poses, whatever [link], [wheels] and [pose] say; the geometry is learnt on the
    way where the real robot would learn it. `law`: yours; DISCO if None.
    `hide`: effects that the plant has and the model lacks (`disco-hw sim --list-effects`). `log`: an MCAP file to
    write. Raises InputError for wrong files and effects, WorkError if the robot refuses to start.
    """
    setup = _at_the_reference_controller(load_setup(Path(robot), None if model is None else Path(model)))
    if log is not None:
        refuse_file(Path(log))
    start = BodyPose(*setup.config.task_start)
    try:
        virtual = virtual_robot(setup, true_parameters(setup, None), start, effects=hide, seed=seed)
    except HiddenEffectError as error:
        raise InputError(f"hide: {error}") from None
    run = SimulatedRun(setup, virtual, planner_of(setup, law))
    run.start()
    rows: list[tuple[Any, ...]] = []
    events: list[str] = []
    begun_us = run.now_us
    for tick in run.ticks(seconds):
        truth = virtual.truth
        sent = (np.nan, np.nan) if tick.command is None else (tick.command.left_rad_s, tick.command.right_rad_s)
        rows.append(((run.now_us - begun_us) * 1e-6, truth.x_m, truth.y_m, truth.yaw_rad, truth.speed_m_s, *sent))
        events += tick.events
    if log is not None:
        run.write_log(Path(log))
    table = np.array(rows, dtype=np.float64).reshape(-1, 7)
    return VirtualDrive(table[:, 0], table[:, 1:4], table[:, 4], table[:, 5:7], run.core.progress.laps, tuple(events))


def _at_the_reference_controller(setup: Setup) -> Setup:
    usual = {field.name: field.default for field in msgspec.structs.fields(RobotConfig)}
    changed = {name: usual[name] for name in ("link", "wheels", "pose")}
    return replace(setup, config=msgspec.structs.replace(setup.config, **changed))
