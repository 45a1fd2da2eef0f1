"""Simulation of logs: a drive's wheel speeds through the model at many parameter points, with the log's own noise.

The work can be shared out: over this process's threads, or a Dask cluster.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from disco_hw.errors import InputError, WorkError
from disco_hw.inference.excitation import Excitation
from disco_hw.inference.noise import Noise, slip_intensity
from disco_hw.jit import parallel_kernel
from disco_hw.model.added_terms import new_means
from disco_hw.model.coefficients import base_point, effect_point
from disco_hw.model.model import BASE_PARAMETERS, Model, coefficient_tables
from disco_hw.model.step import axle_of, integration_from, integration_series, step, tracked_of
from disco_hw.model.terms import clear_memory

Array = NDArray[np.float64]
Seeds = NDArray[np.uint32]
Summary = Callable[[Array], Array]

NAMES = ("x_icr_m", "wheel_radius_m", "axial_distance_m")
# Chosen: larger shares the work less evenly, smaller hands over more often.
_CHUNK = 32


@parallel_kernel
def simulate_kernel(
    seeds: Any,
    base: Any,
    effects: Any,
    series: Any,
    noise_scale: Any,
    noise_spread: Any,
    wheel: Any,
    intensity: Any,
    node: Any,
    fraction: Any,
    starts: Any,
    run_node: Any,
    run_pose: Any,
    means: Any,
    out: Any,
) -> None:
    """Write measured poses (n, P, 3) of n simulations to `out`, one for each row of `base` and `effects`, and seed.

    Every run starts at its pose of `starts` (runs, 3). Slip is added after every step of a moving robot: forward, to
    the left, and in yaw about the lever's end; its variance is that of the noise times `intensity` (M,), and it keeps
    its direction for the correlation time. Every simulation has a noise of its own: `noise_scale` (7,) as
    `Noise.scales`, times exp(`noise_spread` (7, 7) z); the lever, last, plus that in its place. `means`: scratch of
    `new_means`.
    """
    integration = integration_from(series, True, None)
    root = math.sqrt(integration.step_s)
    unit, noise, drift = np.empty(7), np.empty(7), np.empty(3)
    for i in range(seeds.shape[0]):
        np.random.seed(seeds[i])
        for row in range(7):
            unit[row] = np.random.standard_normal()
            exponent = 0.0
            for column in range(row + 1):
                exponent += noise_spread[row, column] * unit[column]
            noise[row] = noise_scale[row] * math.exp(exponent) if row < 6 else noise_scale[row] + exponent
        keep = math.exp(-integration.step_s / max(noise[5], 1e-4))
        fresh, long_run = math.sqrt(1.0 - keep * keep), math.sqrt((1.0 - keep) / (1.0 + keep))
        here, effects_here = base_point(base, i), effect_point(effects, i)
        clear_memory(means)
        for run in range(run_node.shape[0] - 1):
            x, y, yaw = starts[run, 0], starts[run, 1], starts[run, 2]
            cos_yaw, sin_yaw = math.cos(yaw), math.sin(yaw)
            axle_x, axle_y = axle_of(x, y, cos_yaw, sin_yaw, here)
            wheel_left, wheel_right = wheel[run_node[run], 0], wheel[run_node[run], 1]
            sample, last = run_pose[run], run_pose[run + 1]
            for axis in range(3):
                drift[axis] = np.random.standard_normal()
            for k in range(run_node[run], run_node[run + 1]):
                before_x, before_y, before_yaw = x, y, yaw
                axle_x, axle_y, cos_yaw, sin_yaw, wheel_left, wheel_right, _, turn = step(
                    axle_x, axle_y, cos_yaw, sin_yaw, wheel_left, wheel_right, wheel[k, 0], wheel[k, 1],
                    k * integration.step_s, here, effects_here, integration, means,
                )  # fmt: skip
                yaw = yaw + (turn + turn) * integration.step_s
                x, y = tracked_of(axle_x, axle_y, cos_yaw, sin_yaw, here)
                if intensity[k] > 0.0:
                    size = long_run * root * math.sqrt(intensity[k])
                    for axis in range(3):
                        drift[axis] = keep * drift[axis] + fresh * np.random.standard_normal()
                    slip_yaw = size * noise[4] * drift[2]
                    along = size * noise[2] * drift[0]
                    across = size * noise[3] * drift[1] - noise[6] * slip_yaw
                    x += along * cos_yaw - across * sin_yaw
                    y += along * sin_yaw + across * cos_yaw
                    yaw += slip_yaw
                    cos_yaw, sin_yaw = math.cos(yaw), math.sin(yaw)
                    axle_x, axle_y = axle_of(x, y, cos_yaw, sin_yaw, here)
                while sample < last and node[sample] == k:
                    part = fraction[sample]
                    out[i, sample, 0] = before_x + part * (x - before_x) + noise[0] * np.random.standard_normal()
                    out[i, sample, 1] = before_y + part * (y - before_y) + noise[0] * np.random.standard_normal()
                    out[i, sample, 2] = before_yaw + part * (yaw - before_yaw) + noise[1] * np.random.standard_normal()
                    sample += 1


@dataclass(frozen=True, slots=True)
class Simulator:
    """Simulations of one drive; pure: the same points and seeds give the same poses, however they are shared out.

    `noise_spread` (7, 7), lower triangular: how far the logarithms of the noise, and its lever, vary from simulation
    to simulation.
    """

    model: Model
    drive: Excitation
    noise: Noise
    noise_spread: Array = field(default_factory=lambda: np.zeros((7, 7)))

    def poses(self, theta: Array, seeds: Seeds) -> Array:
        """Measured poses (n, P, 3), yaw not wrapped; `theta` (n, 3) in the order of `NAMES`, `seeds` (n,)."""
        drive = self.drive
        out = np.empty((theta.shape[0], drive.t_s.size, 3))
        full = np.tile(self.model.point(), (theta.shape[0], 1))
        order = [self.model.parameter_names.index(name) for name in NAMES]
        full[:, order] = theta
        base, effects = coefficient_tables(self.model, full, drive.step_s)
        simulate_kernel(
            seeds,
            base,
            effects,
            integration_series(drive.step_s, wide=True),
            self.noise.scales(),
            self.noise_spread,
            drive.wheel_rad_s,
            slip_intensity(drive, self.noise.speed_share)[0],
            drive.node,
            drive.fraction,
            drive.pose[drive.run_pose[:-1]],
            drive.run_node,
            drive.run_pose,
            new_means(effects),
            out,
        )
        return out

    def summaries(
        self,
        theta: Array,
        seeds: Seeds,
        summary: Summary,
        workers: Workers | None = None,
        done: Callable[[int], None] = lambda _: None,
    ) -> Array:
        """Summary statistics (n, S) of n simulations, by default on all cores; `done` hears of each chunk, in order."""
        chunks = [slice(first, first + _CHUNK) for first in range(0, theta.shape[0], _CHUNK)]
        items = [(theta[chunk], seeds[chunk]) for chunk in chunks]
        found = []
        for part in (workers or LocalWorkers()).map(_summarised, (self, summary), items):
            found.append(part)
            done(part.shape[0])
        return np.concatenate(found)


def _summarised(shared: tuple[Simulator, Summary], item: tuple[Array, Seeds]) -> Array:
    simulator, summary = shared
    return summary(simulator.poses(*item))


def physical_range() -> tuple[Array, Array]:
    """Lowest and highest possible values in the order of `NAMES`, (3,) each."""
    ranges = {parameter.name: (parameter.low, parameter.high) for parameter in BASE_PARAMETERS}
    low, high = np.array([ranges[name] for name in NAMES]).T
    return low, high


def draw_seeds(count: int, rng: np.random.Generator) -> Seeds:
    """Seeds for `count` simulations."""
    return rng.integers(0, 2**32, size=count, dtype=np.uint32)


S = TypeVar("S")
T = TypeVar("T")
R = TypeVar("R")


class Workers(Protocol):
    """Protocol of a place to compute; the work is pure, so the results are the same wherever that is."""

    def map(self, work: Callable[[S, T], R], shared: S, items: Sequence[T]) -> Iterator[R]:
        """Results of `work(shared, item)` in the order of the items, as they come."""

    def call(self, work: Callable[..., R], *arguments: Any) -> R:
        """Return the result of one piece of work."""


class LocalWorkers:
    """Threads on all cores this process may use, for work that gives up the interpreter's lock."""

    def map(self, work: Callable[[S, T], R], shared: S, items: Sequence[T]) -> Iterator[R]:
        """Yield the results of `work(shared, item)` in the order of the items, computed in threads."""
        with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
            yield from pool.map(lambda item: work(shared, item), items)

    def call(self, work: Callable[..., R], *arguments: Any) -> R:
        """Return the result of one piece of work, computed in the caller's thread."""
        return work(*arguments)


