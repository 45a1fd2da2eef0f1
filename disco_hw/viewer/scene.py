"""3D scene of the viewer: draws a snapshot's robot, task, trail, plan, rollouts and fence in the world.

Live page, replay and export share it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import viser
from numpy.typing import NDArray

from disco_hw.fence.clearance import circle_outline, fence_outlines
from disco_hw.log import records
from disco_hw.tasks import RobotTask
from disco_hw.viewer.area import fence_in_force, obstacle_outlines, stopping_outlines
from disco_hw.viewer.recording import ParameterPoints, ShownRobot, Snapshot, model_in_force

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]
Point = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Layer:
    """Layer of the scene: what the legend calls it, its colour (red, green, blue), and its lines' width in pixels."""

    label: str
    colour: tuple[int, int, int]
    width_px: float = 0.0


# Chosen: colours apart from one another on the light and the dark ground. Widths are in pixels, and the grid is of
# lines instead of the library's own: where no graphics card draws, a line of a width in metres is drawn twice by a dear
# shader, and grid, shadows and environment map cost ten times as much as all else together.
LAYERS = {
    "task": Layer("Task", (40, 110, 230), 3.5),
    "robot": Layer("Robot", (200, 60, 160)),
    "trail": Layer("Driven trail", (68, 33, 253), 4.0),
    "plan": Layer("Planned trajectory", (250, 140, 0), 3.5),
    "fan": Layer("Sampled rollouts by weight", (0, 105, 125), 1.5),
    "points": Layer("Plan under sigma points", (150, 110, 200), 1.5),
    "ellipse": Layer("95 % of the position", (120, 40, 200), 2.0),
    "poses": Layer("Measured poses, 3 s", (125, 125, 132), 2.5),
    "centre": Layer("Turning centre (ICR)", (0, 0, 0), 1.5),
    "fence": Layer("Fence", (190, 30, 30), 3.0),
    "obstacles": Layer("Obstacles", (225, 95, 20), 3.0),
    "stop": Layer("Stopping path and footprint", (20, 140, 60), 2.0),
}
_WHEEL_COLOUR = (45, 45, 50)
_GRID_PX = 1.5
TRAIL_FULL_M = 0.1
"""Distance to the task at which the trail is wholly yellow."""
# What lies on the floor, from below: a trail of many laps must hide neither the task nor the rollouts.
_FENCE_M = 0.004
_TRAIL_M, _POSES_M, _TASK_M, _FAN_M, _POINTS_M, _PLAN_M = 0.002, 0.003, 0.005, (0.0095, 0.007), 0.011, 0.013
TRAIL_PALEST = 0.12
_TRAIL_REACHES = 10.0
"""The trail is palest this many times the task's reach behind the robot: a lap and a half of a circle."""
LIGHT, DARK = (255.0, 255.0, 255.0), (20.0, 20.0, 24.0)
_CENTRE_LIMIT_M = 5.0
FAN_PALEST = 0.12
_NO_LINES: Array = np.empty((0, 2, 3))
_WHEEL_PARTS = (("front", 0.5), ("rear", -0.5))
_GRID_LIGHT, _GRID_DARK = ((236, 236, 236), (190, 190, 190)), ((40, 40, 46), (76, 76, 84))
_CENTRE_IN_THE_DARK = (225, 225, 225)
_TRAIL_STEP, _OLD_TRAIL_STEP = 0.05, 0.2
"""Between two points of the trail that are drawn, in the task's reach: chords of a circle are off by 0.03 %, .5 %."""


def first_camera(task: RobotTask) -> tuple[Point, Point]:
    """Return the initial position and target of the page's camera: all of the task, from the south and above."""
    course = task.course()
    (x_m, y_m), away = course.middle_m, 0.8 + 1.1 * course.reach_m
    return (x_m - 0.35 * away, y_m - 0.9 * away, 1.25 * away), (x_m, y_m, 0.0)


