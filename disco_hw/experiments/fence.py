"""The fence, tried: random rooms with tasks and wild manual drives, on robots whose parameters nobody told.

The daemon's own tick in simulated time (`SimulatedRun`). Each virtual robot's geometry is up to 15 % off what the
model says, its motors are slower or quicker, and its ground slips more.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

import disco_hw
from disco_hw.config.robot_file import prior_around
from disco_hw.experiments.simulated_time import SimulatedRun, virtual_robot
from disco_hw.fence import Circle, Fence, Footprint
from disco_hw.fence.clearance import Boundaries, MovingCircle
from disco_hw.fence.outlines import fence_outlines
from disco_hw.fence.task_line import task_breach
from disco_hw.model import Model
from disco_hw.reports import write_pictures
from disco_hw.runtime.assembly import make_planner
from disco_hw.runtime.core import CoreTick, PilotTick
from disco_hw.runtime.fence_guard import FenceVerdict
from disco_hw.runtime.obstacles import ObstacleReport
from disco_hw.runtime.pipeline import Manual, NoPlanner, Planner
from disco_hw.runtime.robot_setup import Setup, load_setup
from disco_hw.runtime.safe_area import SafeArea
from disco_hw.runtime.supervisor import UserRequest
from disco_hw.tasks import RobotTask
from disco_hw.tasks.circle import CircleTask
from sim.body_dynamics import BodyPose
from sim.plant_parameters import PlantParameters

Array = NDArray[np.float64]
Progress = Callable[[str], None]
FOOTPRINT = Footprint(0.50, 0.40, 0.05)
_SHIPPED = Path(disco_hw.__file__).parent / "robots" / "wombot.toml"
_ALONG_M = 0.15
_WALL_M_S = 0.3


@dataclass(frozen=True, slots=True)
class FenceOptions:
    """How many of each, how far the true parameters are off, and how long a drive is (s)."""

    rooms: int = 200
    manual: int = 200
    off: float = 0.15
    seconds: float = 12.0
    seed: int = 1


@dataclass(frozen=True, eq=False, slots=True)
class FencedDrive:
    """One drive: its fence, the true poses (N, 3), the least true clearance (m), and the guard's stops.

    `left_m`: the true clearance at rest after each of the guard's stops; `stops`: how often it stopped.
    """

    fence: Fence
    poses: Array
    least_m: float
    left_m: tuple[float, ...]
    stops: int


class _Hand:
    """A pilot by hand whose wheel speeds somebody else sets."""

    def __init__(self) -> None:
        self.wheels = (0.0, 0.0)

    @property
    def needs_pose(self) -> bool:
        """By hand no pose is needed; the fence asks for one."""
        return False

    @property
    def done(self) -> bool:
        """It drives until it is left off."""
        return False

    def step(self, now_ns: int, last: CoreTick | None) -> PilotTick:
        """Drive at the wheel speeds that are set."""
        return PilotTick(motion=Manual(*self.wheels), by_hand=True)

    def learn(self, now_ns: int, tick: CoreTick, replies: Any) -> None:
        """Nothing is learnt."""

    def steer(self, now_ns: int, page: int, wanted: Any) -> str | None:
        """No page drives."""
        return "driven by an experiment"

    def status(self) -> dict[str, Any]:
        """Nothing is added."""
        return {}


class _Overridden(SafeArea):
    """Fence and obstacles of a robot whose planner knows them and whose guard is overridden throughout."""

    def begin(self, now_ns: int, by_hand: bool) -> bool:
        """As of the base class, and overridden."""
        super().begin(now_ns, by_hand)
        return True


def fenced_setup(fence: Fence, task: RobotTask | None = None, base: Setup | None = None) -> Setup:
    """The shipped robot, or `base`, with this fence and task and a footprint."""
    setup = base or load_setup(_SHIPPED)
    robot = msgspec.structs.replace(setup.config.robot, footprint_m=FOOTPRINT)
    changes = {"fence": fence, "robot": robot} | ({} if task is None else {"task": task})
    return replace(setup, config=msgspec.structs.replace(setup.config, **changes))


def untold_plant(rng: np.random.Generator, off: float) -> PlantParameters:
    """A plant whose geometry is up to `off` away from the model's mean, with other motors and another ground."""
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
    """A room of four to eight corners about the origin, with pillars that leave the middle free."""
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
    """A room, and a circle in it at which the nominal footprint stays inside."""
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
    run: SimulatedRun, boundaries: Boundaries, fence: Fence, ticks: Any, hand: Callable[[float, CoreTick], None]
) -> FencedDrive:  # fmt: skip
    """Follow a run: true poses and clearances, and the guard's stops with what was left when the robot stood."""
    poses: list[tuple[float, float, float]] = []
    left: list[float] = []
    stops, waiting, before = 0, False, FenceVerdict.IDLE
    begun_us = run.now_us
    for tick in ticks:
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
    return FencedDrive(fence, places, float(boundaries.clearance_m(places).min()), tuple(left), stops)


