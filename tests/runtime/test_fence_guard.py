"""Whatever is commanded, a robot can always stop within the fence that the guard watches; and it fails closed."""

from __future__ import annotations

import math
from collections import deque

import numpy as np
import pytest
from hypothesis import strategies as st

from disco_hw.estimation import PoseEstimate
from disco_hw.estimation.odometry import OdometryParameters
from disco_hw.fence import Circle, Fence, Footprint
from disco_hw.fence.clearance import Boundaries, MovingCircle
from disco_hw.runtime.fence_guard import IDLE, SCALES, STOPS_MOTION, FenceGuard, FenceVerdict, StoppingSettings
from disco_hw.runtime.pipeline import Governor, WheelLimits
from tests.tables import examples

FOOTPRINT = Footprint(0.5, 0.4, 0.05)
CELL = ((-1.0, -1.0), (1.4, -1.0), (1.4, 0.9), (-1.0, 0.9))
ROOM = ((-2.0, -1.5), (2.0, -1.5), (2.0, 1.5), (-2.0, 1.5))
IN_CELL, IN_ROOM = Fence(keep_in=CELL), Fence(keep_in=ROOM)
STOPS = StoppingSettings(response_s=0.08, reaction_s=0.1, deceleration_rad_s2=20.0, period_s=0.02)
RADIUS, AXLE, X_ICR = 0.06, 0.4, 0.1
EXACT = OdometryParameters(RADIUS, AXLE, X_ICR)
NO_SPREAD = ((0.0,) * 3,) * 3
GOES = {FenceVerdict.FREE, FenceVerdict.SCALED}


def covariance(position_m: float, yaw_rad: float):
    return ((position_m**2, 0.0, 0.0), (0.0, position_m**2, 0.0), (0.0, 0.0, yaw_rad**2))


def estimate(
    x=0.0, y=0.0, yaw=0.0, wheels=(0.0, 0.0), spread=NO_SPREAD, age_s: float | None = 0.0, **changes
) -> PoseEstimate:  # fmt: skip
    fields = {
        "t_ns": 0, "x_m": x, "y_m": y, "yaw_rad": yaw, "covariance": spread, "speed_m_s": 0.0, "yaw_rate_rad_s": 0.0,
        "left_speed_rad_s": wheels[0], "right_speed_rad_s": wheels[1], "wheel_age_s": 0.01, "pose_age_s": age_s,
        "initialised": True, "wheels_ok": True, "pose_ok": True, "reinitialisations": 0, "heading_known": True,
    }  # fmt: skip
    return PoseEstimate(**{**fields, **changes})


def guard_of(fence: Fence, stops: StoppingSettings = STOPS, margin_m: float = 0.05) -> FenceGuard:
    return FenceGuard(Boundaries(FOOTPRINT, fence), stops, margin_m)


def evaluate(seen: PoseEstimate, requested, last=None, fence=IN_ROOM, geometry=EXACT, stops=STOPS, margin_m=0.05):
    sent = (seen.left_speed_rad_s, seen.right_speed_rad_s) if last is None else last
    return guard_of(fence, stops, margin_m).step(seen, geometry, sent, requested)


def uncertain(radius=0.0, axle=0.0, centre_m=0.0, common=0.0) -> OdometryParameters:
    """The geometry known with these deviations: of radius and axle as shares, with their covariance `common`."""
    of_radius = (radius**2 * RADIUS**2, common * RADIUS * AXLE, 0)
    of_axle = (common * RADIUS * AXLE, axle**2 * AXLE**2, 0)
    return OdometryParameters(RADIUS, AXLE, X_ICR, (of_radius, of_axle, (0, 0, centre_m**2)))


def test_without_a_fence_and_obstacles_nothing_is_judged():
    assert guard_of(Fence()).step(estimate(pose_ok=False), EXACT, (0, 0), (5, 5)) is IDLE
    assert not guard_of(Fence()).is_active
    assert IDLE.scale == 1.0
    assert IDLE.verdict not in STOPS_MOTION