class Scene:
    """Draws snapshots on a viser server; `layers` says which of LAYERS are shown.

    Without `knows_task` the task is not drawn: a wrong line would be worse than none.
    `show` moves what moves in every call and redraws long lines only where `everything` is True.
    """

    def __init__(self, server: viser.ViserServer, stage: ShownRobot) -> None:
        self.layers = dict.fromkeys(LAYERS, True)
        self.knows_task = True
        self.background = LIGHT
        self._server = server
        self._stage = stage
        self._points = ParameterPoints(stage.model)
        self._belief: records.BeliefChange | None = None
        self._wheel_radius = max(stage.wheel_radius_m, 0.01)
        self._add_ground()
        self._robot, self._wheels = self._add_robot()
        empty, shades = np.zeros((1, 2, 3)), np.zeros((1, 2, 3), np.uint8)
        self._lines = {
            name: add_lines(server, name, empty, shades if name in ("trail", "fan") else layer.colour, layer.width_px)
            for name, layer in LAYERS.items()
            if name not in ("task", "robot")
        }
        self._shown_fan: tuple[records.Fan, tuple[float, ...]] | None = None

    def show(self, snapshot: Snapshot, everything: bool = True) -> None:
        """Draw one snapshot of a drive; without `everything` leave plan, rollouts, trail, poses, points and fence."""
        layers = self.layers
        with self._server.atomic():
            self._shade()
            self._draw_task(self._stage.task_at(snapshot.task))
            self._task.visible = layers["task"] and self.knows_task
            self._robot.visible = layers["robot"] and snapshot.pose is not None
            if snapshot.pose is not None:
                x_m, y_m, yaw_rad = snapshot.pose
                self._robot.position = (x_m, y_m, 0.0)
                self._robot.wxyz = about_z(yaw_rad)
            for wheel, angle_rad in zip(self._wheels, snapshot.wheel_angles * 2, strict=True):
                wheel.wxyz = about_y(angle_rad)
            self._draw("ellipse", self._ellipse(snapshot))
            self._draw("centre", self._centre(snapshot))
            self._draw("obstacles", _outlines(obstacle_outlines(snapshot.guard)))
            self._draw("stop", _outlines(stopping_outlines(snapshot.guard, self._stage.footprint)))
            if not everything:
                return
            plan = snapshot.plan
            path = np.empty((0, 2)) if plan is None else np.column_stack((plan.path_x_m, plan.path_y_m))
            self._draw("plan", segments(path, _PLAN_M))
            self._draw("points", self._points_paths(snapshot))
            self._draw("poses", _pose_marks(snapshot.poses))
            self._draw("fence", _outlines(fence_outlines(fence_in_force(self._stage.fence, snapshot.fence))))
            self._draw_fan(snapshot.fan)
            self._draw_trail(snapshot)

    def _add_ground(self) -> None:
        task, scene = self._stage.task, self._server.scene
        course = task.course()
        size_m = max(4.0, 2.0 * math.ceil(1.5 * course.reach_m + 1.0))
        scene.set_up_direction("+z")
        scene.configure_default_lights(cast_shadow=False)
        scene.configure_environment_map(None)
        scene.add_light_ambient("/ambient", intensity=1.6)
        cells, sections = grid_lines(course.middle_m, size_m, 0.1 if size_m <= 4.0 else 0.5)
        self._grid = [
            add_lines(self._server, name, lines, colour, _GRID_PX, visible=True)
            for name, lines, colour in zip(("cells", "ground"), (cells, sections), _GRID_LIGHT, strict=True)
        ]
        self._shaded = LIGHT
        self._task = add_lines(
            self._server, "task", _line(task), LAYERS["task"].colour, LAYERS["task"].width_px, visible=True
        )
        self._shown_task = task
        camera = self._server.initial_camera
        camera.position, camera.look_at = first_camera(task)

    def _add_robot(self) -> tuple[viser.FrameHandle, list[viser.FrameHandle]]:
        scene, radius = self._server.scene, self._wheel_radius
        length = width = self._stage.axial_distance_m
        robot = scene.add_frame("/robot", show_axes=False, visible=False)
        scene.add_box(
            "/robot/body",
            color=LAYERS["robot"].colour,
            cast_shadow=False,
            dimensions=(1.25 * length, 0.75 * width, radius),
            position=(0.0, 0.0, 1.5 * radius),
        )
        # The nose, so that forward can be told from backward.
        scene.add_box(
            "/robot/nose",
            color=(255, 220, 60),
            cast_shadow=False,
            dimensions=(0.15 * length, 0.3 * width, 0.5 * radius),
            position=(0.55 * length, 0.0, 2.1 * radius),
        )
        wheels = []
        for part, along in _WHEEL_PARTS:
            for side, across in (("left", 0.5), ("right", -0.5)):
                name = f"/robot/{part}_{side}"
                wheel = scene.add_frame(name, show_axes=False, position=(along * length, across * width, radius))
                scene.add_cylinder(
                    f"{name}/tyre",
                    radius=radius,
                    height=0.6 * radius,
                    color=_WHEEL_COLOUR,
                    cast_shadow=False,
                    wxyz=(math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0),
                )
                scene.add_box(
                    f"{name}/spoke",
                    color=(235, 235, 235),
                    cast_shadow=False,
                    dimensions=(1.7 * radius, 0.66 * radius, 0.25 * radius),
                )
                wheels.append(wheel)
        return robot, wheels

    def _draw(self, layer: str, lines: Array, colours: Bytes | None = None) -> None:
        """Replace the lines of a layer, and the colours (N, 2, 3) of their ends; hide it if it is off or has none."""
        node = self._lines[layer]
        if self.layers[layer] and len(lines):
            node.points = lines.astype(np.float32)
            if colours is not None:
                node.colors = colours
            node.visible = True
        elif node.visible:
            node.visible = False

    def _shade(self) -> None:
        """Recolour grid and turning centre if the background changed between light and dark."""
        if self.background != self._shaded:
            self._shaded = self.background
            colours = _GRID_DARK if self.background == DARK else _GRID_LIGHT
            for lines, colour in zip(self._grid, colours, strict=True):
                lines.colors = np.array(colour, np.uint8)
            centre = _CENTRE_IN_THE_DARK if self.background == DARK else LAYERS["centre"].colour
            self._lines["centre"].colors = np.array(centre, np.uint8)

    def _draw_task(self, task: RobotTask) -> None:
        if task != self._shown_task:
            self._task.points = _line(task).astype(np.float32)
            self._shown_task = task

    def _draw_fan(self, fan: records.Fan | None) -> None:
        paths = np.empty((0, 0, 2))
        if fan is not None and self.layers["fan"]:
            paths = fan_paths(fan.weights, fan.x_m, fan.y_m)
        if fan is None or not len(paths):
            self._shown_fan = None
            self._draw("fan", _NO_LINES)
            return
        if (fan, self.background) == self._shown_fan:
            return
        self._shown_fan = fan, self.background
        colours = weight_colours(fan.weights, LAYERS["fan"].colour, FAN_PALEST, self.background)
        # The weightiest on top of the others.
        heights = np.linspace(*_FAN_M, len(paths))
        lines = [segments(path, height) for path, height in zip(paths, heights, strict=True)]
        shades = np.repeat(np.repeat(colours[:, None], paths.shape[1] - 1, axis=0), 2, axis=1)
        self._draw("fan", np.concatenate(lines), shades)

    def _draw_trail(self, snapshot: Snapshot) -> None:
        if not self.layers["trail"] or len(snapshot.trail) < 2:
            self._draw("trail", _NO_LINES)
            return
        course = self._stage.task_at(snapshot.task).course()
        trail = sparse(snapshot.trail, course.reach_m)
        near = distance_colours(course.off_m(trail), TRAIL_FULL_M)
        colours = faded(near, trail, _TRAIL_REACHES * course.reach_m, self.background)
        self._draw("trail", segments(trail, _TRAIL_M), np.stack((colours[:-1], colours[1:]), axis=1))

    def _ellipse(self, snapshot: Snapshot) -> Array:
        if snapshot.pose is None:
            return _NO_LINES
        points = ellipse_points(snapshot.pose[0], snapshot.pose[1], snapshot.covariance[:2, :2])
        return segments(points, 3.5 * self._wheel_radius)

    def _centre(self, snapshot: Snapshot) -> Array:
        """Return a ray from the robot to its instantaneous centre of rotation, and a cross there."""
        centre = None
        if snapshot.pose is not None:
            centre = instant_centre(
                snapshot.pose, snapshot.speed_m_s, snapshot.yaw_rate_rad_s, self._stage.x_icr_m, _CENTRE_LIMIT_M
            )
        if snapshot.pose is None or centre is None:
            return _NO_LINES
        ray = segments(np.array((snapshot.pose[:2], centre)), 0.01)
        cross = [_strokes(np.array((centre,)), np.array((0.04, across)), 0.01) for across in (0.04, -0.04)]
        return np.concatenate((ray, *cross))

    def _points_paths(self, snapshot: Snapshot) -> Array:
        """Return the trajectories of the plan under the sigma points of the model's parameters."""
        if snapshot.plan is None or snapshot.pose is None or not self.layers["points"]:
            return _NO_LINES
        if snapshot.belief is not self._belief:
            self._points = ParameterPoints(model_in_force(self._stage.model, snapshot.belief))
            self._belief = snapshot.belief
        wheels = snapshot.wheel_speeds or (0.0, 0.0)
        paths = self._points.trajectories(snapshot.plan, wheels)
        return np.concatenate([segments(path, _POINTS_M) for path in paths]) if len(paths) else _NO_LINES


