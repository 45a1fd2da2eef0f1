"""Fence and obstacles on the page: their lines on the floor, and the fields that change the fence."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any

import msgspec
import numpy as np
import viser
from numpy.typing import NDArray

from disco_hw.fence import Fence, Footprint
from disco_hw.fence.clearance import circle_outline, footprint_outline
from disco_hw.log import records
from disco_hw.runtime.safe_area import fence_of_record

Array = NDArray[np.float64]
# x, y and radius.
_NUMBERS_OF_CIRCLE = 3


def obstacle_outlines(guard: records.GuardVerdict | None) -> list[Array]:
    """Return the obstacles of a record of the guard as closed lines (N, 2)."""
    numbers = () if guard is None else guard.obstacles
    return [circle_outline(*numbers[k : k + _NUMBERS_OF_CIRCLE]) for k in range(0, len(numbers), _NUMBERS_OF_CIRCLE)]


def stopping_outlines(guard: records.GuardVerdict | None, footprint: Footprint) -> list[Array]:
    """Return a guard record's stopping path, and the footprint at its beginning and end, as lines (N, 2)."""
    if guard is None or not guard.path_x_m:
        return []
    poses = list(zip(guard.path_x_m, guard.path_y_m, guard.path_yaw_rad, strict=True))
    path = np.array([pose[:2] for pose in poses])
    return [path, footprint_outline(footprint, poses[0]), footprint_outline(footprint, poses[-1])]


class FenceEditor:
    """Fields on the page that put another fence in force while the robot is disarmed.

    `request` sends one request to the daemon and returns its reply.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        request: Callable[[Mapping[str, Any]], dict[str, Any]],
        fence: Fence,
        footprint: Footprint,
    ) -> None:
        self._request = request
        self._footprint = footprint
        self._pose: tuple[float, float, float] | None = None
        self._corners: list[list[float]] = []
        with gui.add_folder("Fence", expand_by_default=False):
            self._keep_in = gui.add_text("Stay in", in_text(fence.keep_in))
            self._keep_out = gui.add_text("Keep out of", in_text(fence.keep_out))
            self._margin = gui.add_number("Margin (m)", fence.margin_m, min=0.0, max=5.0, step=0.01)
            corner = gui.add_button("Corner at the robot's nose")
            use = gui.add_button("Use this fence")
            self._reply = gui.add_markdown("Corners as `[[x, y], ...]` in metres; a circle as `{center, radius_m}`.")

        @corner.on_click
        def _(_: Any) -> None:
            self.add_corner()

        @use.on_click
        def _(_: Any) -> None:
            self.use()

    def show(self, pose: tuple[float, float, float] | None) -> None:
        """Take in where the robot is."""
        self._pose = pose

    def add_corner(self) -> None:
        """Add the middle of the footprint's front edge to the corners; the first one begins a new fence."""
        if self._pose is None:
            self._reply.content = "There is no pose to take a corner from. Check the pose sensor."
            return
        x_m, y_m, yaw_rad = self._pose
        ahead = self._footprint.ahead + 0.5 * self._footprint.length
        nose = x_m + ahead * float(np.cos(yaw_rad)), y_m + ahead * float(np.sin(yaw_rad))
        self._corners.append([round(value, 3) for value in nose])
        self._keep_in.value = json.dumps(self._corners)  # type: ignore[misc]
        self._reply.content = f"{len(self._corners)} corners; a fence needs at least three."

    def use(self) -> None:
        """Ask the daemon for the fence that the fields say, and show its answer."""
        try:
            requested = {
                "keep_in": json.loads(self._keep_in.value or "null"),
                "keep_out": json.loads(self._keep_out.value or "[]"),
                "margin_m": float(self._margin.value),
            }
        except ValueError as error:
            self._reply.content = f"Not understood: {error}. Write corners as `[[x, y], ...]`."
            return
        reply = self._request({"do": "fence", **requested})
        if reply.get("ok"):
            self._corners = []
        self._reply.content = str(reply.get("text") if reply.get("ok") else f"Refused: {reply.get('error')}")


def in_text(shapes: Any) -> str:
    """Return a shape, or several, as the page's fields show them."""
    return "" if shapes is None else json.dumps(msgspec.to_builtins(shapes))


def fence_in_force(fence: Fence, record: records.FenceChange | None) -> Fence:
    """Return the fence where this record of it is the newest; robot.toml's, `fence`, without one."""
    return fence if record is None else fence_of_record(record)
