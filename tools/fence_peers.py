"""Adds drives of others to the folder of `disco-hw experiment fence`: an NMPC alone, and the guard on a MuJoCo robot.

    python -m tools.fence_peers -o out/fence [--alone N] [--mujoco N] [--tasks N] [--seed N]

Drives that the folder has already are not driven again. The NMPC (`tools/nmpc.py`) follows the line under the nominal
geometry and knows of no fence: what it leaves between robot and wall is its tracking error. The MuJoCo robot
(`tools/mujoco_plant.py`) is driven under the guard, by hand and by DISCO on a circle, by a pipeline that believes
a geometry up to 15 % off; its contacts and servos are nobody's model.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

from disco_hw.config import Estimation
from disco_hw.control import Disco, DiscoSettings
from disco_hw.control.surroundings import Surroundings
from disco_hw.estimation import PoseFusion
from disco_hw.estimation.odometry import OdometryParameters
from disco_hw.experiments.fence import ALONE, ALONE_STREAM, Campaign, FenceOptions, alone_drive
from disco_hw.experiments.fence_drives import FencedDrive, random_room, random_task_room
from disco_hw.fence import Fence, Footprint
from disco_hw.fence.clearance import Boundaries
from disco_hw.runtime.fence_guard import FenceGuard, FenceVerdict, StoppingSettings
from disco_hw.runtime.pipeline import (
    FollowTask,
    Governor,
    Manual,
    Motion,
    NoPlanner,
    Pipeline,
    Planner,
    WheelLimits,
)
from disco_hw.runtime.robot_setup import Setup
from drivers.types import Readings
from sim.plant_parameters import PlantParameters
from tools.foreign_plant import ForeignPlant, ForeignRobot
from tools.mujoco_plant import mujoco_plant, mujoco_robots
from tools.nmpc import NonlinearMpc
from tools.tracking import LIMITS, circle_track, model

MUJOCO, MUJOCO_TASK = "MuJoCo, by hand, wild", "MuJoCo, task in a random room"
_FOOTPRINT = Footprint(0.72, 0.60, 0.2)
"""Of the MuJoCo robot: its wheels' outer edges, around the middle, which lies 0.2 m ahead of the tracked point."""
# A time longer than the servos' lag, as a model learnt from the robot would say.
_STOPS = StoppingSettings(
    response_s=0.15, reaction_s=0.02, deceleration_rad_s2=LIMITS.acceleration_rad_s2, period_s=0.02
)
_TICK_MS = 20
_SETTLED_MS = 1000


def nmpc_for(setup: Setup) -> Planner:
    """The NMPC of the tracking bench on the setup's circle, under the nominal geometry of its robot.toml."""
    robot, task = setup.config.robot, setup.config.task
    geometry = (robot.wheel_radius_m, robot.axial_distance_m, robot.x_icr_m)
    lag_s = PlantParameters().speed_loop_time_constant_s
    known = ForeignRobot(*geometry, lag_s=lag_s, dead_rad_s=0.0, believed=geometry)
    radius_m = float(np.hypot(*task.course().start[:2]))
    return NonlinearMpc(known, circle_track(radius_m, task.speed_m_s), task.speed_m_s, geometry)


def mujoco_hand_drive(rng: np.random.Generator, seconds: float) -> FencedDrive:
    """Wild wheel speeds in a random room, each held for half a second or so, from the middle of the room."""
    robot = mujoco_robots(int(rng.integers(1 << 20)), 1)[0]
    fence = random_room(rng, 0)
    plant = mujoco_plant(robot, (-0.2, 0.0, 0.0), int(rng.integers(1 << 30)))
    motion, next_s = Manual(0.0, 0.0), 0.0

    def hand(t_s: float) -> Motion:
        nonlocal motion, next_s
        if t_s >= next_s:
            motion = Manual(*rng.uniform(-LIMITS.speed_rad_s, LIMITS.speed_rad_s, 2).tolist())
            next_s = t_s + float(rng.uniform(0.2, 1.5))
        return motion

    return _mujoco_drive(robot, plant, fence, NoPlanner(), hand, seconds)