def add_lines(
    server: viser.ViserServer,
    name: str,
    lines: Array,
    colours: tuple[int, int, int] | Bytes,
    width_px: float,
    visible: bool = False,
) -> viser.LineSegmentsHandle:
    """Line segments (N, 2, 3) m of one width on the screen, whatever the distance."""
    return server.scene.add_line_segments(
        f"/{name}", lines, colours, thickness=width_px, thickness_units="screen", visible=visible
    )


def grid_lines(middle_m: tuple[float, float], size_m: float, cell_m: float) -> tuple[Array, Array]:
    """Lines (N, 2, 3) of a square on the floor: every `cell_m`, and every metre, which the first leave out."""
    reach = 0.5 * size_m
    offsets = np.arange(round(size_m / cell_m) + 1) * cell_m - reach
    at_metre = np.abs(offsets - np.round(offsets)) < 1e-9

    def lines(offsets: Array) -> Array:
        along, ends = np.repeat(offsets[:, None], 2, axis=1), np.tile((-reach, reach), (len(offsets), 1))
        both = np.concatenate((np.stack((along, ends), axis=-1), np.stack((ends, along), axis=-1))) + middle_m
        return np.concatenate((both, np.zeros((*both.shape[:2], 1))), axis=-1)

    return lines(offsets[~at_metre]), lines(offsets[at_metre])


