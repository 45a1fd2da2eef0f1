"""Drives near a fence in simulated time: wild ones by hand, into a wall, and a task in a room, on untold robots.

The daemon's own tick (`SimulatedRun`). Each virtual robot's geometry is up to 15 % off what the model says, its motors
are slower or quicker, and its ground slips more.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from disco_hw.config import SHIPPED_ROBOT
from disco_hw.control import CommandLimits
from disco_hw.control.baselines import LAWS, Follower, Reference
from disco_hw.control.kernel.guide import SteeredChassis
from disco_hw.experiments.simulated_time import SimulatedRun, virtual_robot
from disco_hw.fence import Circle, Fence, Footprint
from disco_hw.fence.clearance import Boundaries, task_breach
from disco_hw.runtime.assembly import create_planner
from disco_hw.runtime.core import CoreTick, PilotTick
from disco_hw.runtime.fence_guard import FenceVerdict
from disco_hw.runtime.pipeline import Manual, NoPlanner, Planner
from disco_hw.runtime.robot_setup import Setup, load_setup
from disco_hw.runtime.safe_area import SafeArea
from disco_hw.tasks import RobotTask, task_from
from disco_hw.tasks.circle import CircleTask
from sim.body_dynamics import BodyPose
from sim.plant_parameters import PlantParameters

Array = NDArray[np.float64]
FOOTPRINT = Footprint(0.50, 0.40, 0.05)
# Chosen: room, speed and distance of the trials; less room, or more speed, makes them harder.
_ALONG_M = 0.15
_WALL_M_S = 0.3
_SPARE_M = (0.05, 0.15)
_RUN_UP_M, _BEYOND_M = (1.5, 2.5), 3.0
# Chosen: fast, and soft on the wheels, so that the stop takes its way.
_CORRIDOR_M_S, _SOFT_RAD_S2 = 0.4, 2.0


@dataclass(frozen=True, eq=False, slots=True)
class FencedDrive:
    """Record of one drive: its fence, the true poses (N, 3), the least true clearance (m), and the guard's stops.

    `left_m`: the true clearance at rest after each of the guard's stops; `stops`: how often it stopped. `way_m`: how
    far the tracked point went.
    """

    fence: Fence
    poses: Array
    least_m: float
    left_m: tuple[float, ...]
    stops: int
    way_m: float


class _Hand:
    """A pilot by hand whose wheel speeds somebody else sets."""

    needs_pose, done = False, False

    def __init__(self) -> None:
        self.wheels = (0.0, 0.0)

    def step(self, now_ns: int, last: CoreTick | None) -> PilotTick:
        """Drive at the wheel speeds that are set."""
        return PilotTick(motion=Manual(*self.wheels), by_hand=True)

    def learn(self, now_ns: int, tick: CoreTick, replies: Any) -> None:
        """Ignore the tick, because wheel speeds are set from outside."""

    def steer(self, now_ns: int, page: int, steering: Any) -> str | None:
        """Refuse a page's steering, because an experiment drives."""
        return "driven by an experiment"

    def status(self) -> dict[str, Any]:
        """Return an empty dict: the status gets no more entries."""
        return {}


class _Overridden(SafeArea):
    """Fence and obstacles of a robot whose planner knows them and whose guard is overridden throughout."""

    def begin(self, now_ns: int, by_hand: bool) -> bool:
        """Begin a tick as the base class does, and return that the guard is overridden."""
        super().begin(now_ns, by_hand)
        return True


def fenced_setup(fence: Fence, task: RobotTask | None = None, base: Setup | None = None) -> Setup:
    """Return the shipped robot, or `base`, with this fence and task and a footprint."""
    setup = base or load_setup(SHIPPED_ROBOT)
    robot = msgspec.structs.replace(setup.config.robot, footprint_m=FOOTPRINT)
    changes = {"fence": fence, "robot": robot} | ({} if task is None else {"task": task})
    return replace(setup, config=msgspec.structs.replace(setup.config, **changes))


