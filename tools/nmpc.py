"""A textbook nonlinear MPC in CasADi, the reference for the accuracy of tracking.

Horizon of 15 steps of 0.1 s; cost 400 times the squared distance to a timed reference on the line, plus 0.02 times the
squared change of the commands; two SQP iterations with qrqp, started from the previous solution. The model is that of
the belief's mean: a skid-steer robot whose wheels lag behind commands beyond their dead band.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from disco_hw.control.kernel.guide import SteeredChassis
from disco_hw.control.plan import Diagnostics, NoValidControl, PlannerState, Rollouts, WheelPlan, no_rollouts
from disco_hw.model import Belief
from tools.foreign_plant import ForeignRobot
from tools.tracking import LIMITS, NAMES, Track

Array = NDArray[np.float64]

HORIZON, STEP_S = 15, 0.1
DISTANCE_WEIGHT, CHANGE_WEIGHT = 400.0, 0.02
ITERATIONS = 2
# The nearest place is looked for so far behind and ahead of the last one: a line may cross itself.
BEHIND_M, AHEAD_M = 0.1, 0.3
SPACING_M = 0.002


class TimedReference:
    """Points of a line by arc length, from the place nearest to the robot on, at a constant speed."""

    def __init__(self, points_m: Array, speed_m_s: float) -> None:
        lengths = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points_m, axis=0).T))])
        self._speed_m_s, self._length_m = speed_m_s, float(lengths[-1])
        self._closed = bool(np.hypot(*(points_m[-1] - points_m[0])) < 1e-6)
        self._lengths, self._points = lengths, points_m
        self._place_m: float | None = None

    def reset(self) -> None:
        """Look for the nearest place anywhere on the line at the next call."""
        self._place_m = None

    def points(self, x_m: float, y_m: float) -> Array:
        """Return where the robot should be at the end of each step of the horizon, (T, 2)."""
        if self._place_m is None:
            arcs = np.arange(0.0, self._length_m, SPACING_M)
        else:
            arcs = self._place_m + np.arange(-BEHIND_M, AHEAD_M, SPACING_M)
        places = self._at(arcs)
        nearest = arcs[int(np.argmin(np.hypot(places[:, 0] - x_m, places[:, 1] - y_m)))]
        self._place_m = float(nearest % self._length_m if self._closed else min(max(nearest, 0.0), self._length_m))
        return self._at(self._place_m + self._speed_m_s * STEP_S * np.arange(1, HORIZON + 1))

    def _at(self, arcs: Array) -> Array:
        arcs = arcs % self._length_m if self._closed else np.clip(arcs, 0.0, self._length_m)
        return np.column_stack([np.interp(arcs, self._lengths, column) for column in self._points.T])


class NonlinearMpc:
    """Plans wheel speeds by nonlinear MPC, under the mean of the belief that it is given.

    `forward`: the wheels together may not turn backwards. Without it the robot turns round where that is easier: its
    tracked point lies behind the centre of rotation, and following a line forwards is unstable without a term for it.
    """

    def __init__(
        self, robot: ForeignRobot, track: Track, speed_m_s: float, geometry: tuple[float, float, float],
        forward: bool = False,
    ) -> None:  # fmt: skip
        self._reference = TimedReference(track.points_m, speed_m_s)
        self._geometry, self._lag_s, self._dead_rad_s = np.array(geometry), robot.lag_s, robot.dead_rad_s
        self._solver = _solver(robot.lag_s, forward)
        largest = LIMITS.speed_rad_s - robot.dead_rad_s
        self._bounds = np.full(2 * HORIZON, largest)
        change = np.full(2 * HORIZON, LIMITS.acceleration_rad_s2 * STEP_S)
        sums = np.full(HORIZON if forward else 0, 2.0 * largest)
        self._lowest, self._highest = np.concatenate([-change, 0.0 * sums]), np.concatenate([change, sums])
        self.reset()

    @property
    def chassis(self) -> SteeredChassis:
        """The robot in the mean of what is believed."""
        return SteeredChassis(*self._geometry.tolist(), self._lag_s, self._dead_rad_s)

    def reset(self) -> None:
        """Forget the last solution."""
        self._commands, self._t_ns = np.zeros((HORIZON, 2)), 0
        self._reference.reset()

    def set_task(self, task: object) -> None:
        """Raise TypeError, because the reference is that of one track."""
        raise TypeError("this planner follows the track that it was made for")

    def set_belief(self, belief: Belief) -> None:
        """Plan with the mean of this belief from the next plan on."""
        values = dict(zip(belief.names, belief.mean().tolist(), strict=True))
        self._geometry = np.array([values[name] for name in NAMES])

    def sampled_rollouts(self, _count: int) -> Rollouts:
        """Return no rollouts, because nothing is sampled."""
        return no_rollouts()

    def plan(self, now_ns: int, state: PlannerState) -> WheelPlan:
        """Solve for the commands from this state; raises NoValidControl where the solver finds nothing finite."""
        start = np.array([state.x_m, state.y_m, state.yaw_rad, state.left_speed_rad_s, state.right_speed_rad_s])
        last = np.zeros(2)
        if state.sent:
            last = np.array([self._beyond(state.sent[-1].left_rad_s), self._beyond(state.sent[-1].right_rad_s)])
        guess = self._shifted((now_ns - self._t_ns) * 1e-9)
        reference = self._reference.points(state.x_m, state.y_m)
        parameters = np.concatenate([start, last, self._geometry, reference.ravel()])
        found = self._solver(
            x0=guess.ravel(), p=parameters, lbx=-self._bounds, ubx=self._bounds, lbg=self._lowest, ubg=self._highest
        )
        commands = np.array(found["x"]).reshape(HORIZON, 2)
        if not np.isfinite(commands).all():
            self.reset()
            raise NoValidControl("the solver found no finite commands")
        self._commands, self._t_ns = commands, now_ns
        speeds = commands + np.copysign(self._dead_rad_s, commands) * np.minimum(np.abs(commands) / 0.05, 1.0)
        trajectory = np.tile(start[:3], (HORIZON + 1, 1))
        return WheelPlan(now_ns, STEP_S, speeds, trajectory, Diagnostics(1.0, 0.0, float(found["f"]), 0.0, 0.0, 1))

    def _beyond(self, command: float) -> float:
        return math.copysign(max(abs(command) - self._dead_rad_s, 0.0), command)

    def _shifted(self, gap_s: float) -> Array:
        """Return the last solution, moved on by the time since."""
        at = np.arange(HORIZON) + min(max(gap_s / STEP_S, 0.0), float(HORIZON))
        return np.column_stack([np.interp(at, np.arange(HORIZON), column) for column in self._commands.T])


def _solver(lag_s: float, only_forward: bool) -> Any:
    """Build the SQP solver for commands beyond the dead band; the state and the reference are parameters.

    Its constraints are the changes of the commands, and with `only_forward` their sums in each step.
    """
    import casadi as ca  # noqa: PLC0415  (of [bench])

    commands = ca.MX.sym("u", 2 * HORIZON)
    parameters = ca.MX.sym("p", 10 + 2 * HORIZON)
    x, y, yaw, left, right = (parameters[i] for i in range(5))
    last_left, last_right = parameters[5], parameters[6]
    radius, axle, x_icr = parameters[7], parameters[8], parameters[9]
    keep = math.exp(-STEP_S / lag_s)
    settled = (1.0 - keep) * lag_s / STEP_S
    cost, changes, sums = 0.0, [], []
    for t in range(HORIZON):
        command_left, command_right = commands[2 * t], commands[2 * t + 1]
        changes += [command_left - last_left, command_right - last_right]
        sums += [command_left + command_right] if only_forward else []
        last_left, last_right = command_left, command_right
        mean_left, mean_right = (
            command_left + settled * (left - command_left),
            command_right + settled * (right - command_right),
        )
        left, right = command_left + keep * (left - command_left), command_right + keep * (right - command_right)
        forward = 0.5 * radius * (mean_left + mean_right)
        turn = radius * (mean_right - mean_left) / axle
        middle = yaw + 0.5 * STEP_S * turn
        x += STEP_S * (forward * ca.cos(middle) + turn * x_icr * ca.sin(middle))
        y += STEP_S * (forward * ca.sin(middle) - turn * x_icr * ca.cos(middle))
        yaw += STEP_S * turn
        cost += (x - parameters[10 + 2 * t]) ** 2 + (y - parameters[11 + 2 * t]) ** 2
    change = ca.vertcat(*changes)
    problem = {
        "x": commands, "p": parameters, "g": ca.vertcat(change, *sums),
        "f": DISTANCE_WEIGHT * cost + CHANGE_WEIGHT * ca.sumsqr(change),
    }  # fmt: skip
    quiet = {"print_iter": False, "print_header": False, "print_info": False, "error_on_fail": False}
    options = {
        "max_iter": ITERATIONS, "qpsol": "qrqp", "qpsol_options": quiet, "print_header": False,
        "print_iteration": False,
        "print_status": False, "print_time": False, "error_on_fail": False,
    }  # fmt: skip
    return ca.nlpsol("nmpc", "sqpmethod", problem, options)
