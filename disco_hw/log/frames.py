"""Chains of transforms: what /tf and /tf_static say between frames -> planar poses of the robot in the map."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from disco_hw.log.drive import Array, Index

MAP_FRAMES = ("map", "world", "mocap", "optitrack", "vicon")
BASE_FRAMES = ("base_link", "base_footprint")
ODOM_FRAMES = ("odom", "odom_combined")

Edge = tuple[str, str]
"""Names of parent and child."""


@dataclass(frozen=True, slots=True)
class Motion:
    """Transforms of one edge in order of time: (N,), ns, and position and quaternion x, y, z, w, (N, 7).

    A static one holds for all times and has one row.
    """

    t_ns: Index
    values: Array
    static: bool


def chain(edges: Iterable[Edge], map_frame: str, base_frame: str) -> tuple[Edge, ...] | None:
    """The edges from map to base, in this order, or None; each child has one parent, as tf demands."""
    parents = {child: parent for parent, child in edges}
    found: list[Edge] = []
    frame = base_frame
    while frame != map_frame:
        parent = parents.get(frame)
        # As many steps as frames: what comes after is a circle.
        if parent is None or len(found) > len(parents):
            return None
        found.insert(0, (parent, frame))
        frame = parent
    return tuple(found)


def poses(motions: list[Motion]) -> tuple[Index, Array]:
    """Times (M,), ns, and x, y, yaw (M, 3) of the chain's end in its first frame, the edges from map to base.

    A pose is taken where the first moving edge, the localisation's correction, has changed: between two corrections the
    chain only repeats the wheel odometry. The edges after it are interpolated; a pose that they do not reach is left
    out.
    """
    moving = [at for at, one in enumerate(motions) if not one.static]
    if not moving:
        return np.empty(0, dtype=np.int64), np.empty((0, 3))
    leading = motions[moving[0]]
    taken = np.ones(leading.t_ns.size, dtype=bool)
    if len(moving) > 1:
        taken[1:] = np.any(np.diff(leading.values, axis=0) != 0.0, axis=1)
        for at in moving[1:]:
            taken &= (leading.t_ns >= motions[at].t_ns[0]) & (leading.t_ns <= motions[at].t_ns[-1])
    t_ns = leading.t_ns[taken]
    rotation, position = np.tile(np.eye(3), (t_ns.size, 1, 1)), np.zeros((t_ns.size, 3))
    for at, one in enumerate(motions):
        if one.static:
            values = np.repeat(one.values[-1:], t_ns.size, axis=0)
        else:
            values = one.values[taken] if at == moving[0] else _interpolated(one, t_ns)
        position = position + np.einsum("nij,nj->ni", rotation, values[:, :3])
        rotation = rotation @ rotations(values[:, 3:])
    yaw = np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])
    return t_ns, np.column_stack([position[:, :2], yaw])


def _interpolated(one: Motion, t_ns: Index) -> Array:
    zero = one.t_ns[0]
    since, at = (one.t_ns - zero).astype(np.float64), (t_ns - zero).astype(np.float64)
    values = one.values.copy()
    # q and -q are one rotation; neighbours are put on one side.
    turned_over = np.einsum("ni,ni->n", values[1:, 3:], values[:-1, 3:]) < 0.0
    values[1:, 3:] *= np.cumprod(np.where(turned_over, -1.0, 1.0))[:, np.newaxis]
    return np.column_stack([np.interp(at, since, column) for column in values.T])


def rotations(quaternions: Array) -> NDArray[np.float64]:
    """Rotation matrices (N, 3, 3) of quaternions x, y, z, w (N, 4) of any length but 0."""
    x, y, z, w = (quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)