def untold_plant(rng: np.random.Generator, off: float) -> PlantParameters:
    """Return a plant whose geometry is up to `off` away from the model's mean, with other motors and another ground."""
    usual = PlantParameters()
    geometry = {
        name: getattr(usual, name) * (1.0 + off * rng.uniform(-1.0, 1.0))
        for name in ("wheel_radius_m", "axial_distance_m", "x_icr_m")
    }
    return replace(
        usual,
        **geometry,
        speed_loop_time_constant_s=rng.uniform(0.03, 0.09),
        slip_std_x_m_s=0.01 * rng.uniform(),
        slip_std_y_m_s=0.008 * rng.uniform(),
        slip_std_yaw_rad_s=0.036 * rng.uniform(),
    )


def random_room(rng: np.random.Generator, pillars: int) -> Fence:
    """Return a room of four to eight corners about the origin, with pillars that leave the middle free."""
    count = int(rng.integers(4, 9))
    angles = np.sort(rng.uniform(0.0, 2.0 * np.pi, count) * 0.2 + 2.0 * np.pi * np.arange(count) / count)
    reach = rng.uniform(1.5, 2.4, count)
    corners = tuple((float(r * math.cos(a)), float(r * math.sin(a))) for r, a in zip(reach, angles, strict=True))
    posts = []
    for _ in range(pillars):
        off, angle = rng.uniform(0.7, 1.6), rng.uniform(0.0, 2.0 * np.pi)
        posts.append(Circle((off * math.cos(angle), off * math.sin(angle)), float(rng.uniform(0.05, 0.2))))
    return Fence(keep_in=corners, keep_out=tuple(posts))


def random_task_room(rng: np.random.Generator) -> tuple[Fence, CircleTask]:
    """Return a room, and a circle in it at which the footprint stays inside."""
    while True:
        radius_m = float(rng.uniform(0.4, 1.0))
        center = rng.uniform(-0.4, 0.4, 2)
        task = CircleTask(
            center_x_m=float(center[0]), center_y_m=float(center[1]), radius_m=radius_m,
            speed_m_s=float(rng.uniform(0.15, 0.3)),
        )  # fmt: skip
        fence = random_room(rng, int(rng.integers(0, 3)))
        if task_breach(fence, FOOTPRINT, task.course()) is None:
            return fence, task


def _drive(
    run: SimulatedRun, seconds: float, fence: Fence, hand: Callable[[float, CoreTick], None] = lambda t_s, tick: None,
    learning_s: float = 0.0,
) -> FencedDrive:  # fmt: skip
    """Follow a run and record true poses and clearances, and the guard's stops with what was left when the robot stood.

    What happens in the first `learning_s` does not count.
    """
    boundaries = Boundaries(FOOTPRINT, fence)
    poses: list[tuple[float, float, float]] = []
    left: list[float] = []
    stops, waiting, before = 0, False, FenceVerdict.IDLE
    begun_us = run.now_us
    for tick in run.ticks(seconds):
        truth = run.robot.truth
        poses.append((truth.x_m, truth.y_m, truth.yaw_rad))
        verdict = tick.pipeline.fence.verdict
        if verdict is FenceVerdict.STOPPED and before is not FenceVerdict.STOPPED:
            stops += 1
            waiting = True
        before = verdict
        if waiting and abs(truth.speed_m_s) < 1e-3 and tick.pipeline.command.left_rad_s == 0.0:
            left.append(float(boundaries.clearance_m(np.array(poses[-1:]))[0]))
            waiting = False
        hand((run.now_us - begun_us) * 1e-6, tick)
    places = np.array(poses)
    places = places[min(round(learning_s / seconds * len(places)), len(places) - 1) :]
    way_m = float(np.hypot(*np.diff(places[:, :2], axis=0).T).sum())
    return FencedDrive(fence, places, float(boundaries.clearance_m(places).min()), tuple(left), stops, way_m)