def integrated(
    seen: PoseEstimate, geometry: OdometryParameters, before, command, stops: StoppingSettings, response_s, longer
):
    """The end of the stopping path by small steps of what the module's docstring says, and the poses on the way."""
    before, command, dt = np.array(before), np.array(command), 1e-4
    excess = np.where(before * command < 0, before, np.where(abs(before) > abs(command), before - command, 0))
    poses = np.array([[seen.x_m, seen.y_m, seen.yaw_rad]])

    def drive(speeds, lasting_s, slowing):
        nonlocal poses
        steps = round(lasting_s / dt)
        parts = 1 - (np.arange(steps) + 0.5) / steps if slowing else np.ones(steps)
        left, right = longer * geometry.wheel_radius_m * np.outer(speeds, parts)
        v, w = (left + right) / 2, (right - left) / geometry.axial_distance_m
        yaw = poses[-1, 2] + dt * (np.cumsum(w) - w)
        x_m_s = v * np.cos(yaw) + w * geometry.x_icr_m * np.sin(yaw)
        y_m_s = v * np.sin(yaw) - w * geometry.x_icr_m * np.cos(yaw)
        poses = np.vstack([poses, poses[-1] + dt * np.cumsum(np.column_stack([x_m_s, y_m_s, w]), axis=0)])

    drive(before, response_s, slowing=False)
    drive(excess, abs(excess).max() / stops.deceleration_rad_s2, slowing=True)
    drive(command, 1.5 * stops.period_s + stops.reaction_s, slowing=False)
    drive(command, abs(command).max() / stops.deceleration_rad_s2, slowing=True)
    return poses


@pytest.mark.parametrize("before", [(0.0, 0.0), (5.0, 5.0), (5.0, 2.0), (-4.0, 3.0)])
@pytest.mark.parametrize("command", [(5.0, 5.0), (2.0, 6.0), (-3.0, 5.0), (-6.0, -2.0)])
def test_the_stopping_path_is_what_the_wheels_would_do(before, command):
    seen = estimate(0.3, -0.2, 0.7, before)
    found = evaluate(seen, command, fence=IN_CELL)
    assert (found.verdict, found.scale) == (FenceVerdict.FREE, 1.0)
    path = np.array(found.path)
    expected = integrated(seen, EXACT, before, command, STOPS, STOPS.response_s, 1.0)
    np.testing.assert_allclose(path[0], expected[0])
    # What exceeds the command is driven along its own arc, so the way there is not the same to the millimetre.
    np.testing.assert_allclose(path[-1], expected[-1], atol=2e-4)
    off = np.abs(path[:, None, :] - expected[None]).max(axis=2).min(axis=1)
    assert off.max() < 4e-4
    nearest = Boundaries(FOOTPRINT, IN_CELL).clearance_m(expected[::20]).min()
    assert found.clearance_m == pytest.approx(nearest, abs=1e-3)


def test_the_believed_spread_makes_the_path_longer_and_wider():
    deviation = 0.02
    spread = uncertain(radius=deviation)
    seen = estimate(0.5, 0, 0, (5, 5), age_s=0.5)
    exact, longer = (evaluate(seen, (5, 5), geometry=one) for one in (EXACT, spread))
    response_s = STOPS.response_s + 3 * deviation * 0.5
    expected = integrated(seen, spread, (5, 5), (5, 5), STOPS, response_s, 1 + 3 * deviation)
    np.testing.assert_allclose(longer.path[-1], expected[-1], atol=2e-4)
    assert exact.path[-1][0] < longer.path[-1][0]
    # A pose of unknown age has none.
    np.testing.assert_allclose(evaluate(estimate(0.5, 0, 0, (5, 5), age_s=None), (5, 5)).path, exact.path)
    # Straight ahead neither a turn's spread nor that of the turning centre matters; on the spot both do.
    turn, centre = uncertain(axle=0.02), uncertain(centre_m=0.01)
    for one in (turn, centre):
        assert evaluate(seen, (5, 5), geometry=one).clearance_m == pytest.approx(exact.clearance_m)
    # By the wall, while the robot turns through `turned`, the corner that comes nearest is at the end of it.
    spinning = estimate(0.0, -1.1, 0.0, (-1, 1))
    plain = evaluate(spinning, (-1, 1))
    path = np.array(plain.path)
    turned = path[-1, 2]
    assert turned == pytest.approx(2 * RADIUS / AXLE * (0.08 + 0.13 + 0.5 / 20))
    moved = np.hypot(0.0, X_ICR * np.abs(np.diff(path[:, 2]))).sum()

    def clearance_m(geometry):
        return evaluate(spinning, (-1, 1), geometry=geometry).clearance_m

    reduction_m = 3 * 0.02 * turned * (FOOTPRINT.reach_m + 0.5 * moved)
    assert plain.clearance_m - clearance_m(turn) == pytest.approx(reduction_m, rel=0.05)
    assert plain.clearance_m - clearance_m(centre) == pytest.approx(3 * 0.01 * turned, rel=0.05)
    # What radius and axle have in common does not change how the robot turns.
    assert clearance_m(uncertain(0.01, 0.01, common=0.01**2)) > clearance_m(uncertain(0.01, 0.01)) + 1e-3


