"""Views of the scene: the legend with a box for each layer, the camera's views, and the bar of a replay."""

from __future__ import annotations

import html
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import viser

from disco_hw.runtime.robot_setup import with_values
from disco_hw.tasks import RobotTask
from disco_hw.viewer.scene import DARK, LAYERS, LIGHT, Point, Scene, first_camera, segments

# Chosen: as of what may be driven.
DRAFT_COLOUR = (0, 150, 60)
# Chosen: above the task's line, so that both are seen.
_DRAFT_M = 0.015
FREE, TOP, FOLLOW = "free", "top", "follow"
VIEWS = (FREE, TOP, FOLLOW)
# Of the bar in the page.
_BAR_HEIGHT_PX, _MARGIN_PX = 96.0, 12.0
# Looking straight down, no direction would be up on the screen.
_SOUTH_M = 0.01


def top_camera(task: RobotTask) -> tuple[Point, Point]:
    """Return position and target of a camera that looks at the whole task from above, north up."""
    course = task.course()
    x_m, y_m = course.middle_m
    return (x_m, y_m - _SOUTH_M, 1.0 + 2.2 * course.reach_m), (x_m, y_m, 0.0)


def moved(camera: tuple[Point, Point], looks_at: tuple[float, float]) -> tuple[Point, Point]:
    """Return the camera carried sideways until it looks at a place of the floor, from where it was beside that."""
    (x_m, y_m, z_m), (at_x, at_y, at_z) = camera
    to_x, to_y = looks_at
    return (x_m + to_x - at_x, y_m + to_y - at_y, z_m), (to_x, to_y, at_z)


class Views:
    """The choice of a view, for each browser its own: free, from the top, or following the robot as it drives."""

    def __init__(self, server: viser.ViserServer, task: RobotTask) -> None:
        self._task = task
        self._followers: set[int] = set()
        self._place: tuple[float, float] | None = None
        self._clients = server.get_clients
        choice = server.gui.add_button_group("View", VIEWS)

        @choice.on_click
        def _(event: Any) -> None:
            self.choose(event.client, event.target.value)

    def choose(self, client: viser.ClientHandle, view: str) -> None:
        """Look so from now on; a follower can still turn about the robot with the mouse."""
        self._followers.discard(client.client_id)
        if view == TOP:
            _look(client, top_camera(self._task))
        elif view == FREE:
            _look(client, first_camera(self._task))
        else:
            self._followers.add(client.client_id)
            if self._place is not None:
                _look(client, moved(_camera(client), self._place))

    def follow(self, pose: tuple[float, float, float] | None) -> None:
        """Move the camera with the robot, which is here now."""
        self._place = self._place if pose is None else pose[:2]
        if self._place is None or not self._followers:
            return
        clients = self._clients()
        for number in tuple(self._followers):
            if number in clients:
                _look(clients[number], moved(_camera(clients[number]), self._place))
            else:
                self._followers.discard(number)


def _camera(client: viser.ClientHandle) -> tuple[Point, Point]:
    x_m, y_m, z_m = map(float, client.camera.position)
    at_x, at_y, at_z = map(float, client.camera.look_at)
    return (x_m, y_m, z_m), (at_x, at_y, at_z)


def _look(client: viser.ClientHandle, camera: tuple[Point, Point]) -> None:
    with client.atomic():
        client.camera.position, client.camera.look_at = camera


def add_layers(server: viser.ViserServer, scene: Scene, changed: Callable[[], None]) -> None:
    """Add the legend, one checkbox a layer, and dark or light; `changed` is called after each click."""
    gui = server.gui
    with gui.add_folder("Legend and layers", expand_by_default=False):
        gui.add_html(legend())
        for name, layer in LAYERS.items():
            box = gui.add_checkbox(layer.label, scene.layers[name])

            @box.on_update
            def _(event: Any, name: str = name) -> None:
                scene.layers[name] = bool(event.target.value)
                changed()

    dark = gui.add_checkbox("Dark", False)

    @dark.on_update
    def _(event: Any) -> None:
        is_dark = bool(event.target.value)
        gui.configure_theme(show_share_button=False, show_logo=False, dark_mode=is_dark)
        scene.background = DARK if is_dark else LIGHT
        changed()


def legend() -> str:
    """Return the legend as HTML: the colour of each layer beside its name, and the trail's colour scale."""
    rows = [
        f'<div><span aria-hidden="true" style="display:inline-block;width:1.6em;height:0.5em;margin-right:0.6em;'
        f"border:1px solid #8888;"
        f'background:rgb{layer.colour}"></span>{html.escape(layer.label)}</div>'
        for layer in LAYERS.values()
    ]
    note = "<div>the trail fades; purple on the task, teal 0.05 m, yellow 0.1 m beside it and beyond</div>"
    return f'<div style="font-size:0.85em;padding:0 0.8em 0.4em">{"".join(rows)}{note}</div>'