def sparse(trail: Array, reach_m: float) -> Array:
    """Return the points (N, 2) of a trail worth drawing, with both ends: by distance, fewer where it is palest.

    A growing trail keeps the points it has, but for those that fall behind.
    """
    driven_m = np.append(0.0, np.cumsum(np.hypot(*np.diff(trail, axis=0).T)))
    old = driven_m[-1] - driven_m > _TRAIL_REACHES * reach_m
    mark = np.floor(driven_m / (_TRAIL_STEP * reach_m))
    mark[old] = np.floor(driven_m[old] / (_OLD_TRAIL_STEP * reach_m)) * (_OLD_TRAIL_STEP / _TRAIL_STEP)
    kept = np.append(True, np.diff(mark) > 0.0)
    kept[-1] = True
    return np.asarray(trail[kept])


def _outlines(lines: list[Array]) -> Array:
    """Join polylines (N, 2) on the floor into one array of line segments."""
    return np.concatenate([segments(line, _FENCE_M) for line in lines]) if lines else _NO_LINES


def _line(task: RobotTask) -> Array:
    return segments(task.course().outline_m(), _TASK_M)


def _pose_marks(poses: Array) -> Array:
    """Return a short stroke along the heading for each measured pose (N, 3); along x if the heading is NaN."""
    poses = np.nan_to_num(poses, nan=0.0)
    return _strokes(poses[:, :2], 0.03 * np.stack((np.cos(poses[:, 2]), np.sin(poses[:, 2])), axis=1), _POSES_M)


def _strokes(points: Array, arms_m: Array, height_m: float) -> Array:
    """Return a stroke through each point (N, 2), as long to either side as its arm (N, 2) or (2,), as (N, 2, 3)."""
    ends = np.stack((points - arms_m, points + arms_m), axis=1)
    return np.concatenate((ends, np.full((*ends.shape[:2], 1), height_m)), axis=-1)


ELLIPSE_95 = 5.991464547107979
"""Squared Mahalanobis radius that holds 95 % of a Gaussian over the plane."""


def ellipse_points(x_m: float, y_m: float, covariance: Array) -> Array:
    """Points (N, 2) on the 95 % ellipse of a position with this covariance (2, 2) m^2; (0, 2) if it is none."""
    if not np.all(np.isfinite(covariance)):
        return np.empty((0, 2))
    variances, axes = np.linalg.eigh(0.5 * (covariance + covariance.T))
    if variances[0] < 0.0:
        return np.empty((0, 2))
    circle = circle_outline(0.0, 0.0, math.sqrt(ELLIPSE_95))
    return np.asarray((circle * np.sqrt(variances)) @ axes.T + (x_m, y_m))