def manual_drive(setup: Setup, plant: PlantParameters, rng: np.random.Generator, seconds: float) -> FencedDrive:
    """Wild commands, another one every half second or so, from the middle of the room."""
    hand = _Hand()
    start = BodyPose(0.0, 0.0, float(rng.uniform(-np.pi, np.pi)))
    run = SimulatedRun(setup, virtual_robot(setup, plant, start, seed=int(rng.integers(1 << 30))), NoPlanner(), hand)
    _begin(run)
    top = setup.config.robot.max_wheel_speed_rad_s
    next_s = 0.0

    def steer(t_s: float, tick: CoreTick) -> None:
        nonlocal next_s
        if t_s >= next_s:
            hand.wheels = tuple(rng.uniform(-top, top, 2).tolist())
            next_s = t_s + float(rng.uniform(0.2, 1.5))

    return _drive(run, Boundaries(FOOTPRINT, setup.config.fence), setup.config.fence, run.ticks(seconds), steer)


def wall_drive(setup: Setup, plant: PlantParameters, rng: np.random.Generator) -> FencedDrive:
    """Straight on at 0.3 m/s from the middle of the room until the guard stops it."""
    hand = _Hand()
    start = BodyPose(0.0, 0.0, float(rng.uniform(-np.pi, np.pi)))
    run = SimulatedRun(setup, virtual_robot(setup, plant, start, seed=int(rng.integers(1 << 30))), NoPlanner(), hand)
    _begin(run)
    speed = _WALL_M_S / plant.wheel_radius_m
    hand.wheels = (speed, speed)
    return _drive(
        run, Boundaries(FOOTPRINT, setup.config.fence), setup.config.fence, run.ticks(14.0), lambda t_s, tick: None
    )


def task_drive(
    setup: Setup,
    plant: PlantParameters,
    planner: Planner,
    seconds: float,
    seed: int,
    guarded: bool = True,
    pillar: ObstacleReport | None = None,
) -> FencedDrive:
    """The task, from its start; without `guarded` the guard is off, and the planner alone keeps to the fence."""
    start = BodyPose(*setup.config.task.course().start)
    run = SimulatedRun(setup, virtual_robot(setup, plant, start, seed=seed), planner)
    area, fence = run.core.area, setup.config.fence
    assert area is not None
    if not guarded:
        area = run.core.area = _Overridden(area.guard, fence, FOOTPRINT)
    if pillar is not None:
        area.report(0, pillar)
        fence = msgspec.structs.replace(
            fence, keep_out=(*fence.keep_out, Circle((pillar.x_m, pillar.y_m), pillar.radius_m))
        )
    _begin(run)
    return _drive(run, Boundaries(FOOTPRINT, fence), fence, run.ticks(seconds), lambda t_s, tick: None)