@pytest.mark.parametrize(
    ("spread", "deviation_m"),
    [
        (covariance(0.01, 0.0), 0.01),
        (covariance(0.0, 0.02), 0.02 * FOOTPRINT.reach_m),
        (((1e-4, 0, 0), (0, 0, 0), (0, 0, 0)), 0.01),
        (((1e-4, 1e-4, 0), (1e-4, 1e-4, 0), (0, 0, 0)), 0.01 * math.sqrt(2.0)),
        # An error of the yaw that always goes with one of y moves the front corners by both.
        (((0, 0, 0), (0, 1e-4, 2e-4), (0, 2e-4, 4e-4)), math.hypot(0.01 + 0.3 * 0.02, 0.2 * 0.02)),
    ],
)  # fmt: skip
def test_three_deviations_of_the_corner_known_least_are_kept(spread, deviation_m):
    known, unknown = (evaluate(estimate(spread=one), (0, 0)) for one in (NO_SPREAD, spread))
    assert known.clearance_m - unknown.clearance_m == pytest.approx(3 * deviation_m)


def test_the_deviation_is_that_of_the_corner_in_the_world():
    spread = ((0, 0, 0), (0, 1e-4, 2e-4), (0, 2e-4, 4e-4))
    fence = Fence(keep_in=Circle((0.0, 0.0), 2.0))
    for yaw in (0.3, 1.3, -2.0):
        known, unknown = (evaluate(estimate(yaw=yaw, spread=one), (0, 0), fence=fence) for one in (NO_SPREAD, spread))
        offsets = []
        for x, y in FOOTPRINT.corners_m():
            ahead, aside = x * math.cos(yaw) - y * math.sin(yaw), x * math.sin(yaw) + y * math.cos(yaw)
            offsets.append(math.hypot(0.02 * -aside, 0.01 + 0.02 * ahead))
        assert known.clearance_m - unknown.clearance_m == pytest.approx(3 * max(offsets))


def ahead_of_wall(gap_m: float, wheels=(0.0, 0.0)) -> PoseEstimate:
    """The footprint's front so far from the wall at x = 2, facing it."""
    return estimate(2.0 - 0.3 - gap_m, 0.0, 0.0, wheels)


def stopping_m(speed: float) -> float:
    """What a robot at this speed (rad/s) needs to stop: response, reaction, a tick and a half, and braking."""
    return RADIUS * (speed * (0.08 + 0.03 + 0.1) + speed**2 / (2 * 20.0))


@pytest.mark.parametrize("speed", [2.0, 5.0, 8.0])
def test_a_command_is_free_scaled_and_stopped_as_the_wall_comes_nearer(speed):
    wheels = (speed, speed)
    needed_m = stopping_m(speed)
    for spare_m, verdict in ((0.051, FenceVerdict.FREE), (0.049, FenceVerdict.SCALED), (0.001, FenceVerdict.SCALED)):
        found = evaluate(ahead_of_wall(needed_m + spare_m, wheels), wheels)
        assert (found.verdict, found.reason) == (verdict, "")
        assert (found.scale == 1.0) == (verdict is FenceVerdict.FREE)
    assert found.scale in SCALES
    assert found.clearance_m >= 0.05 * found.scale
    # Already the stop itself would end outside.
    immediate_stop_m = RADIUS * (speed * 0.08 + speed**2 / 40.0)
    found = evaluate(ahead_of_wall(immediate_stop_m - 0.001, wheels), wheels)
    assert (found.verdict, found.scale) == (FenceVerdict.STOPPED, 0.0)
    assert found.clearance_m == pytest.approx(-0.001)
    end_m = 1.7 - immediate_stop_m + 0.001 + needed_m
    where = f"the stopping path would leave the fence at ({end_m:.2f}, 0.00)"
    assert found.reason == f"{where}; drive the robot away from there"


def test_the_margin_is_kept_in_part_by_scaled_commands():
    for margin_m in (0.0, 0.05, 0.2):
        for gap_m in np.linspace(0.01, 0.4, 40):
            found = evaluate(ahead_of_wall(gap_m), (5, 5), margin_m=margin_m)
            allowed = [s for s in SCALES if gap_m - (stopping_m(5 * s) - RADIUS * 5 * s * 0.08) >= s * margin_m]
            assert found.scale == pytest.approx(max(allowed))
            assert found.verdict in (GOES if found.scale else {FenceVerdict.STOPPED})


@pytest.mark.parametrize("gap_m", [0.02, 0.0, -0.03, -0.5, -3.0])
def test_what_leads_away_from_the_fence_is_free(gap_m):
    seen = ahead_of_wall(gap_m)
    away = evaluate(seen, (-8, -8))
    assert (away.verdict, away.scale) == (FenceVerdict.FREE, 1.0)
    for towards in ((3, 3), (-2, 2), (2, 5)):
        assert evaluate(seen, towards).scale <= (0.25 if gap_m > 0 else 0.0)
    # Still moving outwards, not even the way back is let through: it would begin with going farther out.
    assert evaluate(ahead_of_wall(-0.03, (3, 3)), (-8, -8)).scale == 0.0


