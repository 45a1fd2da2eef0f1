"""The paper's circle experiment, in simulation: what knowing the parameters' distribution is worth (second figure).

The plant's parameters are drawn from the posterior. The paper does not state the control period, the wheel limits, the
lag or the noise of its robot: they are options here, and part of the result.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from disco_hw import config
from disco_hw.control.disco import Disco
from disco_hw.control.plan import ROTATION, CommandLimits, DiscoSettings, PlannerState, SentCommand
from disco_hw.errors import InputError
from disco_hw.model import Gaussian, Model, Uniform
from disco_hw.model.model import BASE_PARAMETERS
from disco_hw.reports import TWO_THIRDS, write_pictures
from disco_hw.tasks.circle import CircleCost, CircleTask

# Chosen: a fifth of a plan's usual step, so that the plant is finer than the model.
SUBSTEP_S = 0.02


class KinematicPlant:
    """A skid-steer robot that starts at rest.

    `wheel_noise`: standard deviation of each wheel's speed relative to itself, white at 50 Hz.
    """

    def __init__(
        self, theta: dict[str, float], start: tuple[float, float, float], lag_s: float, wheel_noise: float, seed: int
    ) -> None:
        self._radius, self._axial = theta["wheel_radius_m"], theta["axial_distance_m"]
        self._x_icr, self._lag_s, self._wheel_noise = theta["x_icr_m"], lag_s, wheel_noise
        self._rng = np.random.default_rng([seed, 7])
        self.x_m, self.y_m, self.yaw_rad = start
        self.wheels = (0.0, 0.0)
        self.forward_m_s = 0.0

    def advance(self, left_rad_s: float, right_rad_s: float, seconds: float) -> None:
        """Hold these wheel commands for a while."""
        count = max(1, round(seconds / SUBSTEP_S))
        dt = seconds / count
        part = 1.0 - math.exp(-dt / self._lag_s) if self._lag_s > 0.0 else 1.0
        left, right = self.wheels
        for _ in range(count):
            left += (left_rad_s - left) * part
            right += (right_rad_s - right) * part
            noise_left, noise_right = (1.0 + self._wheel_noise * self._rng.standard_normal(2)).tolist()
            rim_left, rim_right = self._radius * left * noise_left, self._radius * right * noise_right
            v, omega = 0.5 * (rim_left + rim_right), (rim_right - rim_left) / self._axial
            middle = self.yaw_rad + 0.5 * omega * dt
            self.x_m += dt * (v * math.cos(middle) + omega * self._x_icr * math.sin(middle))
            self.y_m += dt * (v * math.sin(middle) - omega * self._x_icr * math.cos(middle))
            self.yaw_rad += omega * dt
            self.forward_m_s = v
        self.wheels = (left, right)


Array = NDArray[np.float64]
Progress = Callable[[str], None]
Command = Callable[[int, PlannerState], tuple[float, float]]

POINT_ESTIMATE = {"x_icr_m": 0.12, "wheel_radius_m": 0.06, "axial_distance_m": 0.47}
CURVES = ("prior", "posterior", "posterior mean", "point estimate", "true parameters")
# As HISTORY_NS of the daemon's pipeline.
MEMORY_S = 2.0


@dataclass(frozen=True, slots=True)
class CircleOptions:
    """Options of the circle experiment that the paper leaves open.

    `seeds` seeds from `seed_offset` on draw plant and noise. `belief_scale` multiplies the posterior's standard
    deviations, for the plants that are drawn as for those who know it. `rate_hz` of replanning; `largest_rot_s` and
    `largest_rot_s2` bound a wheel's command; `lag_s` and `wheel_noise` are the plant's; it starts on the circle, along
    it, at rest.
    """

    seeds: int = 8
    duration_s: float = 40.0
    rate_hz: float = 10.0
    largest_rot_s: float = 1.0
    largest_rot_s2: float = math.inf
    lag_s: float = 0.1
    wheel_noise: float = 0.05
    seed_offset: int = 0
    belief_scale: float = 1.0


@dataclass(frozen=True, eq=False, slots=True)
class Run:
    """One drive, N control periods: the plant's pose after each (N, 3), speed (N,) m/s, commands (N, 2) rad/s."""

    poses: Array
    forward_m_s: Array
    commands_rad_s: Array