def segments(points: Array, height_m: float) -> Array:
    """Line segments (N - 1, 2, 3) along points (N, 2) at one height."""
    lifted = np.column_stack((points, np.full(len(points), height_m)))
    return np.stack((lifted[:-1], lifted[1:]), axis=1)


def distance_colours(distance_m: Array, full_m: float) -> Bytes:
    """Colours (N, 3) by distance to the task: purple on it, teal at half of `full_m`, yellow at it and beyond.

    They differ in brightness too, so that everybody can tell them apart.
    """
    part = np.clip(np.abs(distance_m) / full_m, 0.0, 1.0)
    ramps = ((68.0, 33.0, 253.0), (1.0, 145.0, 200.0), (84.0, 140.0, 30.0))
    return np.stack([np.interp(part, (0.0, 0.5, 1.0), ramp) for ramp in ramps], axis=1).astype(np.uint8)


def fan_paths(weights: Sequence[float], x_m: Sequence[float], y_m: Sequence[float]) -> Array:
    """Paths (n, points, 2) of a fan that is recorded one path after the other; (0, 0, 2) if it does not divide."""
    count = len(weights)
    if not count or len(x_m) % count or len(x_m) != len(y_m) or len(x_m) < 2 * count:
        return np.empty((0, 0, 2))
    return np.stack((np.reshape(x_m, (count, -1)), np.reshape(y_m, (count, -1))), axis=-1)


def faded(colours: Bytes, trail: Array, length_m: float, background: tuple[float, ...] = LIGHT) -> Bytes:
    """Return the colours (N, 3) of a trail (N, 2), which fade to the background with the distance behind its end."""
    steps_m = np.hypot(*np.diff(trail, axis=0).T)
    behind_m = np.append(np.cumsum(steps_m[::-1])[::-1], 0.0)
    part = np.clip(1.0 - behind_m / length_m, TRAIL_PALEST, 1.0)[:, None]
    return np.asarray(part * colours + (1.0 - part) * np.array(background), np.uint8)


def weight_colours(
    weights: Sequence[float], colour: tuple[int, int, int], palest: float, background: tuple[float, ...] = LIGHT
) -> Bytes:
    """Colours (n, 3) by share of the largest weight: `colour` for that one, near the `background` for the `palest`."""
    share = np.asarray(weights, np.float64)
    largest = share.max(initial=0.0)
    part = palest + (1.0 - palest) * (share / largest if largest > 0.0 else np.zeros_like(share))
    ground = np.array(background)
    return np.asarray(ground - part[:, None] * (ground - np.array(colour)), np.uint8)


def instant_centre(
    pose: tuple[float, float, float], speed_m_s: float, yaw_rate_rad_s: float, x_icr_m: float, farthest_m: float
) -> tuple[float, float] | None:
    """Return the centre of rotation in the world; None if it is not finite or farther away than `farthest_m`.

    In the body's frame it lies at (x_icr, v / omega): there the lateral velocity -omega x_icr of the tracked point and
    the forward one v are both undone.
    """
    if not (math.isfinite(speed_m_s) and abs(yaw_rate_rad_s) * farthest_m > abs(speed_m_s)):
        return None
    x_m, y_m, yaw_rad = pose
    forward, left = x_icr_m, speed_m_s / yaw_rate_rad_s
    return (
        x_m + forward * math.cos(yaw_rad) - left * math.sin(yaw_rad),
        y_m + forward * math.sin(yaw_rad) + left * math.cos(yaw_rad),
    )


def about_z(yaw_rad: float) -> tuple[float, float, float, float]:
    """Return unit quaternion (w, x, y, z) of a turn about the vertical."""
    return (math.cos(yaw_rad / 2.0), 0.0, 0.0, math.sin(yaw_rad / 2.0))


def about_y(angle_rad: float) -> tuple[float, float, float, float]:
    """Return unit quaternion (w, x, y, z) of a turn about the axle, positive as a wheel turns that drives forward."""
    return (math.cos(angle_rad / 2.0), 0.0, math.sin(angle_rad / 2.0), 0.0)