@pytest.mark.parametrize(("pillars_x_m", "scale"), [((), 1.0), ((1.6,), 0.5), ((0.9,), 1.0)])
def test_going_back_into_the_fence_must_not_lead_into_an_obstacle(pillars_x_m, scale):
    pillars = tuple(Circle((x_m, 0.0), 0.15) for x_m in pillars_x_m)
    fence = Fence(keep_in=ROOM, keep_out=pillars)
    assert evaluate(ahead_of_wall(-0.35), (-8, -8), fence=fence).scale == scale


def test_along_the_fence_outside_of_the_margin_is_free():
    deviation = covariance(0.005, 0.005)
    spread = uncertain(1e-3 / RADIUS, 0.01 / AXLE, 0.01)
    # 0.3 m/s, the side of the footprint 0.15 m from the wall.
    seen = estimate(0.0, 1.5 - 0.2 - 0.15, 0.0, (5, 5), spread=deviation)
    assert evaluate(seen, (5, 5), geometry=spread).verdict is FenceVerdict.FREE


def test_a_stopped_command_does_not_flutter():
    guard = guard_of(IN_ROOM)

    def scale(gap_m: float, requested=(5, 5)) -> float:
        return guard.step(ahead_of_wall(gap_m), EXACT, (0, 0), requested).scale

    freely = {s: stopping_m(5 * s) - RADIUS * 5 * s * 0.08 + s * 0.05 + 1e-4 for s in SCALES[1:]}
    assert scale(freely[0.25]) == 0.25
    assert scale(0.005) == 0.0
    assert scale(freely[0.375]) == 0.0
    assert scale(freely[0.5]) == 0.5
    assert scale(freely[0.375]) == 0.375
    assert scale(0.005) == 0.0
    # Who lets go of the command and gives it anew begins anew.
    assert scale(0.005, (0, 0)) == 1.0
    assert scale(freely[0.375]) == 0.375


@pytest.mark.parametrize(("velocity_m_s", "is_free"), [(0.0, True), (-3.0, False)])
def test_an_obstacle_that_moves_is_met_where_it_will_be(velocity_m_s, is_free):
    guard, seen = guard_of(Fence()), estimate(0, 0, 0, (5, 5))
    guard.set_obstacles([MovingCircle(0.45, 0.8, 0.1, 0.0, velocity_m_s)])
    assert guard.is_active
    assert (guard.step(seen, EXACT, (5, 5), (5, 5)).verdict is FenceVerdict.FREE) == is_free
    guard.set_obstacles([])
    assert guard.step(seen, EXACT, (5, 5), (5, 5)) is IDLE


def test_another_fence_is_kept_with_the_obstacles_and_its_own_margin():
    guard = guard_of(IN_ROOM)
    guard.set_obstacles([MovingCircle(0.6, 0.0, 0.2)])
    guard.set_boundaries(Boundaries(FOOTPRINT, Fence(keep_in=Circle((0, 0), 5.0))), 0.1)
    assert guard.step(estimate(), EXACT, (0, 0), (5, 5)).verdict is not FenceVerdict.FREE
    guard.set_obstacles([])
    assert guard.step(estimate(4.0), EXACT, (0, 0), (1, 1)).verdict is FenceVerdict.FREE
    near = 5.0 - 0.3 - 0.1 - 0.005
    assert guard.step(estimate(near), EXACT, (0, 0), (1, 1)).scale < 1.0


def test_a_slower_controller_needs_a_longer_way():
    guard = guard_of(IN_ROOM)
    arguments = ahead_of_wall(0.16, (5, 5)), EXACT, (5, 5), (5, 5)
    before = guard.step(*arguments)
    guard.set_deceleration(10.0)
    assert before.scale > guard.step(*arguments).scale


@pytest.mark.parametrize(
    "broken", [(math.nan, 0, 1, 0.02), (0, -0.1, 1, 0.02), (0, 0, 0, 0.02), (0, 0, math.inf, 0.02), (0, 0, -1, 0.02)]
)
def test_settings_that_cannot_be_are_refused(broken):
    with pytest.raises(ValueError, match="deceleration positive"):
        StoppingSettings(*broken)
    assert StoppingSettings(0.0, 0.0, 1.0, 0.0).response_s == 0.0


