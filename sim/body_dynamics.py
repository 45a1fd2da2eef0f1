"""Dynamics of the body, from wheel angles to its pose: rolling, skid-steer turning, slip and the floor.

Over one integration piece the body moves along the screw of its mean velocity, which is integrated exactly. With
wheels rolling at rim speeds u_L, u_R: v = (u_L + u_R) / 2, omega = (u_R - u_L) / a, and the body's own velocity is
(v, -x_icr omega) in its frame: the point x_icr ahead of the tracked one moves as a wheel that cannot slide sideways
(Kozlowski and Pazderski 2004).
"""

from __future__ import annotations

import math
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from drivers.kernel_cache import compiled
from sim.effects import HiddenEffects
from sim.plant_parameters import PlantParameters
from sim.wheel_dynamics import WheelPieces, parameter_record

# Chosen: slower wheels slip and drift less, so that a robot at rest stays where it is.
SLIP_ONSET_M_S = 0.05
DRIFT_ONSET_M_S = 0.02
# Chosen: shorter than any motor's lag, and longer than a step, whose difference would be rough.
ACCELERATION_FILTER_S = 0.02
# Chosen: limits, so that extreme parameters leave a robot that still moves and turns.
LARGEST_ACCELERATION_SLIP = 0.6
LEAST_TURN_LEFT = 0.5

_BODY = np.dtype(
    [
        ("x", "f8"),
        ("y", "f8"),
        ("yaw", "f8"),
        ("last_x", "f8"),
        ("last_y", "f8"),
        ("last_yaw", "f8"),
        ("last_us", "i8"),
        ("now_us", "i8"),
        ("left_angle", "f8"),
        ("right_angle", "f8"),
        ("filtered_speed", "f8"),
        ("speed", "f8"),
        ("lateral_speed", "f8"),
        ("yaw_rate", "f8"),
    ],
    align=True,
)


class BodyPose(msgspec.Struct, frozen=True, gc=False):
    """Position (m) and yaw (rad, counter-clockwise, not wrapped) in the world frame."""

    x_m: float = 0.0
    y_m: float = 0.0
    yaw_rad: float = 0.0


class Body:
    """The body with its pose."""

    def __init__(self, parameters: PlantParameters, effects: HiddenEffects, start: BodyPose) -> None:
        self._parameters = _parameter_record(parameters, effects)
        self._state = np.zeros(1, dtype=_BODY)
        # The same memory as plain numbers: reading a record field by field takes microseconds.
        numbers = self._state.view(np.float64)
        self._pose, self._poses, self._velocity = numbers[:3], numbers[:6], numbers[-3:]
        self._times_us = self._state.view(np.int64)[6:8]
        self._set(start)

    @property
    def pose(self) -> BodyPose:
        """Pose of the body now: x, y (m), yaw (rad), in the world."""
        return BodyPose(*self._pose.tolist())

    @property
    def velocity(self) -> tuple[float, float, float]:
        """Velocity of the tracked point in the body frame: forward (m/s), left (m/s), yaw rate (rad/s)."""
        speed, lateral, yaw_rate = self._velocity.tolist()
        return speed, lateral, yaw_rate

    def pose_at(self, t_us: int) -> BodyPose:
        """Return the pose within the newest integration piece, at t_us: between its end points on a straight line."""
        x, y, yaw, last_x, last_y, last_yaw = self._poses.tolist()
        last_us, now_us = self._times_us.tolist()
        span = now_us - last_us
        if span == 0:
            return BodyPose(x, y, yaw)
        part = (t_us - last_us) / span
        return BodyPose(last_x + part * (x - last_x), last_y + part * (y - last_y), last_yaw + part * (yaw - last_yaw))

    def advance(
        self,
        pieces: WheelPieces,
        begin: int,
        end: int,
        stop_us: int,
        slip: npt.NDArray[np.float64],
        first_cell: int,
        step_us: int,
    ) -> int:
        """Move through pieces begin..end-1; stop after the one that reaches `stop_us`; return the next piece.

        `slip`: velocities that the wheels do not cause, shape (cells, 3), row 0 for grid cell `first_cell`.
        """
        return _advance(
            self._parameters,
            self._state,
            pieces.times_us,
            pieces.angles,
            begin,
            end,
            stop_us,
            slip,
            first_cell,
            step_us,
        )

    def displace(self, dx_m: float, dy_m: float, dyaw_rad: float) -> None:
        """Put the body elsewhere at once: a step in the world frame and a turn about the tracked point."""
        pose = self.pose
        self._set(BodyPose(pose.x_m + dx_m, pose.y_m + dy_m, pose.yaw_rad + dyaw_rad))

    def _set(self, pose: BodyPose) -> None:
        for name, value in (("x", pose.x_m), ("y", pose.y_m), ("yaw", pose.yaw_rad)):
            self._state[name] = value
            self._state[f"last_{name}"] = value