ReportProgress = Callable[[str, float], None]


class Tally:
    """Counts simulations of `total` and reports the stage with the share that is done, in [0, 1]."""

    def __init__(self, total: int, report_progress: ReportProgress) -> None:
        self._total = total
        self._report_progress = report_progress
        self._done = 0
        self._stage = ""

    def stage(self, text: str) -> None:
        """Begin a new stage."""
        self._stage = text
        self.add(0)

    def add(self, count: int) -> None:
        """Count `count` more simulations as done and report the progress."""
        self._done += count
        self._report_progress(self._stage, min(self._done / self._total, 1.0))


# Chosen: longer than a scheduler of the local network takes to answer.
_CONNECT_TIMEOUT_S = 5.0


class DaskWorkers:
    """Work on the cluster of a connected `distributed.Client`; what is shared is sent to its workers once a call."""

    def __init__(self, client: Any) -> None:
        self._client = client

    def map(self, work: Callable[[S, T], R], shared: S, items: Sequence[T]) -> Iterator[R]:
        """Yield the results of `work(shared, item)` in the order of the items, computed on the cluster."""
        sent = self._client.scatter(shared, broadcast=True, hash=False)
        for future in self._client.map(_swapped, list(items), work=work, shared=sent, pure=False):
            yield future.result()

    def call(self, work: Callable[..., R], *arguments: Any) -> R:
        """Return the result of one piece of work, computed on the cluster."""
        result: R = self._client.submit(work, *arguments, pure=False).result()
        return result