@pytest.mark.parametrize(
    "broken",
    [
        {"pose_ok": False}, {"initialised": False}, {"wheels_ok": False},
        {"x": math.nan}, {"y": math.inf}, {"yaw": math.nan}, {"wheels": (math.nan, 0)}, {"wheels": (0, math.inf)},
        {"spread": ((math.nan, 0, 0), (0, 0, 0), (0, 0, 0))}, {"spread": ((0, 0, 0), (0, 0, 0), (0, 0, math.inf))},
    ],
    ids=str,
)  # fmt: skip
def test_without_a_pose_that_is_a_pose_nothing_moves(broken):
    found = guard_of(IN_ROOM).step(estimate(**broken), EXACT, (0, 0), (5, 5))
    assert (found.verdict, found.scale) == (FenceVerdict.NO_POSE, 0.0)
    assert found.reason == "no valid pose while a fence is set; check the pose sensor"
    assert found.verdict in STOPS_MOTION


@pytest.mark.parametrize("requested", [(math.nan, 0.0), (math.inf, 1.0), (0.0, 0.0), (1e-4, -1e-4)])
def test_what_asks_for_no_motion_is_judged_as_a_stop(requested):
    found = evaluate(estimate(wheels=(5, 5)), requested)
    assert (found.verdict, found.scale) == (FenceVerdict.FREE, 1.0)
    assert found.path[-1][0] == pytest.approx(RADIUS * (5 * 0.08 + 25 / 40))
    assert evaluate(estimate(last_nan := 0.0), (1, 1), last=(math.nan, last_nan)).scale == 0.0


def test_an_obstacle_that_is_reported_no_longer_stops_the_robot():
    guard = guard_of(Fence())
    guard.set_obstacles([MovingCircle(50.0, 0.0, 0.1)], ["person", "cart"])
    found = guard.step(estimate(), EXACT, (0, 0), (1, 1))
    assert (found.verdict, found.scale) == (FenceVerdict.OBSTACLE_LOST, 0.0)
    assert found.reason == "obstacle person, cart is no longer reported; report it again or remove it"
    guard.set_obstacles([], ["person"])
    assert guard.step(estimate(), EXACT, (0, 0), (1, 1)).scale == 0.0
    guard.set_obstacles([MovingCircle(50.0, 0.0, 0.1)])
    assert guard.step(estimate(), EXACT, (0, 0), (1, 1)).scale == 1.0


def test_an_override_lets_all_through_where_there_is_a_fence():
    guard = guard_of(IN_ROOM)
    found = guard.step(estimate(pose_ok=False), EXACT, (0, 0), (5, 5), overridden=True)
    assert (found.verdict, found.scale) == (FenceVerdict.OVERRIDDEN, 1.0)
    assert "with the fence overridden" in found.reason
    assert guard_of(Fence()).step(estimate(), EXACT, (0, 0), (5, 5), overridden=True) is IDLE


def corners(pose) -> np.ndarray:
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    return np.array([(pose[0] + cos * x - sin * y, pose[1] + sin * x + cos * y) for x, y in FOOTPRINT.corners_m()])


def is_inside(pose, polygon, pillar: Circle) -> bool:
    """By half planes of a convex polygon, and by the pillar in the robot's frame: not the product's own geometry."""
    places = corners(pose)
    for begin, end in zip(polygon, [*polygon[1:], polygon[0]], strict=True):
        way = np.subtract(end, begin)
        if (way[0] * (places[:, 1] - begin[1]) - way[1] * (places[:, 0] - begin[0]) < 0).any():
            return False
    dx, dy = pillar.center[0] - pose[0], pillar.center[1] - pose[1]
    ahead = math.cos(pose[2]) * dx + math.sin(pose[2]) * dy - FOOTPRINT.ahead
    aside = math.cos(pose[2]) * dy - math.sin(pose[2]) * dx
    off = math.hypot(max(abs(ahead) - 0.25, 0.0), max(abs(aside) - 0.2, 0.0))
    return off >= pillar.radius_m


class Plant:
    """A robot that nobody told: its own geometry, its wheels late by any response, its pose known with an error."""

    def __init__(self, radius, axle, x_icr, response_s, pose):
        self.radius, self.axle, self.x_icr = radius, axle, x_icr
        self.queue = deque([(0.0, 0.0)] * round(response_s / 0.002))
        self.pose, self.wheels = list(pose), (0.0, 0.0)

    def advance(self, command, seconds, inside) -> bool:
        for _ in range(round(seconds / 0.002)):
            self.queue.append(command)
            self.wheels = left, right = self.queue.popleft()
            v, w = self.radius * (left + right) / 2, self.radius * (right - left) / self.axle
            x, y, yaw = self.pose
            self.pose = [
                x + 0.002 * (v * math.cos(yaw) + w * self.x_icr * math.sin(yaw)),
                y + 0.002 * (v * math.sin(yaw) - w * self.x_icr * math.cos(yaw)),
                yaw + 0.002 * w,
            ]
        return inside(self.pose)


unit = st.floats(-1.0, 1.0)
rounds = st.tuples(st.integers(4, 7), st.floats(1.0, 1.8), st.floats(0.0, 6.3))