class TaskEditor:
    """The task that is being edited, drawn beside the one in force, with balls to drag: its middle, and its size.

    `dragged` takes the fields that a drag has changed, m.
    """

    def __init__(self, server: viser.ViserServer, dragged: Callable[[Mapping[str, float]], None]) -> None:
        scene = server.scene
        self._dragged = dragged
        self._shown: tuple[RobotTask, Mapping[str, float]] | None = None
        self._line = scene.add_line_segments("/draft", np.zeros((1, 2, 3)), DRAFT_COLOUR, thickness=0.02, visible=False)
        self.balls = {
            name: scene.add_icosphere(
                f"/draft_{name}", radius=1.0, color=DRAFT_COLOUR, visible=False, cast_shadow=False
            )
            for name in ("middle", "rim")
        }
        for name, ball in self.balls.items():

            async def pulled(event: Any, name: str = name) -> None:
                place = floor_under(_camera(event.client)[0], event.end_position)
                if place is not None:
                    self.pull(name, place)

            ball.on_drag(pulled)

    def pull(self, ball: str, place: tuple[float, float]) -> None:
        """Move one handle of the edited circle to a point on the floor."""
        if self._shown is None:
            return
        values = self._shown[1]
        if ball == "middle":
            self._dragged({"center_x_m": place[0], "center_y_m": place[1]})
        else:
            self._dragged({"radius_m": math.hypot(place[0] - values["center_x_m"], place[1] - values["center_y_m"])})

    def show(self, task: RobotTask, draft: Mapping[str, float] | None) -> None:
        """Draw the draft of a change of `task`, or nothing: no other field than these has a place on the floor."""
        editable = draft is not None and {"center_x_m", "center_y_m"} <= draft.keys()
        if not editable or draft is None:
            if self._shown is not None:
                self._line.visible = self.balls["middle"].visible = self.balls["rim"].visible = False
                self._shown = None
            return
        if self._shown == (task, draft):
            return
        self._shown = (task, draft)
        outline = with_values(task, draft).course().outline_m()
        size_m = 0.04 + 0.03 * float(np.ptp(outline[:, 0]))
        places = {"middle": (draft["center_x_m"], draft["center_y_m"])}
        if "radius_m" in draft:
            places["rim"] = (draft["center_x_m"] + draft["radius_m"], draft["center_y_m"])
        self._line.points = segments(outline, _DRAFT_M).astype(np.float32)
        self._line.visible = True
        for name, (x_m, y_m) in places.items():
            self.balls[name].position = (x_m, y_m, 0.0)
            self.balls[name].radius = size_m
            self.balls[name].visible = True


def floor_under(eye: Point, seen: Point) -> tuple[float, float] | None:
    """Return the floor's point on the line from the camera through `seen`; None if that does not point down."""
    down = eye[2] - seen[2]
    if down <= 1e-6:
        return None
    part = eye[2] / down
    return eye[0] + part * (seen[0] - eye[0]), eye[1] + part * (seen[1] - eye[1])


class ScrubBar:
    """A bar below the scene, as wide as each browser's picture, with the log's marks on it."""

    def __init__(
        self, server: viser.ViserServer, end_s: float, marks: Sequence[float], go_to: Callable[[float], None]
    ) -> None:
        self._end_s, self._marks, self._go_to = end_s, tuple(marks), go_to
        self._bars: dict[int, tuple[viser.PanelHandle, viser.GuiSliderHandle[float]]] = {}
        self._widths: dict[int, int] = {}
        self._t_s = 0.0
        server.on_client_connect(self._add)
        server.on_client_disconnect(self._remove)

    def show(self, t_s: float) -> None:
        """Show that the replay is here now."""
        self._t_s = round(t_s, 3)
        for _, slider in tuple(self._bars.values()):
            slider.value = self._t_s  # type: ignore[misc]

    def _add(self, client: viser.ClientHandle) -> None:
        panel = client.gui.add_panel()
        with panel.add_tab("Time and marks"):
            slider = client.gui.add_slider("s", 0.0, self._end_s, 0.001, self._t_s, marks=self._marks)
        self._bars[client.client_id] = (panel, slider)

        @slider.on_update
        def _(event: Any) -> None:
            # Without a client it was moved from here.
            if event.client is not None:
                self._go_to(float(event.target.value))

        @client.camera.on_update
        def _(camera: viser.CameraHandle) -> None:
            self._fit(client.client_id, camera.image_width)

    def _fit(self, number: int, width_px: int) -> None:
        if width_px and self._widths.get(number) != width_px and number in self._bars:
            self._widths[number] = width_px
            self._bars[number][0].float(
                x=_MARGIN_PX, y=-_MARGIN_PX, width=max(160.0, width_px - 2.0 * _MARGIN_PX), height=_BAR_HEIGHT_PX
            )

    def _remove(self, client: viser.ClientHandle) -> None:
        self._bars.pop(client.client_id, None)
        self._widths.pop(client.client_id, None)