def mujoco_task_drive(rng: np.random.Generator, seconds: float) -> FencedDrive:
    """A circle in a random room, planned under the prior around what the pipeline believes."""
    robot = mujoco_robots(int(rng.integers(1 << 20)), 1)[0]
    fence, task = random_task_room(rng, _FOOTPRINT)
    settings = DiscoSettings()
    around = Surroundings(_FOOTPRINT, settings.step_s, settings.sampler.horizon, task.speed_m_s)
    around.set_line(task.course().outline_m())
    planner = Disco(model(robot), task.planned("default"), settings, LIMITS, 1, around)
    plant = mujoco_plant(robot, task.course().start, int(rng.integers(1 << 30)))
    return _mujoco_drive(robot, plant, fence, planner, lambda t_s: FollowTask(), seconds)


def _mujoco_drive(
    robot: ForeignRobot, plant: ForeignPlant, fence: Fence, planner: Planner, motion_at: Callable[[float], Motion],
    seconds: float,
) -> FencedDrive:  # fmt: skip
    """Let the robot stand for a second, then move it as `motion_at` says for each time (s), under the guard."""
    bounds = Boundaries(_FOOTPRINT, fence)
    governor = Governor(WheelLimits(LIMITS.speed_rad_s, *[LIMITS.acceleration_rad_s2] * 2), 1e-3 * _TICK_MS)
    guard = FenceGuard(bounds, _STOPS, fence.margin_m)
    pipeline = Pipeline(_fusion(robot), planner, governor, 0.2, guard=guard)
    poses, left, stops = [], list[float](), 0
    waiting, before = False, FenceVerdict.IDLE
    command = (0.0, 0.0)
    while plant.now_ms < 1e3 * seconds + _SETTLED_MS:
        readings = plant.readings()
        motion = motion_at(1e-3 * (plant.now_ms - _SETTLED_MS)) if plant.now_ms >= _SETTLED_MS else Manual(0.0, 0.0)
        tick = pipeline.step(plant.now_ns, Readings(wheels=readings.wheels, poses=readings.poses), motion)
        command = (tick.command.left_rad_s, tick.command.right_rad_s)
        verdict = tick.fence.verdict
        poses.append(plant.pose)
        if verdict is FenceVerdict.STOPPED and before is not FenceVerdict.STOPPED:
            stops, waiting = stops + 1, True
        before = verdict
        if waiting and abs(plant.forward_m_s) < 1e-3 and command == (0.0, 0.0):
            left.append(float(bounds.clearance_m(np.array(poses[-1:]))[0]))
            waiting = False
        plant.advance(*command, _TICK_MS)
    places = np.array(poses)
    way_m = float(np.hypot(*np.diff(places[:, :2], axis=0).T).sum())
    return FencedDrive(fence, places, float(bounds.clearance_m(places).min()), tuple(left), stops, way_m)


def _fusion(robot: ForeignRobot) -> PoseFusion:
    """The estimator with the believed geometry, each length known to 5 %."""
    believed = np.array(robot.believed)
    covariance = tuple(map(tuple, np.diag((0.05 * believed) ** 2).tolist()))
    parameters = OdometryParameters(*robot.believed, covariance)  # type: ignore[arg-type]
    return PoseFusion(Estimation(), parameters, 0.2)


def main() -> int:
    """Drive what is missing, and print the folder's table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--out", type=Path, default=Path("out/fence"))
    parser.add_argument("--alone", type=int, default=40, metavar="N", help="tight rooms for the NMPC")
    parser.add_argument("--mujoco", type=int, default=40, metavar="N", help="drives of the MuJoCo robot")
    parser.add_argument("--tasks", type=int, default=40, metavar="N", help="tasks of the MuJoCo robot")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    options = FenceOptions(seed=given.seed)
    campaign = Campaign(given.out, options, lambda message: print(message, file=sys.stderr, flush=True))
    campaign.gather(MUJOCO, given.mujoco, lambda rng: mujoco_hand_drive(rng, options.seconds), 4)
    campaign.gather(MUJOCO_TASK, given.tasks, lambda rng: mujoco_task_drive(rng, options.seconds), 5)
    campaign.gather(
        f"{ALONE}NMPC", given.alone,
        lambda rng: alone_drive(rng, options.off, options.seconds, ("point", "off", True), nmpc_for), ALONE_STREAM,
    )  # fmt: skip
    print(campaign.result.table())
    return 0


if __name__ == "__main__":
    sys.exit(main())