@examples(
    quick=12,
    every=120,
    room=rounds,
    pillar=st.tuples(unit, unit, st.floats(0.05, 0.3)),
    commands=st.lists(st.tuples(st.floats(-8, 8), st.floats(-8, 8), st.integers(5, 40)), min_size=1, max_size=5),
    truth=st.tuples(unit, unit, unit, st.floats(0.0, 1.0)),
    error=st.tuples(st.floats(0.0, 6.3), unit),
    start_yaw=st.floats(-3.1, 3.1),
)
def test_no_motion_ever_leaves_the_fence_even_if_the_host_dies(room, pillar, commands, truth, error, start_yaw):
    count, size, turned = room
    polygon = tuple(
        (size * math.cos(turned + 2 * math.pi * k / count), size * math.sin(turned + 2 * math.pi * k / count))
        for k in range(count)
    )
    post = Circle((pillar[0], pillar[1]), pillar[2])
    fence = Fence(keep_in=polygon, keep_out=(post,))
    deviation, position_m = (0.04, 0.04, 0.02), 0.01
    believed = uncertain(*deviation)
    plant = Plant(
        RADIUS * (1 + 3 * deviation[0] * truth[0]), AXLE * (1 + 3 * deviation[1] * truth[1]),
        X_ICR + 3 * deviation[2] * truth[2], STOPS.response_s * truth[3], (0.0, 0.0, start_yaw),
    )  # fmt: skip
    off = 3 * position_m * abs(error[1])
    guard, governor = guard_of(fence), Governor(WheelLimits(8.0, 20.0, 20.0), 0.02)
    sent = (0.0, 0.0)

    def inside(pose):
        return is_inside(pose, polygon, post)

    if Boundaries(FOOTPRINT, fence).clearance_m(np.array([plant.pose]))[0] < 0.1:
        return
    for left, right, ticks in commands:
        for _ in range(ticks):
            x, y, yaw = plant.pose
            seen = estimate(
                x + off * math.cos(error[0]), y + off * math.sin(error[0]), yaw, plant.wheels,
                covariance(position_m, 0.0),
            )  # fmt: skip
            found = guard.step(seen, believed, sent, (left, right))
            command = governor.step(found.scale * left, found.scale * right, 0.02)
            sent = (command.left_rad_s, command.right_rad_s)
            assert plant.advance(sent, 0.02, inside)
    # The host is silent: the wheels go on for the reaction time, and then slow down.
    assert plant.advance(sent, STOPS.reaction_s, inside)
    slowest = max(abs(sent[0]), abs(sent[1])) / STOPS.deceleration_rad_s2
    for k in range(1, math.ceil(slowest / 0.002) + 50):
        share = max(0.0, 1.0 - k * 0.002 / slowest) if slowest else 0.0
        assert plant.advance((sent[0] * share, sent[1] * share), 0.002, inside)


def test_the_path_is_sampled_as_finely_as_its_phases_say():
    assert SCALES.tolist() == [0.0, 0.25, 0.375, 0.5, 0.625, 0.75, 0.875, 1.0]
    assert len(evaluate(estimate(), (1, 1)).path) == 1 + 3 + 2 + 3 + 3


@pytest.mark.parametrize(("speed", "moves"), [(1e-3, False), (1.01e-3, True), (9.9e-4, False)])
def test_a_command_below_a_thousandth_of_a_radian_asks_for_nothing(speed, moves):
    for requested in ((speed, 0.0), (0.0, -speed)):
        path = evaluate(estimate(), requested).path
        assert (path[-1] != path[0]) == moves
    assert evaluate(estimate(wheels=(5, 5)), (0.0, 0.0)).path[-1] == pytest.approx(
        evaluate(estimate(wheels=(5, 5)), (math.nan, 0.0)).path[-1]
    )


def clearances(stop, following):
    """Clearances (S, K) to a shape: of the stop, of the smallest other scale, and deep in the shape for the rest."""
    return np.array([stop, following, *[[-9.0] * len(stop)] * (len(SCALES) - 2)], float)


def largest_scale(*shapes, steps=(0.0,)) -> float:
    """The scale that is chosen by the clearances to shapes, with corner steps of the smallest scale's path."""
    driven = np.zeros(shapes[0].shape)
    driven[1] = steps
    return float(SCALES[guard_of(Fence(), margin_m=0.5)._largest_scale(np.stack(shapes, axis=2), driven)])


FAR = [1.0, 1.0, 1.0]