def _parameter_record(p: PlantParameters, effects: HiddenEffects) -> npt.NDArray[np.void]:
    (asymmetry,) = effects.values("wheel_radius_asymmetry")
    drift, direction = effects.values("slope")
    change_track, change_s, change_radius = effects.values("surface_change")
    saturating, saturating_rate = effects.values("x_saturating_turn_slip")
    carpet_track, carpet_x, carpet_y, carpet_radius = effects.values("x_carpet_patch")
    return parameter_record(
        {
            "left_radius": p.wheel_radius_m * (1.0 - asymmetry),
            "right_radius": p.wheel_radius_m * (1.0 + asymmetry),
            "axial_distance": p.axial_distance_m,
            "x_icr": p.x_icr_m,
            "y_icr": effects.values("lateral_icr")[0],
            "turn_slip": effects.values("turn_slip")[0],
            "saturating_turn_slip": saturating,
            "saturating_turn_slip_rate": saturating_rate,
            "acceleration_slip": effects.values("acceleration_slip")[0],
            "side_slip": effects.values("side_slip")[0],
            "speed_squared_drag": effects.values("x_speed_squared_drag")[0],
            "drift_x": drift * math.cos(direction),
            "drift_y": drift * math.sin(direction),
            "change_s": change_s,
            "change_track": 1.0 + change_track,
            "change_radius": 1.0 + change_radius,
            "ripple": effects.values("x_wheel_ripple")[0],
            "carpet_track": 1.0 + carpet_track,
            "carpet_x": carpet_x,
            "carpet_y": carpet_y,
            "carpet_radius": carpet_radius,
        }
    )


@compiled
def _kept(loss: float) -> float:
    """Return the share of a yaw rate that slip leaves."""
    return min(max(1.0 - loss, LEAST_TURN_LEFT), 1.0 / LEAST_TURN_LEFT)


@compiled
def _rolling(p: Any, s: Any, left_angle: float, right_angle: float, dt: float) -> tuple[float, float, float]:
    """Rim speeds after ripple and floor, m/s, and the effective axial distance, m."""
    left = (left_angle - s["left_angle"]) / dt * p["left_radius"]
    right = (right_angle - s["right_angle"]) / dt * p["right_radius"]
    axial_distance = p["axial_distance"]
    if p["ripple"] != 0.0:
        left *= 1.0 + p["ripple"] * math.sin(left_angle)
        right *= 1.0 + p["ripple"] * math.sin(right_angle)
    if s["now_us"] * 1e-6 >= p["change_s"]:
        left *= p["change_radius"]
        right *= p["change_radius"]
        axial_distance *= p["change_track"]
    if p["carpet_track"] != 1.0 and math.hypot(s["x"] - p["carpet_x"], s["y"] - p["carpet_y"]) < p["carpet_radius"]:
        axial_distance *= p["carpet_track"]
    return left, right, axial_distance


@compiled
def _advance(
    parameters: Any,
    state: Any,
    times_us: npt.NDArray[np.int64],
    angles: npt.NDArray[np.float64],
    begin: int,
    end: int,
    stop_us: int,
    slip: npt.NDArray[np.float64],
    first_cell: int,
    step_us: int,
) -> int:
    p = parameters[0]
    s = state[0]
    piece = begin
    while piece < end:
        now_us = s["now_us"]
        dt = (times_us[piece] - now_us) * 1e-6
        left, right, axial_distance = _rolling(p, s, angles[piece, 0], angles[piece, 1], dt)
        rolled = 0.5 * (left + right)
        omega = (right - left) / axial_distance
        omega *= _kept(p["turn_slip"] * abs(omega))
        omega *= _kept(p["saturating_turn_slip"] * abs(omega) / (1.0 + abs(omega) / p["saturating_turn_slip_rate"]))
        filtered = s["filtered_speed"]
        s["filtered_speed"] = rolled + (filtered - rolled) * math.exp(-dt / ACCELERATION_FILTER_S)
        acceleration = (s["filtered_speed"] - filtered) / dt
        spin = p["acceleration_slip"] * (acceleration if rolled > 0.0 else -acceleration)
        spin = min(max(spin, -LARGEST_ACCELERATION_SLIP), LARGEST_ACCELERATION_SLIP)
        v = rolled * (1.0 - spin) * (1.0 - p["speed_squared_drag"] * rolled * rolled)

        fastest = max(abs(left), abs(right))
        slipping = min(fastest / SLIP_ONSET_M_S, 1.0)
        row = now_us // step_us - first_cell
        forward = v + p["y_icr"] * omega + slipping * slip[row, 0]
        sideways = -p["x_icr"] * omega - p["side_slip"] * v * omega + slipping * slip[row, 1]
        omega += slipping * slip[row, 2]

        angle = omega * dt
        if abs(angle) < 1e-4:
            along = dt * (1.0 - angle * angle / 6.0)
            across = dt * 0.5 * angle
        else:
            along = math.sin(angle) / omega
            across = (1.0 - math.cos(angle)) / omega
        step_x = along * forward - across * sideways
        step_y = across * forward + along * sideways
        cosine, sine = math.cos(s["yaw"]), math.sin(s["yaw"])
        drifting = min(fastest / DRIFT_ONSET_M_S, 1.0) * dt
        s["last_x"], s["last_y"], s["last_yaw"], s["last_us"] = s["x"], s["y"], s["yaw"], now_us
        s["x"] += cosine * step_x - sine * step_y + drifting * p["drift_x"]
        s["y"] += sine * step_x + cosine * step_y + drifting * p["drift_y"]
        s["yaw"] += angle
        s["speed"], s["lateral_speed"], s["yaw_rate"] = forward, sideways, omega
        s["left_angle"], s["right_angle"] = angles[piece, 0], angles[piece, 1]
        s["now_us"] = times_us[piece]
        piece += 1
        if s["now_us"] >= stop_us:
            break
    return piece
