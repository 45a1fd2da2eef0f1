"""Fence and footprint as robot.toml describes them, where the robot may be, and what is wrong with them.

Plain numbers without arrays, because robot.toml is read before anything heavy is imported. `disco_hw.fence.clearance`
computes distances. Metres in the pose frame.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Protocol

import msgspec
from msgspec import Meta

from disco_hw.errors import FieldFault
from drivers.samples import FARTHEST_M

Point = tuple[float, float]
Polygon = Annotated[tuple[Point, ...], Meta(max_length=128)]
# Chosen: a longer robot is centimetres read as metres.
_LONGEST_FOOTPRINT_M = 20.0
# Chosen: shorter edges are one point, written twice, and have no direction.
_SHORTEST_EDGE_M = 1e-3
# Chosen: each shape and corner takes time of every tick.
MOST_KEEP_OUT, MOST_CORNERS = 32, 256


class Circle(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A circle on the ground."""

    center: Point
    radius_m: Annotated[float, Meta(gt=0.0, le=FARTHEST_M)]


Shape = Polygon | Circle


class Footprint(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The rectangle that the robot covers (m); its centre lies `ahead` of the tracked point."""

    length: Annotated[float, Meta(gt=0.0, le=_LONGEST_FOOTPRINT_M)]
    width: Annotated[float, Meta(gt=0.0, le=_LONGEST_FOOTPRINT_M)]
    ahead: Annotated[float, Meta(ge=-_LONGEST_FOOTPRINT_M, le=_LONGEST_FOOTPRINT_M)] = 0.0

    @property
    def reach_m(self) -> float:
        """Distance from the tracked point to the farthest corner."""
        return math.hypot(abs(self.ahead) + 0.5 * self.length, 0.5 * self.width)

    @property
    def turned(self) -> Footprint:
        """Footprint of the robot with its back called its front."""
        return Footprint(self.length, self.width, -self.ahead)

    def corners_m(self) -> tuple[Point, Point, Point, Point]:
        """Return the corners relative to the tracked point, ahead and to the left, in counter-clockwise order."""
        back, front, side = self.ahead - 0.5 * self.length, self.ahead + 0.5 * self.length, 0.5 * self.width
        return (back, -side), (front, -side), (front, side), (back, side)


class Fence(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Section [fence] of robot.toml: where the whole footprint must stay, and where no part of it may be.

    Within `margin_m` of the fence commands that lead towards it are scaled. `max_breach_probability`: of a plan over
    its horizon. `obstacles_port`: UDP port on which obstacles are reported, also by the
    bridge to ROS 2; None takes no reports.
    """

    keep_in: Shape | None = None
    keep_out: Annotated[tuple[Shape, ...], Meta(max_length=MOST_KEEP_OUT)] = ()
    margin_m: Annotated[float, Meta(ge=0.0, le=5.0)] = 0.05
    max_breach_probability: Annotated[float, Meta(gt=0.0, le=0.5)] = 1e-3
    obstacles_address: str = "127.0.0.1"
    obstacles_port: Annotated[int, Meta(ge=1, le=65535)] | None = None

    @property
    def is_set(self) -> bool:
        """Whether there is any boundary at all."""
        return self.keep_in is not None or bool(self.keep_out)


class WheelGeometry(Protocol):
    """Geometry from which the usual footprint is made; [robot] of robot.toml has it."""

    @property
    def wheel_radius_m(self) -> float:
        """Nominal radius of the wheels."""

    @property
    def axial_distance_m(self) -> float:
        """Nominal distance between left and right wheels."""

    @property
    def x_icr_m(self) -> float:
        """Distance (m) from the tracked point forward to the point about which the robot turns."""


def usual_footprint(robot: WheelGeometry) -> Footprint:
    """Return a footprint guessed from the wheels, for a robot.toml without `robot.footprint_m`.

    As wide as the wheels with half a radius on each side, as long as wide and a wheel's radius at both ends, around
    the point about which the robot turns.
    """
    width = robot.axial_distance_m + robot.wheel_radius_m
    return Footprint(robot.axial_distance_m + 2.0 * robot.wheel_radius_m, width, robot.x_icr_m)


def fence_fault(fence: Fence, footprint: Footprint) -> FieldFault | None:
    """Return the first fault of a fence that no single number shows; None if it is sound."""
    shapes = [("keep_in", fence.keep_in)] if fence.keep_in is not None else []
    shapes += [(f"keep_out[{number}]", shape) for number, shape in enumerate(fence.keep_out)]
    for field, shape in shapes:
        found = _shape_fault(shape)
        if found is not None:
            return FieldFault(field, *found)
    corners = sum(len(shape) for _, shape in shapes if not isinstance(shape, Circle))
    if corners > MOST_CORNERS:
        return FieldFault("keep_out", f"{corners} corners in all are too many", f"write at most {MOST_CORNERS}")
    if fence.keep_in is not None and not _can_hold(fence.keep_in, footprint):
        size = f"{footprint.length:g} m x {footprint.width:g} m"
        fault = f"too small for the robot, whose footprint is {size}"
        return FieldFault(
            "keep_in", fault, "write metres in the pose frame (not km or degrees), or correct footprint_m"
        )
    return None


def _shape_fault(shape: Shape) -> tuple[str, str] | None:
    points = (shape.center,) if isinstance(shape, Circle) else shape
    for number, point in enumerate(points):
        if not all(map(math.isfinite, point)):
            return f"point {number} is not a finite number", "write a finite value"
        if max(map(abs, point)) > FARTHEST_M:
            x, y = point
            fault = f"point {number} at ({x:g}, {y:g}) is over {FARTHEST_M:g} m from the origin"
            return fault, "write metres in the pose frame (not mm or map coordinates)"
    return None if isinstance(shape, Circle) else _polygon_fault(shape)


def _polygon_fault(points: Sequence[Point]) -> tuple[str, str] | None:
    count = len(points)
    if count < 3:
        return (
            f"{count} points make no polygon",
            "write three or more, or a circle as { center = [x, y], radius_m = r }",
        )
    edges = [(points[k], points[(k + 1) % count]) for k in range(count)]
    for k, (begin, end) in enumerate(edges):
        if math.dist(begin, end) < _SHORTEST_EDGE_M:
            x, y = begin
            return f"points {k} and {(k + 1) % count} are the same, ({x:g}, {y:g})", "leave one of them out"
    for k in range(count):
        for j in range(k + 1, count):
            if j - k in (1, count - 1):
                # Neighbours share a point, and overlap if one leads straight back over the other.
                first, second = (edges[k], edges[j]) if j - k == 1 else (edges[j], edges[k])
                if not _leads_back(*first, second[1]):
                    continue
                crossing = second[0]
            elif (found := _meeting(*edges[k], *edges[j])) is None:
                continue
            else:
                crossing = found
            where = f"crosses itself near ({crossing[0]:.2f}, {crossing[1]:.2f})"
            pair = f"edges {k} and {j}"
            return f"{where}: {pair}", "list the corners in the order in which one walks along the fence"
    return None


def _cross(origin: Point, first: Point, second: Point) -> float:
    return (first[0] - origin[0]) * (second[1] - origin[1]) - (first[1] - origin[1]) * (second[0] - origin[0])


def _leads_back(begin: Point, corner: Point, end: Point) -> bool:
    """Whether the way goes from `corner` straight back where it came from."""
    dot = (begin[0] - corner[0]) * (end[0] - corner[0]) + (begin[1] - corner[1]) * (end[1] - corner[1])
    return dot > 0.0 and abs(_cross(corner, begin, end)) <= 1e-9 * dot


def _meeting(a: Point, b: Point, c: Point, d: Point) -> Point | None:
    """Return a point that the segments a-b and c-d have in common; None if there is none."""
    c_side, d_side = _cross(a, b, c), _cross(a, b, d)
    a_side, b_side = _cross(c, d, a), _cross(c, d, b)
    if c_side * d_side < 0.0 and a_side * b_side < 0.0:
        part = a_side / (a_side - b_side)
        return a[0] + part * (b[0] - a[0]), a[1] + part * (b[1] - a[1])
    on_other = ((c_side, c, a, b), (d_side, d, a, b), (a_side, a, c, d), (b_side, b, c, d))
    return next((point for side, point, p, q in on_other if side == 0.0 and _in_box(point, p, q)), None)


def _in_box(point: Point, p: Point, q: Point) -> bool:
    return all(min(p[k], q[k]) <= point[k] <= max(p[k], q[k]) for k in (0, 1))


def _can_hold(shape: Shape, footprint: Footprint) -> bool:
    """Whether the footprint may fit into a shape: by the circle, or by the polygon's box and area."""
    if isinstance(shape, Circle):
        return 2.0 * shape.radius_m >= math.hypot(footprint.length, footprint.width)
    across = [max(point[k] for point in shape) - min(point[k] for point in shape) for k in (0, 1)]
    return (
        min(across) >= min(footprint.length, footprint.width) and area_m2(shape) >= footprint.length * footprint.width
    )


def area_m2(points: Sequence[Point]) -> float:
    """Area of a polygon that does not cross itself."""
    return abs(0.5 * sum(_cross((0.0, 0.0), points[k - 1], points[k]) for k in range(len(points))))