def _by_hand(setup: Setup, plant: PlantParameters, rng: np.random.Generator) -> tuple[SimulatedRun, _Hand]:
    """Return a robot in the middle of the room, started, and the hand that drives it."""
    hand = _Hand()
    start = BodyPose(0.0, 0.0, float(rng.uniform(-np.pi, np.pi)))
    run = SimulatedRun(setup, virtual_robot(setup, plant, start, seed=int(rng.integers(1 << 30))), NoPlanner(), hand)
    run.start()
    return run, hand


def manual_drive(setup: Setup, plant: PlantParameters, rng: np.random.Generator, seconds: float) -> FencedDrive:
    """Wild commands, another one every half second or so, from the middle of the room."""
    run, hand = _by_hand(setup, plant, rng)
    top = setup.config.robot.max_wheel_speed_rad_s
    next_s = 0.0

    def steer(t_s: float, tick: CoreTick) -> None:
        nonlocal next_s
        if t_s >= next_s:
            hand.wheels = tuple(rng.uniform(-top, top, 2).tolist())
            next_s = t_s + float(rng.uniform(0.2, 1.5))

    return _drive(run, seconds, setup.config.fence, steer)


def wall_drive(setup: Setup, plant: PlantParameters, rng: np.random.Generator) -> FencedDrive:
    """Straight on at 0.3 m/s from the middle of the room until the guard stops it."""
    run, hand = _by_hand(setup, plant, rng)
    speed = _WALL_M_S / plant.wheel_radius_m
    hand.wheels = (speed, speed)
    return _drive(run, 14.0, setup.config.fence)


def task_drive(
    setup: Setup,
    plant: PlantParameters,
    planner: Planner,
    seconds: float,
    seed: int,
    guarded: bool = True,
    learning_s: float = 0.0,
    facing_rad: float = 0.0,
) -> FencedDrive:
    """Drive the task from its start, facing so far to the left of its line there.

    Without `guarded` the guard is off, and the planner alone keeps to the fence.
    """
    x_m, y_m, yaw_rad = setup.config.task_start
    start = BodyPose(x_m, y_m, yaw_rad + facing_rad)
    run = SimulatedRun(setup, virtual_robot(setup, plant, start, seed=seed), planner)
    fence = setup.config.fence
    if not guarded:
        run.core.area = _Overridden(run.core.area.guard, fence, FOOTPRINT)
    run.start()
    return _drive(run, seconds, fence, learning_s=learning_s)


def tight_room(rng: np.random.Generator, clearance_m: float) -> tuple[Fence, CircleTask]:
    """Return a circle at 0.3 m/s in a square room whose walls come so near to the footprint's way."""
    radius_m, turned = float(rng.uniform(0.6, 1.0)), float(rng.uniform(0.0, 2.0 * np.pi))
    outer_m = max(math.hypot(radius_m + y, x) for x, y in FOOTPRINT.corners_m())
    reach_m = math.sqrt(2.0) * (outer_m + clearance_m)
    corners = [
        (reach_m * math.cos(turned + k * 0.5 * np.pi), reach_m * math.sin(turned + k * 0.5 * np.pi)) for k in range(4)
    ]
    task = CircleTask(center_x_m=0.0, center_y_m=0.0, radius_m=radius_m, speed_m_s=_WALL_M_S)
    return Fence(keep_in=tuple(corners), margin_m=0.01), task


def tight_setup(rng: np.random.Generator) -> Setup:
    """Return the shipped robot on a circle in a tight room, whose walls come within 0.05 to 0.15 m of its way."""
    return fenced_setup(*tight_room(rng, float(rng.uniform(*_SPARE_M))))