def _pillar_on(task: CircleTask, fence: Fence, rng: np.random.Generator) -> ObstacleReport | None:
    """A pillar on the circle's line, ahead of the start, that leaves room on one side; None if there is none."""
    for _ in range(20):
        angle, radius_m = float(rng.uniform(1.2, 5.0)), float(rng.uniform(0.05, 0.15))
        x_m = task.center_x_m + task.radius_m * math.cos(angle)
        y_m = task.center_y_m + task.radius_m * math.sin(angle)
        around = Boundaries(FOOTPRINT, fence, [MovingCircle(x_m, y_m, radius_m)])
        beside = radius_m + 0.5 * FOOTPRINT.width + 0.2
        poses = [
            (x_m + side * beside * math.cos(angle), y_m + side * beside * math.sin(angle), angle + 0.5 * math.pi)
            for side in (-1.0, 1.0)
        ]
        if around.clearance_m(np.array(poses)).max() > 0.1:
            return ObstacleReport(name="pillar", x_m=x_m, y_m=y_m, radius_m=radius_m, age_limit_s=1000.0)
    return None


CONTENDERS = {
    "point model": ("point", "off", False),
    "sigma points, prior": ("ut", "off", True),
    "sigma points, model file": ("ut", "off", False),
    "sigma points, adapted": ("ut", "fast", True),
}
"""Planners without the guard: uncertainty, adaptation, and whether the model is the prior around robot.toml's robot."""


def unguarded_drive(name: str, rng: np.random.Generator, off: float, seconds: float) -> FencedDrive:
    """A circle with a pillar on it, by one of the CONTENDERS alone; the same rooms and robots for all."""
    while True:
        fence, task = random_task_room(rng)
        pillar = _pillar_on(task, fence, rng)
        if pillar is not None:
            break
    uncertainty, adaptation, by_prior = CONTENDERS[name]
    setup = fenced_setup(fence, task)
    control = msgspec.structs.replace(setup.config.control, uncertainty=uncertainty, adaptation=adaptation)
    setup = replace(setup, config=msgspec.structs.replace(setup.config, control=control))
    if by_prior:
        robot = msgspec.structs.replace(setup.config.robot, axial_distance_m=0.415, x_icr_m=0.238, wheel_radius_m=0.061)
        config = msgspec.structs.replace(setup.config, robot=robot, prior=prior_around(robot))
        setup = replace(setup, config=config, model=Model.nominal(robot, config.prior))
    planner = make_planner(setup.config, setup.model)
    plant = untold_plant(rng, off)
    return task_drive(setup, plant, planner, seconds, int(rng.integers(1 << 30)), guarded=False, pillar=pillar)


def _begin(run: SimulatedRun) -> None:
    run.run(1.5)
    run.run(0.5, UserRequest.ARM)
    run.run(0.02, UserRequest.START)


def along_drive(rng: np.random.Generator, off: float, seconds: float) -> FencedDrive:
    """A circle at 0.3 m/s whose fence is 0.15 m outside of the footprint's way."""
    radius_m = float(rng.uniform(0.6, 1.2))
    outer = max(math.hypot(radius_m + y, x) for x, y in FOOTPRINT.corners_m())
    inner = radius_m - 0.5 * FOOTPRINT.width
    task = CircleTask(center_x_m=0.0, center_y_m=0.0, radius_m=radius_m, speed_m_s=_WALL_M_S)
    fence = Fence(keep_in=Circle((0.0, 0.0), outer + _ALONG_M), keep_out=(Circle((0.0, 0.0), inner - _ALONG_M),))
    setup = fenced_setup(fence, task)
    planner = make_planner(setup.config, setup.model)
    return task_drive(setup, untold_plant(rng, off), planner, seconds, int(rng.integers(1 << 30)))