@dataclass(frozen=True, eq=False, slots=True)
class CircleResult:
    """Runs of each curve over the seeds, by name."""

    options: CircleOptions
    circle: CircleCost
    mode: str
    runs: dict[str, list[Run]]

    def distances_m(self, name: str) -> Array:
        """Distances from the circle (seeds, N) of a curve, positive outside of it."""
        x, y, _ = np.array([run.poses for run in self.runs[name]]).transpose(2, 0, 1)
        return np.asarray(np.hypot(x - self.circle.center_x_m, y - self.circle.center_y_m) - self.circle.radius_m)

    def costs(self, name: str) -> Array:
        """Instant costs (seeds, N) of a curve."""
        forward = np.array([run.forward_m_s for run in self.runs[name]])
        return np.asarray(np.hypot(self.distances_m(name), forward - self.circle.speed_m_s))

    def rows(self) -> list[dict[str, float | str]]:
        """Return, for each curve, mean cost, its spread over seeds, the last half's cost and distance, command change.

        `steady_rms_mm` is the root mean square of the distance over the last half and all seeds, `steady_worst_mm` the
        largest of a seed; `command_change_rot_s` is the mean change of a wheel's command over 0.1 s.
        """
        apart = max(1, round(0.1 * self.options.rate_hz))
        found: list[dict[str, float | str]] = []
        for name, runs in self.runs.items():
            costs, half = self.costs(name), runs[0].forward_m_s.size // 2
            square_mm2 = 1e6 * np.mean(self.distances_m(name)[:, half:] ** 2, axis=1)
            changes = [np.abs(run.commands_rad_s[apart:] - run.commands_rad_s[:-apart]) for run in runs]
            found.append(
                {
                    "controller": name,
                    "mean_cost": float(costs.mean()),
                    "std_over_seeds": float(costs.mean(axis=1).std(ddof=1)) if len(runs) > 1 else math.nan,
                    "steady_cost": float(costs[:, half:].mean()),
                    "steady_rms_mm": math.sqrt(float(square_mm2.mean())),
                    "steady_worst_mm": math.sqrt(float(square_mm2.max())),
                    "command_change_rot_s": float(np.mean(changes)) / ROTATION if costs.shape[1] > apart else math.nan,
                }
            )
        return found

    def table(self) -> str:
        """Return the rows and the options as text."""
        lines = [
            f"{'controller':18s} {'mean cost':>10s} {'std':>8s} {'steady cost':>12s} {'rms (mm)':>9s} {'worst':>6s} "
            f"{'du (rot/s)':>11s}"
        ]
        lines += [
            f"{row['controller']:18s} {row['mean_cost']:10.4f} {row['std_over_seeds']:8.4f} {row['steady_cost']:12.4f} "
            f"{row['steady_rms_mm']:9.2f} {row['steady_worst_mm']:6.2f} {row['command_change_rot_s']:11.4f}"
            for row in self.rows()
        ]
        options = ", ".join(f"{key} = {value:g}" for key, value in asdict(self.options).items())
        lines.append(
            f"mode {self.mode}; {options}; steady, rms: of the last half; du: mean change of a command in 0.1 s"
        )
        return "\n".join(lines)

    def write_csv(self, path: Path) -> None:
        """Time, and for each curve the mean over seeds of the running mean of the instant cost."""
        means = {name: _running_mean(self.costs(name)).mean(axis=0) for name in self.runs}
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(["t_s", *means])
            for step, values in enumerate(zip(*means.values(), strict=True)):
                writer.writerow([f"{(step + 1) / self.options.rate_hz:.3f}", *(f"{value:.6g}" for value in values)])

    def write_pictures(self, path: Path) -> None:
        """Write a PNG file, with PDF and SVG beside it, of the cost and the paths.

        The running mean of the instant cost over time, where two thirds of the seeds lie, and the paths of the first.
        """
        from matplotlib.figure import Figure  # noqa: PLC0415  (slow to import, needed only here)

        figure = Figure(figsize=(11.0, 5.0), layout="constrained")
        left, right = figure.subplots(1, 2)
        picture = CircleTask().course().outline_m()
        right.plot(picture[:, 0], picture[:, 1], color="0.6", linestyle="--", label="circle")
        for name, runs in self.runs.items():
            costs = _running_mean(self.costs(name))
            time_s = (np.arange(costs.shape[1]) + 1) / self.options.rate_hz
            (line,) = left.plot(time_s, costs.mean(axis=0), label=name)
            low, high = np.quantile(costs, TWO_THIRDS, axis=0)
            left.fill_between(time_s, low, high, color=line.get_color(), alpha=0.15, linewidth=0)
            right.plot(runs[0].poses[:, 0], runs[0].poses[:, 1], label=name, linewidth=1.0)
        left.set(xlabel="time (s)", ylabel="mean instant cost so far (m, with m/s)", title=f"Circle, mode {self.mode}")
        right.set(xlabel="x (m)", ylabel="y (m)", title="Paths of the first seed", aspect="equal")
        left.legend()
        right.legend()
        write_pictures(figure, path)