@pytest.mark.parametrize(
    ("steps", "following", "chosen"),
    [
        # 1 - step / 2 against a quarter of the margin.
        ([0.0, 1.74, 0.0], FAR, 0.25),
        ([0.0, 1.76, 0.0], FAR, 0.0),
        ([0.0, 0.0, 1.76], FAR, 0.0),
        # The first point has nothing before it.
        ([1.76, 0.0, 0.0], FAR, 0.25),
        # Between the last two the clearance may be 0.2 - 0.1, and a quarter of the margin is 0.125.
        ([0.0, 0.0, 0.0, 0.2], [1.0, 0.2, 0.2, 0.2], 0.0),
        ([0.0, 0.0, 0.0, 0.0], [1.0, 0.2, 0.2, 0.2], 0.25),
    ],
)
def test_between_two_points_the_clearance_is_less_by_half_the_way_that_is_not_seen(steps, following, chosen):
    assert largest_scale(clearances([1.0] * len(steps), following), steps=steps) == chosen


@pytest.mark.parametrize(
    ("stop", "following", "chosen"),
    [
        (FAR, [1.0, 0.5, 0.1], 0.0),
        (FAR, [1.0, 0.5, 0.125], 0.25),
        (FAR, [1.0, 0.5, 0.124], 0.0),
        # As near as the stop itself, too.
        ([1.0, 0.5, 0.03], [1.0, 0.5, 0.03], 0.25),
        ([1.0, 0.5, 0.0], [1.0, 0.5, 0.0], 0.25),
        ([1.0, 0.5, -0.01], [1.0, 0.5, -0.01], 0.0),
        # Leading away is never nearer, and at last farther than at first.
        ([-1.0] * 3, [-1.0, -1.0, -0.9], 0.25),
        ([-1.0] * 3, [-1.0, -0.8, -1.0], 0.0),
        ([-1.0] * 3, [-1.0, -1.1, -0.9], 0.0),
        ([-1.0] * 3, [-1.0, -1.0, -1.0], 0.0),
        ([-1.0] * 3, [-1.0, -0.9, -0.95], 0.25),
    ],
)
def test_a_path_may_come_exactly_as_near_as_it_may_or_lead_away(stop, following, chosen):
    assert largest_scale(clearances(stop, following)) == chosen


def test_of_two_shapes_both_must_hold():
    far, near = clearances(FAR, FAR), clearances(FAR, [1.0, 0.5, 0.1])
    assert largest_scale(far, far) == SCALES[1]
    assert largest_scale(far, near) == 0.0


@pytest.mark.parametrize(("sent", "measured"), [((5.0, 5.0), (0.0, 0.0)), ((0.0, 0.0), (5.0, 5.0))])
def test_the_nearer_of_the_paths_by_command_and_by_measurement_counts(sent, measured):
    def clearance_m(wheels, last=None):
        return evaluate(estimate(0.5, wheels=wheels), (2.0, 2.0), last, IN_CELL).clearance_m

    assert clearance_m(measured, sent) == pytest.approx(clearance_m((5.0, 5.0)))
    assert clearance_m(measured, sent) < clearance_m((0.0, 0.0)) - 0.01
    steps = guard_of(IN_CELL)._stopping_paths(estimate(0.5, wheels=measured), EXACT, sent, (2.0, 2.0))[2]
    assert steps[-1, 1] == pytest.approx(RADIUS * 5.0 * 0.08 / 3)


def test_a_corner_moves_by_the_way_and_by_the_turn():
    wheels = (1.0, 3.0)
    steps = guard_of(IN_CELL)._stopping_paths(estimate(wheels=wheels), EXACT, wheels, wheels)[2]
    turn = RADIUS * 2.0 / AXLE * 0.08 / 3
    moved = math.hypot(RADIUS * 2.0 * 0.08 / 3, X_ICR * turn)
    assert steps[-1, 1] == pytest.approx(moved + FOOTPRINT.reach_m * turn)


@pytest.mark.parametrize(
    ("before", "command"), [((2.0, 7.0), (2.0, 7.0)), ((-3.0, 4.0), (-3.0, 4.0)), ((0.5, 0.6), (0.6, 0.7))]
)
def test_long_arcs_end_where_they_do(before, command):
    slow = StoppingSettings(response_s=1.2, reaction_s=0.9, deceleration_rad_s2=2.0, period_s=0.02)
    seen = estimate(yaw=0.4, wheels=before)
    found = evaluate(seen, command, fence=Fence(keep_in=Circle((0.0, 0.0), 20.0)), stops=slow)
    expected = integrated(seen, EXACT, before, command, slow, 1.2, 1.0)
    np.testing.assert_allclose(found.path[-1], expected[-1], atol=2e-4)


def test_a_believed_spread_makes_turns_longer_too():
    def path(geometry, age_s=0.0):
        return evaluate(estimate(wheels=(-2.0, 2.0), age_s=age_s), (-2.0, 2.0), geometry=geometry).path

    spread = uncertain(radius=0.02)
    assert path(spread)[-1][2] == pytest.approx(1.06 * path(EXACT)[-1][2])
    assert path(spread, age_s=None) == path(spread)