def _swapped(item: T, work: Callable[[S, T], R], shared: S) -> R:
    return work(shared, item)


@contextmanager
def dask_workers(address: str) -> Iterator[DaskWorkers]:
    """Yield workers of the Dask cluster whose scheduler is at `address`, e.g. tcp://host:8786, as a context manager.

    Raises InputError if dask is not installed, nothing answers, or the cluster has no workers; WorkError if the cluster
    is lost on the way or its workers cannot do the work.
    """
    try:
        distributed = import_module("distributed")
    except ImportError:
        raise InputError("--dask: dask is not installed; pip install 'disco-hw[dask]'") from None
    try:
        client = distributed.Client(address, timeout=_CONNECT_TIMEOUT_S, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        reason = str(error).partition("\n")[0] or type(error).__name__
        raise InputError(
            f"--dask {address}: no scheduler answers there ({reason}); give its address, e.g. tcp://host:8786"
        ) from None
    with client:
        if not client.scheduler_info(n_workers=-1)["workers"]:
            raise InputError(f"--dask {address}: the cluster has no workers; start some with `dask worker {address}`")
        try:
            yield DaskWorkers(client)
        except ModuleNotFoundError as error:
            raise WorkError(f"--dask {address}: a worker lacks {error.name}; install disco-hw there too") from None
        except (distributed.KilledWorker, distributed.client.FutureCancelledError, OSError) as error:
            reason = str(error).partition("\n")[0]
            raise WorkError(
                f"--dask {address}: the connection to the cluster was lost ({reason}); restart the cluster, then "
                "this command"
            ) from None