def run_circle(
    model: Model, mode: str = "default", options: CircleOptions | None = None, progress: Progress = lambda _text: None
) -> CircleResult:
    """Drive the circle with each curve's knowledge, over all seeds; `progress` is called after each curve.

    `model` holds the posterior that the plants are drawn from; the prior is the paper's. Raises InputError for a model
    without a belief over the three base parameters.
    """
    options = options or CircleOptions()
    base = {parameter.name for parameter in BASE_PARAMETERS}
    if model.belief is None or set(model.belief.names) != base:
        raise InputError(
            "the model has no belief over wheel radius, axial distance and x_icr; name a file that has one"
        )
    if options.belief_scale != 1.0:
        covariance = options.belief_scale**2 * model.belief.covariance()
        model = replace(model, belief=Gaussian(model.belief.names, model.belief.mean(), covariance))
    circle = CircleCost()
    task = circle.paper() if mode == "paper" else circle
    settings = DiscoSettings.paper() if mode == "paper" else DiscoSettings(refine=mode == "default")
    runs: dict[str, list[Run]] = {}
    for name in CURVES:
        runs[name] = [
            drive(planner_command(_knowing(name, model, theta), task, settings, options, seed), theta, options, seed)
            for seed, theta in enumerate(plants(model, options.seeds, options.seed_offset), start=options.seed_offset)
        ]
        result = CircleResult(options, circle, mode, {name: runs[name]})
        progress(f"{name}: mean cost {result.rows()[0]['mean_cost']:.4f}")
    return CircleResult(options, circle, mode, runs)


def plants(model: Model, count: int, first: int = 0) -> list[dict[str, float]]:
    """Parameters of the plants `first` to `first + count` - 1 drawn from the model's belief, within physical ranges."""
    assert model.belief is not None
    draws = model.belief.draw(first + count, np.random.default_rng(0))[first:]
    full = model.complete(draws, model.belief.names)
    return [dict(zip(model.parameter_names, row, strict=True)) for row in full.tolist()]


def _knowing(name: str, model: Model, theta: dict[str, float]) -> Model:
    """Return the controller's model for a curve."""
    bare = replace(model, belief=None)
    match name:
        case "prior":
            prior = config.Prior()
            low, high = np.array([getattr(prior, parameter.name) for parameter in BASE_PARAMETERS]).T
            return replace(model, belief=Uniform(tuple(p.name for p in BASE_PARAMETERS), low, high))
        case "posterior":
            return model
        case "posterior mean":
            assert model.belief is not None
            return bare.with_point(dict(zip(model.belief.names, model.belief.mean().tolist(), strict=True)))
        case "point estimate":
            return bare.with_point(POINT_ESTIMATE)
        case _:
            return bare.with_point(theta)


def planner_command(
    model: Model, task: CircleCost, settings: DiscoSettings, options: CircleOptions, seed: int
) -> Command:
    """DISCO as a function from time (ns) and state to wheel speeds."""
    limits = CommandLimits(options.largest_rot_s * ROTATION, options.largest_rot_s2 * ROTATION)
    planner = Disco(model, task, settings, limits, seed)
    return lambda now_ns, state: planner.plan(now_ns, state).at(now_ns)


def drive(command: Command, theta: dict[str, float], options: CircleOptions, seed: int) -> Run:
    """Drive a plant with these parameters by a controller for the whole duration."""
    circle, period_s = CircleCost(), 1.0 / options.rate_hz
    plant = KinematicPlant(theta, (circle.radius_m, 0.0, math.pi / 2), options.lag_s, options.wheel_noise, seed)
    count = round(options.duration_s * options.rate_hz)
    poses, speeds, commands = np.empty((count, 3)), np.empty(count), np.empty((count, 2))
    sent: list[SentCommand] = []
    for step in range(count):
        now_ns = round(step * period_s * 1e9)
        state = PlannerState(now_ns, plant.x_m, plant.y_m, plant.yaw_rad, *plant.wheels, sent=tuple(sent))
        left, right = command(now_ns, state)
        commands[step] = left, right
        sent.append(SentCommand(now_ns, left, right))
        del sent[: -max(1, round(MEMORY_S * options.rate_hz))]
        plant.advance(left, right, period_s)
        poses[step], speeds[step] = (plant.x_m, plant.y_m, plant.yaw_rad), plant.forward_m_s
    return Run(poses, speeds, commands)


def _running_mean(costs: Array) -> Array:
    """Mean so far along the last axis."""
    return np.asarray(np.cumsum(costs, axis=-1) / np.arange(1, costs.shape[-1] + 1))
