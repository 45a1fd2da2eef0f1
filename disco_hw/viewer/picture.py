"""A picture or a clip of a log without a browser or a display: the page's top view and its main curves."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.animation import AbstractMovieWriter, FFMpegWriter, PillowWriter
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from disco_hw.errors import InputError
from disco_hw.fence.clearance import fence_outlines
from disco_hw.viewer import curves, scene
from disco_hw.viewer.area import fence_in_force, obstacle_outlines, stopping_outlines
from disco_hw.viewer.curves import WINDOW_NS, Curves
from disco_hw.viewer.recording import ParameterPoints, Recording, ShownRobot, Snapshot, model_in_force
from disco_hw.viewer.scene import Scene
from disco_hw.viewer.server import serving
from disco_hw.viewer.timeline import Timeline

Array = NDArray[np.float64]
# Chosen: smooth enough for a robot, and small as a file.
FRAMES_PER_S = 10
# Chosen: a picture is looked at closely, a clip must be small.
_PICTURE_DPI = 110
_CLIP_DPI = 70
# Chosen: a longer clip takes minutes to draw; a higher speed makes it shorter.
_LONGEST_S = 600.0
# All pictures of these formats are held until the last one is drawn, about 1 MB each.
_LONGEST_IN_MEMORY_S = 60.0
_CLIP_FORMATS = {".gif": "gif", ".webp": "webp", ".apng": "apng", ".mp4": "mp4"}
Progress = Callable[[float], None]


def draw_picture(recording: Recording, t_s: float, path: Path) -> None:
    """Write the instant at `t_s` as PNG (or what the file's ending says); raises InputError for an unknown ending."""
    figure = _figure()
    supported = figure.canvas.get_supported_filetypes()
    if path.suffix.lstrip(".").lower() not in supported:
        raise InputError(f"{path}: no such kind of picture; end the name in .png, .svg or .pdf")
    _draw(figure, recording, t_s)
    figure.savefig(path, dpi=_PICTURE_DPI)


def draw_clip(recording: Recording, path: Path, speed: float, progress: Progress) -> None:
    """Write the whole log as a clip of 10 pictures a second, `speed` times as fast as it was.

    .gif, .webp and .apng need nothing, and may be a minute long; .mp4 needs ffmpeg, and may be ten. `progress` gets the
    part done. Raises InputError for another ending, a missing ffmpeg, or a longer clip.
    """
    writer = _writer(path)
    length_s = recording.duration_s / speed
    longest_s = _LONGEST_IN_MEMORY_S if isinstance(writer, PillowWriter) else _LONGEST_S
    if length_s > longest_s:
        raise InputError(f"{path}: the clip would take {length_s:.0f} s; raise --speed to at least "
                         f"{math.ceil(recording.duration_s / longest_s)}")  # fmt: skip
    figure = _figure()
    count = max(1, round(length_s * FRAMES_PER_S))
    with writer.saving(figure, str(path), _CLIP_DPI):
        for number in range(count + 1):
            figure.clear()
            _draw(figure, recording, recording.duration_s * number / count)
            writer.grab_frame()
            progress(number / count)


def _writer(path: Path) -> AbstractMovieWriter:
    ending = path.suffix.lower()
    if ending not in _CLIP_FORMATS:
        raise InputError(f"{path}: no such kind of clip; end the name in {', '.join(_CLIP_FORMATS)}")
    if ending != ".mp4":
        return PillowWriter(fps=FRAMES_PER_S)
    encoder = _ffmpeg()
    if encoder is None:
        raise InputError(
            f"{path}: writing .mp4 needs ffmpeg; install it, or pip install 'disco-hw[video]', or end the name in .webp"
        )
    writer = FFMpegWriter(fps=FRAMES_PER_S)
    # What matplotlib would look for in a setting that all figures of the process share.
    writer.bin_path = lambda: encoder  # type: ignore[method-assign]
    return writer


def _ffmpeg() -> str | None:
    """Return the system's ffmpeg, or else the one of the extra `video`."""
    found = shutil.which("ffmpeg")
    if found is not None:
        return found
    try:
        from imageio_ffmpeg import get_ffmpeg_exe  # noqa: PLC0415
    except ImportError:
        return None
    try:
        return str(get_ffmpeg_exe())
    except RuntimeError:
        return None


def _figure() -> Figure:
    return Figure(figsize=(11.2, 6.4))


def _draw(figure: Figure, recording: Recording, t_s: float) -> None:
    snapshot, stage, timeline = recording.at(t_s), recording.stage, recording.timeline
    grid = figure.add_gridspec(
        3, 2, width_ratios=(1.6, 1.0), left=0.07, right=0.98, bottom=0.08, top=0.95, hspace=0.4, wspace=0.12
    )
    top = figure.add_subplot(grid[:, 0])
    _draw_scene(top, snapshot, stage)
    top.set_title(f"{stage.name}, {(snapshot.t_ns - recording.first_ns) * 1e-9:.2f} s", loc="left")
    task = stage.task_at(snapshot.task)
    cuts: tuple[tuple[str, Callable[[Timeline, int, int], Curves]], ...] = (
        (f"distance to the {task.course().noun} (m)", partial(curves.distance, task)),
        ("speed (m/s)", partial(curves.speed, task, drives_backwards=stage.drives_backwards)),
        ("wheels (rad/s)", curves.wheels),
    )
    for row, (title, cut) in enumerate(cuts):
        axes = figure.add_subplot(grid[row, 1])
        found = cut(timeline, snapshot.t_ns - WINDOW_NS, snapshot.t_ns)
        for name, values in found.values.items():
            axes.plot(found.t_s, values, linewidth=1.0, label=name)
        axes.set_title(title, loc="left", fontsize=9)
        axes.tick_params(labelsize=8)
        axes.grid(alpha=0.3)
        if len(found.values) > 1:
            axes.legend(fontsize=7, loc="lower right", ncols=2)


def _draw_scene(axes: Axes, snapshot: Snapshot, stage: ShownRobot) -> None:
    course = stage.task_at(snapshot.task).course()
    axes.plot(*course.outline_m().T, color=_web("task"), linewidth=2.5)
    trail = snapshot.trail
    if len(trail) >= 2:
        colours = scene.distance_colours(course.off_m(trail), scene.TRAIL_FULL_M) / 255.0
        axes.add_collection(LineCollection(list(np.stack((trail[:-1], trail[1:]), axis=1)), colors=colours[1:], lw=1.5))
    if len(snapshot.poses):
        axes.plot(*snapshot.poses[:, :2].T, ".", color=_web("poses"), markersize=3)
    if snapshot.fan is not None:
        paths = scene.fan_paths(snapshot.fan.weights, snapshot.fan.x_m, snapshot.fan.y_m)
        shades = scene.weight_colours(snapshot.fan.weights, scene.LAYERS["fan"].colour, scene.FAN_PALEST) / 255.0
        for path, shade in zip(paths[::-1], shades[::-1], strict=True):
            axes.plot(*path.T, color=tuple(shade), linewidth=1.2)
    if snapshot.plan is not None:
        points = ParameterPoints(model_in_force(stage.model, snapshot.belief))
        for path in points.trajectories(snapshot.plan, snapshot.wheel_speeds or (0.0, 0.0)):
            axes.plot(*path.T, color=_web("points"), linewidth=0.8)
        axes.plot(snapshot.plan.path_x_m, snapshot.plan.path_y_m, color=_web("plan"), linewidth=2.0)
    if snapshot.pose is not None:
        body, nose = _outline(snapshot.pose, stage.axial_distance_m)
        axes.fill(*body.T, color=_web("robot"), alpha=0.8)
        axes.fill(*nose.T, color="gold")
        for line in stopping_outlines(snapshot.guard, stage.footprint):
            axes.plot(*line.T, color=_web("stop"), linewidth=1.2)
        ellipse = scene.ellipse_points(*snapshot.pose[:2], snapshot.covariance[:2, :2])
        axes.plot(*ellipse.T, color=_web("ellipse"), linewidth=1.2)
    for line in fence_outlines(fence_in_force(stage.fence, snapshot.fence)):
        axes.plot(*line.T, color=_web("fence"), linewidth=1.6)
    for line in obstacle_outlines(snapshot.guard):
        axes.fill(*line.T, color=_web("obstacles"), alpha=0.6)
    (x_m, y_m), reach = course.middle_m, 1.5 * course.reach_m + 0.3
    axes.set(
        xlim=(x_m - reach, x_m + reach),
        ylim=(y_m - reach, y_m + reach),
        aspect="equal", xlabel="x (m)", ylabel="y (m)",
    )  # fmt: skip
    axes.grid(alpha=0.3)


def _outline(pose: tuple[float, float, float], size_m: float) -> tuple[Array, Array]:
    """Corners (4, 2) of the body and (3, 2) of its nose in the world."""
    x_m, y_m, yaw_rad = pose
    turn = np.array(((math.cos(yaw_rad), math.sin(yaw_rad)), (-math.sin(yaw_rad), math.cos(yaw_rad))))
    body = size_m * np.array(((0.62, 0.5), (-0.62, 0.5), (-0.62, -0.5), (0.62, -0.5)))
    nose = size_m * np.array(((0.62, 0.0), (0.4, 0.2), (0.4, -0.2)))
    return body @ turn + (x_m, y_m), nose @ turn + (x_m, y_m)


def _web(layer: str) -> str:
    """Return the colour of a layer as matplotlib takes it."""
    return "#{:02x}{:02x}{:02x}".format(*scene.LAYERS[layer].colour)


# Chosen: as above, for the page that is written to a file.
PICTURES_PER_S = 10
# Chosen: what costs more to draw, twice a second.
_REDRAW_PICTURES = 5
# Ten minutes of them: of a longer log fewer a second, as a browser holds them all.
_MOST_PICTURES = 6000


def export_html(recording: Recording, path: Path, progress: Progress) -> None:
    """Write the scene of the whole log, 10 pictures a second and at most 6000 of them, with a clock; no plots.

    `progress` gets the part done. Raises InputError if the file cannot be written.
    """
    count = min(max(1, math.ceil(recording.duration_s * PICTURES_PER_S)), _MOST_PICTURES)
    period_s = recording.duration_s / count
    # Serialising needs a server; nobody can reach this one but from this machine, and it is gone at the end.
    with serving(path.name, port=0) as page:
        scene = Scene(page.server, recording.stage)
        clock = page.server.scene.add_label("/clock", "0.0 s", position=_clock_place(recording))
        serializer = page.server.get_scene_serializer()
        for number in range(count + 1):
            t_s = number * period_s
            scene.show(recording.at(t_s), everything=number % _REDRAW_PICTURES == 0)
            clock.text = f"{t_s:.1f} s"
            serializer.insert_sleep(period_s)
            progress(number / count)
        text = serializer.as_html()
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); give another name") from None


def _clock_place(recording: Recording) -> tuple[float, float, float]:
    course = recording.stage.task.course()
    x_m, y_m = course.middle_m
    return (x_m, y_m + 1.2 * course.reach_m, 0.2)