def corridor_setup(rng: np.random.Generator) -> Setup:
    """Return a robot with soft brakes whose line leads on through the closed end of a corridor.

    At 0.4 m/s it needs 0.67 m to stop, and 15 % more or less with wheels that are larger or smaller by so much.
    """
    end_m = float(rng.uniform(*_RUN_UP_M)) + FOOTPRINT.ahead + 0.5 * FOOTPRINT.length
    behind_m, side_m = -2.0 * FOOTPRINT.reach_m, 0.5
    corners = ((behind_m, -side_m), (end_m, -side_m), (end_m, side_m), (behind_m, side_m))
    line = ((0.0, 0.0), (end_m + _BEYOND_M, 0.0))
    task = _task(path="corridor", speed_m_s=_CORRIDOR_M_S)
    # Its way-points stand in no file.
    setup = fenced_setup(Fence(keep_in=corners, margin_m=0.01), msgspec.structs.replace(task, points=line))
    robot = msgspec.structs.replace(setup.config.robot, max_wheel_acceleration_rad_s2=_SOFT_RAD_S2)
    return replace(setup, config=msgspec.structs.replace(setup.config, robot=robot))


def _task(**section: Any) -> Any:
    """Return the task that these fields in [task] of robot.toml would choose."""
    return task_from(section)


def along_drive(rng: np.random.Generator, off: float, seconds: float) -> FencedDrive:
    """Drive a circle at 0.3 m/s between two fences 0.15 m beside the footprint's way, by a law that sees neither.

    The robot slides, so that it faces inwards on a circle: the fences are laid beside that footprint, and it begins so.
    """
    radius_m = float(rng.uniform(0.6, 1.2))
    task = CircleTask(center_x_m=0.0, center_y_m=0.0, radius_m=radius_m, speed_m_s=_WALL_M_S)
    plant, shipped = untold_plant(rng, off), load_setup(SHIPPED_ROBOT)
    model = shipped.model
    facing = math.asin(model.x_icr_m / radius_m)
    turned = [(x * math.cos(facing) - y * math.sin(facing), x * math.sin(facing) + y * math.cos(facing)) for x, y in
              FOOTPRINT.corners_m()]  # fmt: skip
    # On a circle driven counterclockwise, ahead is along the tangent and left is towards the centre.
    outer_m = max(math.hypot(radius_m - y, x) for x, y in turned)
    inner_m = min(_distance_m((0.0, radius_m), turned[k - 1], turned[k]) for k in range(4))
    around, within = Circle((0.0, 0.0), outer_m + _ALONG_M), Circle((0.0, 0.0), inner_m - _ALONG_M)
    setup = fenced_setup(Fence(keep_in=around, keep_out=(within,)), task, shipped)
    geometry = (model.wheel_radius_m, model.axial_distance_m, model.x_icr_m)
    limits = CommandLimits.of_robot(setup.config.robot)
    chassis = SteeredChassis(*geometry, plant.speed_loop_time_constant_s, 0.0)
    law = Follower(Reference(task.course().outline_m(), _WALL_M_S, model.x_icr_m), LAWS["kanayama"](), chassis, limits)
    return task_drive(setup, plant, law, seconds, int(rng.integers(1 << 30)), facing_rad=facing)


def _distance_m(point: tuple[float, float], begin: tuple[float, float], end: tuple[float, float]) -> float:
    """Return the distance of a point from a segment, in metres."""
    along = np.subtract(end, begin)
    part = float(np.clip(np.dot(np.subtract(point, begin), along) / np.dot(along, along), 0.0, 1.0))
    return float(np.hypot(*(np.add(begin, part * along) - point)))


def room_drive(rng: np.random.Generator, off: float, seconds: float) -> FencedDrive:
    """Drive a circle in a random room, with the guard."""
    setup = fenced_setup(*random_task_room(rng))
    planner = create_planner(setup.config, setup.model)
    return task_drive(setup, untold_plant(rng, off), planner, seconds, int(rng.integers(1 << 30)))