def test_the_clearance_is_less_by_the_turn_that_is_not_known_along_the_path():
    wheels = (1.0, 3.0)
    exact, wide = (
        guard_of(IN_CELL)._stopping_paths(estimate(wheels=wheels), geometry, wheels, wheels)
        for geometry in (EXACT, uncertain(axle=0.01))
    )
    path = exact[0][-1]
    turned = np.abs(path[:, 2] - path[0, 2])
    moved = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(turned) * X_ICR, np.diff(turned) * AXLE))])
    expected_m = 3 * 0.01 * turned * (FOOTPRINT.reach_m + 0.5 * moved)
    np.testing.assert_allclose((exact[1] - wide[1])[-1, :, 1], expected_m, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize(
    ("before", "command"),
    [
        ((5.0, 5.0), (5.0, 5.0)),
        ((6.0, 6.0), (2.0, 2.0)),
        # In a turn the faster wheel says how long the braking lasts.
        ((6.0, 3.0), (3.0, 1.0)),
        ((2.0, 5.0), (1.0, 6.0)),
    ],
)
@pytest.mark.parametrize("velocity_m_s", [-0.25, -1.0])
def test_an_obstacle_is_where_it_will_be_when_the_robot_has_stopped(before, command, velocity_m_s):
    guard = guard_of(Fence())
    guard.set_obstacles([MovingCircle(1.5, 0.0, 0.1, velocity_m_s, 0.0)])
    found = guard._stopping_paths(estimate(wheels=before), EXACT, before, command)
    excess = max(max(now - then, 0.0) for now, then in zip(before, command, strict=True))
    end_s = 0.08 + excess / 20.0 + 0.13 + max(command) / 20.0
    there = Boundaries(FOOTPRINT, Fence(), [MovingCircle(1.5 + velocity_m_s * end_s, 0.0, 0.1)])
    assert found[1][-1, -1, 1] == pytest.approx(there.clearance_m(found[0][-1, -1:])[0], abs=1e-9)


@pytest.mark.parametrize(
    ("keep_in", "margin_m"), [(Circle((0.0, 0.0), 20.0), 0.25), (((-9, -9), (9, -9), (9, 9), (-9, 9)), 0.05)]
)
def test_a_clearance_that_matters_to_nothing_is_given_as_the_largest_that_does(keep_in, margin_m):
    found = evaluate(estimate(), (0, 0), fence=Fence(keep_in=keep_in), margin_m=margin_m)
    assert found.clearance_m == pytest.approx(margin_m + 2.0 * FOOTPRINT.reach_m)


@pytest.mark.parametrize(
    ("seen", "requested"),
    [(estimate(), (1e200, 1e200)), (estimate(x=1e308, wheels=(1e308, 1e308)), (1e308, 1e308))],
    ids=["only its end", "all of it"],
)
def test_a_path_that_has_no_numbers_moves_nothing(seen, requested):
    with np.errstate(all="ignore"):
        found = evaluate(seen, requested)
    assert (found.verdict, found.scale) == (FenceVerdict.NO_POSE, 0.0)
    assert found.reason == "the predicted stopping path is not finite"


def test_the_place_that_is_said_is_where_the_full_command_would_be_deepest():
    # It would go over the pillar and stop far behind it; a part of the command would stop on it.
    slow = StoppingSettings(response_s=0.08, reaction_s=0.1, deceleration_rad_s2=2.0, period_s=0.02)
    fence = Fence(keep_out=(Circle((0.55, 0.0), 0.14),))
    found = evaluate(estimate(), (8, 8), fence=fence, stops=slow, margin_m=0.25)
    bounds = Boundaries(FOOTPRINT, fence)
    expected = integrated(estimate(), EXACT, (0, 0), (8, 8), slow, slow.response_s, 1.0)
    deepest = expected[bounds.clearance_m(expected).argmin()]
    assert bounds.clearance_m(expected[-1:])[0] > 0.0
    assert found.verdict is FenceVerdict.STOPPED
    where = float(found.reason.partition("(")[2].partition(",")[0])
    assert where == pytest.approx(deepest[0], abs=0.12)


def test_the_spread_of_a_turn_counts_what_radius_and_axle_have_in_common_twice():
    both, alone = (
        evaluate(estimate(wheels=(1, 3)), (1, 3), fence=IN_CELL, geometry=one).clearance_m
        for one in (uncertain(0.01, 0.01, common=0.5 * 0.01**2), uncertain(radius=0.01))
    )
    assert both == pytest.approx(alone, abs=1e-12)
