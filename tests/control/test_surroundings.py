"""The planner keeps the footprint away from fence and obstacles, and drives around what stands on its line."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

import disco_hw
from disco_hw.control import DiscoSettings, NoValidControl, PlannerState, PlanOutcome
from disco_hw.control.detours import SPARE_M, Detours
from disco_hw.control.kernel.avoid import (
    COLUMNS,
    DETOUR_COLUMNS,
    DETOURS,
    KEEP,
    MOST_SHAPES,
    TOUCH_COST,
    TOUCH_COST_PER_M,
)
from disco_hw.control.surroundings import Surroundings
from disco_hw.fence import Circle, Fence, Footprint
from disco_hw.fence.clearance import Boundaries, MovingCircle
from disco_hw.runtime.assembly import create_planner, create_surroundings
from disco_hw.runtime.robot_setup import load_setup
from disco_hw.tasks.path import PathTask
from tests.control.kernel.test_avoid import touched
from tests.control.kernel.test_step import allocations

FOOTPRINT = Footprint(0.5, 0.4, 0.05)
ROBOT_FILE = Path(disco_hw.__file__).parent / "robots" / "wombot.toml"
ROOM = ((-2.0, -2.0), (2.0, -2.0), (2.0, 2.0), (-2.0, 2.0))
LINE = np.array([[-2.0, 0.0], [2.0, 0.0]])
PERIOD_NS = 100_000_000
NOTHING = Fence()


def bounds_of(fence: Fence = NOTHING, obstacles=()) -> Boundaries:
    return Boundaries(FOOTPRINT, fence, obstacles)


def around(fence: Fence, obstacles=(), deviation_m: float = 0.0) -> Surroundings:
    found = Surroundings(FOOTPRINT, 0.1, 40, 0.2)
    found.look_around(bounds_of(fence, obstacles), deviation_m)
    return found


def test_the_shapes_that_a_plan_can_reach_are_relative_to_the_origin():
    person = MovingCircle(0.5, 0.4, 0.3, 0.1, -0.2)
    area = around(Fence(keep_in=ROOM), [person]).place(1.0, 0.0, (1.0, 2.0), 0.25)
    rows = area.shapes.reshape(-1, COLUMNS)[: area.number[0]]
    assert [tuple(np.round(row, 6)) for row in rows] == [
        (1.0, -4.0, 0.0, 1.0, 4.0, 0.0, 0.0, 0.0),
        (-0.5, -1.6, 0.0, 0.0, 0.0, 0.3, 0.1, -0.2),
    ]
    assert around(Fence(keep_in=ROOM)).place(0.0, 0.0, (0.0, 0.0), 0.1).number[0] == 0


def test_of_many_shapes_the_nearest_are_kept():
    many = [MovingCircle(0.02 * k, 0.0, 0.001) for k in range(30, 0, -1)]
    area = around(Fence(), many).place(0.0, 0.0, (0.0, 0.0), 0.5)
    rows = area.shapes.reshape(-1, COLUMNS)
    assert area.number[0] == MOST_SHAPES
    np.testing.assert_allclose(np.sort(rows[:, 0]), 0.02 * np.arange(1, MOST_SHAPES + 1), rtol=1e-6)


def test_the_distance_to_keep_follows_from_the_probability_asked_for():
    assert around(Fence(keep_in=ROOM)).area.body[3] == pytest.approx(0.05)
    assert around(Fence(keep_in=ROOM), deviation_m=0.01).area.body[3] == pytest.approx(0.05 + 3.0902 * 0.01, rel=1e-4)
    changed = around(Fence(keep_in=ROOM))
    changed.look_around(bounds_of(Fence(keep_in=ROOM, margin_m=0.25, max_breach_probability=0.05)), 0.01)
    assert changed.area.body[3] == pytest.approx(0.25 + 1.6449 * 0.01, rel=1e-4)


@pytest.mark.parametrize("yaw", [0.0, math.pi])
@pytest.mark.parametrize("x_m", [-1.0, 0.3, 0.44, 0.46, 0.6])
def test_a_place_costs_what_the_footprint_lacks_of_the_distance_to_keep(x_m, yaw):
    bounds = bounds_of(obstacles=[MovingCircle(1.0, 0.0, 0.25)])
    area = around(Fence(), [MovingCircle(1.0, 0.0, 0.25)]).place(0.0, 0.0, (0.0, 0.0), 0.25)
    place = tuple(map(np.float32, (x_m, 0.0, 0.0)))
    got = touched(area, np.float32(0.0), place, np.float32(math.cos(yaw)), np.float32(math.sin(yaw)))
    lacking_m = area.body[KEEP] - bounds.clearance_m(np.array([[x_m, 0.0, yaw]]))[0]
    expected = TOUCH_COST + TOUCH_COST_PER_M * lacking_m if lacking_m > 0.0 else 0.0
    assert got == pytest.approx(expected, abs=0.05)


def detours(bounds: Boundaries, keep_m: float = 0.05, known: Detours | None = None) -> np.ndarray:
    found = Detours(FOOTPRINT) if known is None else known
    if known is None:
        found.set_line(LINE)
    found.look_around(bounds, keep_m)
    buffer = np.zeros(DETOURS * DETOUR_COLUMNS, np.float32)
    found.place(buffer, 0.0, 0.0, (0.0, 0.0))
    return buffer.reshape(DETOURS, DETOUR_COLUMNS)


NEEDED_M = 0.1 + 0.2 + 0.05 + SPARE_M


@pytest.mark.parametrize(
    ("y_m", "left_m"), [(0.05, 0.05 - NEEDED_M), (-0.05, -0.05 + NEEDED_M), (0.3, 0.3 - NEEDED_M), (0.36, 0.0)]
)
def test_an_obstacle_is_passed_on_its_shorter_side_if_it_is_in_the_way(y_m, left_m):
    first, second = detours(bounds_of(obstacles=[MovingCircle(0.5, y_m, 0.1)]))
    assert first[5] == pytest.approx(left_m, abs=1e-6)
    assert second[5] == 0.0
    if left_m:
        np.testing.assert_allclose(first[:4], [0.5, 0.0, 1.0, 0.0], atol=0.026)


def test_the_other_side_is_taken_where_the_shorter_one_is_closed():
    wall = Fence(keep_out=(((0.2, -0.3), (0.8, -0.3), (0.8, -0.2), (0.2, -0.2)),))
    free, closed = (detours(bounds_of(fence, [MovingCircle(0.5, 0.05, 0.1)]))[0, 5] for fence in (Fence(), wall))
    assert free == pytest.approx(0.05 - NEEDED_M)
    assert closed == pytest.approx(0.05 + NEEDED_M)


@pytest.mark.parametrize("facing", ["forwards", "backwards"])
@pytest.mark.parametrize("post_x_m", [-0.3, 0.3])
def test_a_side_is_closed_where_the_robot_lies_on_its_line_as_it_drives_it(facing, post_x_m):
    setup = load_setup(ROBOT_FILE)
    robot = msgspec.structs.replace(setup.config.robot, footprint_m=Footprint(0.4, 0.3, 0.25))
    fence = Fence(keep_out=(Circle((0.0, 0.02), 0.1), Circle((post_x_m, -0.4), 0.1)))
    control = msgspec.structs.replace(setup.config.control, facing=facing)
    task = PathTask(path="line.csv", points=((-2.0, 0.0), (2.0, 0.0)))
    config = msgspec.structs.replace(setup.config, robot=robot, fence=fence, control=control, task=task)
    found = create_surroundings(config, DiscoSettings())
    left_m = found.place(0.0, 0.0, (0.0, 0.0), 0.2).detours[5]
    # The whole footprint is ahead of the tracked point; the right side is the shorter one, and the post stands there.
    is_hit = (post_x_m > 0.0) == (facing == "forwards")
    assert left_m == pytest.approx(0.38 if is_hit else -0.34)


def test_a_detour_keeps_its_side_while_the_obstacle_wavers():
    known = Detours(FOOTPRINT)
    known.set_line(LINE)
    sides = [
        math.copysign(1.0, detours(bounds_of(obstacles=[MovingCircle(0.5, y, 0.1)]), known=known)[0, 5])
        for y in (0.03, -0.03, 0.04, -0.02, -0.2)
    ]
    assert sides == [-1.0, -1.0, -1.0, -1.0, 1.0]


def planner_in(fence: Fence):
    setup = load_setup(ROBOT_FILE)
    robot = msgspec.structs.replace(setup.config.robot, footprint_m=FOOTPRINT)
    config = msgspec.structs.replace(setup.config, robot=robot, fence=fence)
    return create_planner(config, replace(setup, config=config).model)


@pytest.fixture(scope="module")
def planner():
    return planner_in(Fence(keep_in=ROOM))


def drive(planner, bounds: Boundaries, seconds: float, state=(0.75, 0.0, 1.57)):
    """Where a robot that is as its model says goes when the planner plans ten times a second."""
    planner.reset()
    x, y, yaw = state
    wheels, poses, outcomes = (0.0, 0.0), [], []
    for tick in range(round(seconds * 1e9 / PERIOD_NS)):
        planner.look_around(bounds, 0.004)
        try:
            plan = planner.plan(tick * PERIOD_NS, PlannerState(tick * PERIOD_NS, x, y, yaw, *wheels))
        except NoValidControl as error:
            return np.array(poses), [*outcomes, str(error)]
        outcomes.append(plan.diagnostics.outcome)
        x, y, yaw = plan.trajectory[1].tolist()
        wheels = tuple(plan.wheel_speeds[0].tolist())
        poses.append((x, y, yaw))
    return np.array(poses), outcomes


def test_a_pillar_on_the_line_is_driven_around_and_the_line_rejoined(planner):
    pillar = bounds_of(Fence(keep_in=ROOM), [MovingCircle(0.0, 0.75, 0.12)])
    poses, _ = drive(planner, pillar, 20.0)
    assert pillar.clearance_m(poses).min() > 0.04
    angle = np.unwrap(np.arctan2(poses[:, 1], poses[:, 0]))
    off = np.abs(np.hypot(poses[:, 0], poses[:, 1]) - 0.75)
    assert angle[-1] > math.radians(220)
    assert off[angle > math.radians(205)].max() < 0.05


def test_beside_a_pillar_the_step_allocates_nothing(planner):
    drive(planner, bounds_of(Fence(keep_in=ROOM), [MovingCircle(0.0, 0.75, 0.12)]), 2.0)
    arguments = planner.optimiser.arguments
    (area,) = [one.area for one in arguments if hasattr(one, "area")]
    assert area.number[0] > 0
    assert area.detours[DETOUR_COLUMNS - 2] != 0.0
    of_step, of_nothing = allocations(arguments)
    assert of_step == of_nothing > 0


@pytest.mark.thorough
def test_without_a_pillar_the_line_is_kept(planner):
    poses, _ = drive(planner, bounds_of(Fence(keep_in=ROOM)), 8.0)
    assert np.abs(np.hypot(poses[40:, 0], poses[40:, 1]) - 0.75).max() < 0.02


@pytest.mark.thorough
def test_where_there_is_no_way_the_robot_stands_before_it(planner):
    ring = [MovingCircle(0.45 * k - 1.8, 0.75, 0.25) for k in range(9)]
    blocked = bounds_of(Fence(keep_in=ROOM), ring)
    poses, _ = drive(planner, blocked, 12.0)
    assert blocked.clearance_m(poses).min() > 0.0
    assert np.hypot(*(poses[-1, :2] - poses[-20, :2])) < 0.1


def test_a_robot_that_nothing_can_free_is_told_so(planner):
    buried = bounds_of(Fence(keep_in=ROOM), [MovingCircle(0.75, 0.0, 1.9)])
    _, outcomes = drive(planner, buried, 2.0)
    assert PlanOutcome.STOPPING in outcomes
    assert outcomes[-1].startswith("no way past the fence or an obstacle was found, and the robot stops before it")


def test_a_robot_without_a_fence_plans_as_ever():
    setup = load_setup(ROBOT_FILE)
    plain = create_planner(setup.config, setup.model)
    plain.look_around(bounds_of(obstacles=[MovingCircle(0.0, 0.75, 0.12)]), 0.0)
    plain.set_line(LINE)
    plan = plain.plan(0, PlannerState(0, 0.75, 0.0, 1.57, 0.0, 0.0))
    assert plan.diagnostics.outcome is PlanOutcome.PLANNED


@pytest.mark.thorough
def test_a_circle_to_stay_in_is_kept():
    inner = Fence(keep_in=Circle((0.0, 0.0), 1.02))
    poses, _ = drive(planner_in(inner), bounds_of(inner), 8.0)
    assert bounds_of(inner).clearance_m(poses).min() > 0.0