@dataclass(frozen=True, eq=False, slots=True)
class FenceResult:
    """What was driven: with the guard, and by the planner alone under each kind of belief."""

    options: FenceOptions
    drives: dict[str, list[FencedDrive]]

    def rows(self) -> list[dict[str, Any]]:
        """For each kind of drive: how many, breaches, least clearance, stops, and the distance left at a stop (m)."""
        found = []
        for name, drives in self.drives.items():
            left = [value for one in drives for value in one.left_m]
            found.append(
                {
                    "drives": name,
                    "count": len(drives),
                    "breaches": sum(one.least_m < 0.0 for one in drives),
                    "least_clearance_m": min(one.least_m for one in drives),
                    "stops": sum(one.stops for one in drives),
                    "left_at_stop_median_m": float(np.median(left)) if left else math.nan,
                }
            )
        return found

    def as_dict(self) -> dict[str, Any]:
        """The result for machines."""
        rows = [
            {name: None if isinstance(value, float) and math.isnan(value) else value for name, value in row.items()}
            for row in self.rows()
        ]
        return {"options": asdict(self.options), "drives": rows}

    def table(self) -> str:
        """The result for a person."""
        lines = [f"{'':<34}{'drives':>8}{'breaches':>10}{'least, m':>10}{'stops':>8}{'left, m':>9}"]
        for row in self.rows():
            left = row["left_at_stop_median_m"]
            lines.append(
                f"{row['drives']:<34}{row['count']:>8}{row['breaches']:>10}{row['least_clearance_m']:>10.3f}"
                f"{row['stops']:>8}{'-' if math.isnan(left) else format(left, '.3f'):>9}"
            )
        return "\n".join(lines)

    def write_pictures(self, path: Path) -> None:
        """Write rooms with the robots' ways, and how near they came; PNG, PDF and SVG."""
        from matplotlib.figure import Figure  # noqa: PLC0415

        figure = Figure(figsize=(9.0, 4.2), layout="constrained")
        room, nearest = figure.subplots(1, 2)
        name, drives = max(self.drives.items(), key=lambda item: len(item[1]))
        shown = drives[0]
        for line in fence_outlines(shown.fence):
            room.plot(*line.T, color="firebrick")
        room.plot(*shown.poses[:, :2].T, color="navy", linewidth=0.8)
        room.set(aspect="equal", xlabel="x (m)", ylabel="y (m)", title=f"one of {len(drives)}: {name}")
        for name, drives in self.drives.items():
            least = np.sort([one.least_m for one in drives])
            nearest.step(least, np.linspace(0.0, 1.0, len(least)), label=name, where="post")
        nearest.axvline(0.0, color="firebrick", linewidth=0.8)
        nearest.set(xlabel="least distance to the fence (m)", ylabel="share of drives")
        nearest.legend(fontsize=7)
        write_pictures(figure, path)


def run_fence(options: FenceOptions, progress: Progress) -> FenceResult:
    """Drive all of it; takes minutes."""
    drives: dict[str, list[FencedDrive]] = {}

    def gather(name: str, count: int, one: Callable[[np.random.Generator], FencedDrive]) -> None:
        found = []
        for number in range(count):
            found.append(one(np.random.default_rng([options.seed, len(drives), number])))
            if (number + 1) % 20 == 0 or number + 1 == count:
                progress(f"{name}: {number + 1} of {count}, {sum(each.least_m < 0.0 for each in found)} breaches")
        drives[name] = found

    def wild(rng: np.random.Generator) -> FencedDrive:
        setup = fenced_setup(random_room(rng, int(rng.integers(0, 4))))
        return manual_drive(setup, untold_plant(rng, options.off), rng, options.seconds)

    def wall(rng: np.random.Generator) -> FencedDrive:
        return wall_drive(fenced_setup(random_room(rng, 0)), untold_plant(rng, options.off), rng)

    def task(rng: np.random.Generator) -> FencedDrive:
        fence, circle = random_task_room(rng)
        setup = fenced_setup(fence, circle)
        planner = make_planner(setup.config, setup.model)
        return task_drive(setup, untold_plant(rng, options.off), planner, options.seconds, int(rng.integers(1 << 30)))

    gather("by hand, wild", options.manual, wild)
    gather("by hand, at a wall at 0.3 m/s", max(1, options.manual // 4), wall)
    gather(
        "circle 0.15 m inside, 0.3 m/s",
        max(1, options.rooms // 10),
        lambda rng: along_drive(rng, options.off, options.seconds),
    )
    gather("task in a random room", options.rooms, task)
    for number, name in enumerate(CONTENDERS):
        alone = [
            unguarded_drive(name, np.random.default_rng([options.seed, 99, k]), options.off, 2.0 * options.seconds)
            for k in range(max(1, options.rooms // 4))
        ]
        drives[f"guard off: {name}"] = alone
        progress(f"guard off, {number + 1} of {len(CONTENDERS)}: {sum(one.least_m < 0.0 for one in alone)} breaches")
    return FenceResult(options, drives)
