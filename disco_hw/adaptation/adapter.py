"""The adapter: samples in, about once a second a report out; and the process that it runs in."""

from __future__ import annotations

import contextlib
import math
import os
import socket
import sys
import threading
from collections import deque
from typing import TYPE_CHECKING

import msgspec
import numpy as np
from numpy.typing import NDArray

from disco_hw.adaptation.adapter_link import (
    MAX_PACKET_BYTES,
    FromAdapter,
    InForce,
    LinkStats,
    Proposal,
    Range,
    Report,
    Samples,
    ToAdapter,
)
from disco_hw.adaptation.recursive import (
    Evidence,
    Judged,
    RecursiveGeometry,
    RunningNoise,
    SampleWindow,
    evidence,
    to_linear,
)
from disco_hw.inference.excitation import USUAL, UnusableDriveError, measured_noise
from disco_hw.model import Model
from disco_hw.processes import limit_thread_pools

if TYPE_CHECKING:
    # Importing it loads torch, which takes seconds: who trains a network does so in a thread of its own.
    from disco_hw.adaptation.network import WindowNetwork

Array = NDArray[np.float64]

PERIOD_S = 1.0
WINDOW_S = 30.0
CHANGE_LIMIT = 30.0
WIDEST = np.array([0.03, 0.04, 0.08])
"""Wider than this (x_icr in m, the others by their size) the drive says too little to plan by."""

INFERENCE_S = 4.0
"""Between two conditionings of the network."""

USUAL_WIDENING = np.array([1.2, 1.2, 1.2])
"""Of the closed form's standard deviations, before the network has said how much it takes for honest ones."""

LARGEST_WIDENING = 2.0
DISAGREEMENT = 4.0

_MARGIN_S = 2.0
_NEWEST_S = 3.0
_LEAST_MOVING = 0.5
_LEAST_DATA_S = 2.5
_SHORTEST_S = 3.0
_QUIET_CHANGE = 15.0
_SUSPICIOUS_CHANGE = 20.0
_NOISE_PERIOD_S = 20.0
_SETTLED_S = 20.0
_JUDGED_S = 10.0
_SCORED_S = 0.9


class Adapter:
    """Learns the geometry from the running drive. Pure: the same messages give the same reports."""

    def __init__(self, network: WindowNetwork | None = None) -> None:
        self._network = network
        self._window = SampleWindow(WINDOW_S + _MARGIN_S)
        self._noise = RunningNoise()
        self._recursive: RecursiveGeometry | None = None
        self._in_force: InForce | None = None
        self._model: InForce | None = None
        self._next_ns = 0
        self._noise_s = -np.inf
        self._scored_s = -np.inf
        self._advantage = 0.0
        self._next_inference_s = -np.inf
        self._widening = USUAL_WIDENING
        self._doubt = ""

    def equip(self, network: WindowNetwork) -> None:
        """Condition this network from now on."""
        self._network = network

    def take(self, message: ToAdapter) -> Report | None:
        """Take in one message; a report if it is time for one."""
        if isinstance(message, InForce):
            self._drive_by(message)
        if not isinstance(message, Samples):
            return None
        self._window.add(message)
        if message.now_ns < self._next_ns or self._recursive is None:
            return None
        self._next_ns = message.now_ns + round(PERIOD_S * 1e9)
        return self._report(message)

    def _drive_by(self, message: InForce) -> None:
        if self._model is None:
            self._model = message
        self._in_force = message
        if not message.adapted:
            self._advantage = 0.0
        if self._recursive is None or message.relearn:
            mean, covariance = np.array(message.mean), np.array(message.covariance).reshape(3, 3)
            now_s = self._window.seconds(message.now_ns)
            self._recursive = RecursiveGeometry(mean, covariance, CHANGE_LIMIT, now_s)

    def _report(self, message: Samples) -> Report:
        assert self._recursive is not None
        now_ns, window = message.now_ns, self._window
        try:
            drive = window.drive()
        except UnusableDriveError:
            return Report(now_ns, "standing, or no poses: nothing to learn from")
        newest_s = window.seconds(window.newest_ns())
        moving_s = float(drive.moving_s[drive.t_s > newest_s - _NEWEST_S].sum())
        if newest_s < window.seconds(now_ns) - _NEWEST_S or moving_s < _LEAST_MOVING * _NEWEST_S:
            return Report(now_ns, "standing: nothing to learn from")
        seen = evidence(drive, self._noise.noise)
        judged = self._recursive.judge(seen, newest_s - WINDOW_S)
        self._learn_noise(judged, newest_s)
        self._judge_in_force(seen)
        fault = _undetermined(judged)
        if fault:
            return Report(now_ns, fault, advantage=self._advantage)
        t_ns = window.newest_ns()
        inferred = self._infer(t_ns, newest_s, seen, judged)
        return Report(now_ns, _words(judged), (*inferred, self._proposal(t_ns, judged)), self._advantage)

    def _infer(self, t_ns: int, now_s: float, seen: Evidence, judged: Judged) -> tuple[Proposal, ...]:
        """Condition the network on the window since the last change, if it is time to."""
        if self._network is None or now_s < self._next_inference_s:
            return ()
        part = seen.part(seen.t_s > judged.since_s)
        moving_s = float(part.moving_s.sum())
        if moving_s < _SHORTEST_S:
            return ()
        self._next_inference_s = now_s + INFERENCE_S
        found = self._network.condition(part)
        self._doubt = found.doubt
        if found.doubt:
            return ()
        apart = np.abs(found.mean - judged.mean)
        if bool((apart > DISAGREEMENT * np.sqrt(np.diag(found.covariance) + np.diag(judged.covariance))).any()):
            self._doubt = "density network and recursive estimate disagree"
            return ()
        self._widening = np.clip(found.widening, 1.0, LARGEST_WIDENING)
        return (_proposal(t_ns, "network", found.mean, found.covariance, moving_s, ""),)

    def _proposal(self, t_ns: int, judged: Judged) -> Proposal:
        """The recursive estimate, as wide as the network has shown such estimates to be."""
        suspected = judged.changed_s is None and judged.largest_change > _SUSPICIOUS_CHANGE
        doubt = "the robot may just have changed" if suspected else self._doubt
        covariance = judged.covariance * np.outer(self._widening, self._widening)
        return _proposal(t_ns, "recursive", judged.mean, covariance, judged.data_s, doubt)

    def _learn_noise(self, judged: Judged, now_s: float) -> None:
        """Measure the noise where the geometry has been one for long, so that no change counts as slip."""
        quiet = judged.largest_change < _QUIET_CHANGE and now_s - judged.since_s > _SETTLED_S
        if not quiet or now_s - self._noise_s < _NOISE_PERIOD_S:
            return
        try:
            drive = self._window.drive(max(judged.since_s, now_s - WINDOW_S))
        except UnusableDriveError:
            return
        if float(drive.moving_s.sum()) > _SETTLED_S * _LEAST_MOVING:
            self._noise_s = now_s
            self._noise.add(measured_noise(drive, judged.mean).about_the_point())

    def _judge_in_force(self, seen: Evidence) -> None:
        """Score the newest driving under the belief in force and under the model file's; what is older counts less."""
        newest_s = float(seen.t_s[-1])
        new = seen.t_s > self._scored_s
        if self._in_force is None or self._model is None or not self._in_force.adapted:
            self._scored_s = newest_s
            return
        moving_s = float(seen.moving_s[new].sum())
        if moving_s < _SCORED_S:
            return
        information, score = seen.information[new].sum(axis=0), seen.score[new].sum(axis=0)
        gain = _log_evidence(self._in_force, information, score) - _log_evidence(self._model, information, score)
        self._advantage = self._advantage * math.exp(-moving_s / _JUDGED_S) + gain
        self._scored_s = newest_s


def _log_evidence(belief: InForce, information: Array, score: Array) -> float:
    """Log of the mean likelihood under a belief, up to what all beliefs share."""
    mean, covariance = to_linear(np.array(belief.mean), np.array(belief.covariance).reshape(3, 3))
    prior = np.linalg.inv(covariance)
    combined = prior @ mean + score
    _, growth = np.linalg.slogdet(np.eye(3) + covariance @ information)
    square = combined @ np.linalg.solve(prior + information, combined) - mean @ prior @ mean
    return float(0.5 * (square - growth))


def _undetermined(judged: Judged) -> str:
    """Why the drive says too little, or nothing."""
    if judged.data_s < _LEAST_DATA_S:
        return f"{judged.data_s:.1f} s of driving since {judged.since_s:.0f} s: too few"
    std = np.sqrt(np.diag(judged.covariance)) / np.array([1.0, judged.mean[1], judged.mean[2]])
    wide = [
        name for name, one, most in zip(("x_icr", "wheel radius", "axial distance"), std, WIDEST, strict=True)
        if one > most
    ]  # fmt: skip
    if wide:
        return f"low excitation: {' and '.join(wide)} not determined; drive turns as well as straights"
    return ""


def _words(judged: Judged) -> str:
    changed = "" if judged.changed_s is None else f"the robot changed at {judged.changed_s:.1f} s; "
    return f"{changed}{judged.data_s:.0f} s of driving agree (worst split: chi-square {judged.largest_change:.1f})"


def _proposal(t_ns: int, estimator: str, mean: Array, covariance: Array, data_s: float, doubt: str) -> Proposal:
    x_icr, radius, axial = mean.tolist()
    a, b, c, d, e, f, g, h, i = covariance.ravel().tolist()
    return Proposal(t_ns, estimator, (x_icr, radius, axial), (a, b, c, d, e, f, g, h, i), data_s, doubt)


class InlineLink:
    """The adapter in the same thread, for simulated time: a report is there with the tick after its samples."""

    def __init__(self, adapter: Adapter) -> None:
        self._adapter = adapter
        self._reports: deque[FromAdapter] = deque()
        self._sent = self._taken = 0

    @property
    def stats(self) -> LinkStats:
        """Counters."""
        return LinkStats(sent=self._sent, reports=self._taken, alive=True)

    def send(self, message: ToAdapter) -> None:
        """Let the adapter take the message in."""
        self._sent += 1
        report = self._adapter.take(message)
        if report is not None:
            self._reports.append(report)

    def receive(self) -> tuple[FromAdapter, ...]:
        """The reports so far."""
        found = tuple(self._reports)
        self._reports.clear()
        self._taken += len(found)
        return found

    def restart(self) -> bool:
        """It does not die."""
        return False

    def close(self) -> None:
        """Nothing is open."""


_NICE = 10


def main(descriptor: int) -> int:
    """Serve the daemon at the other end of this socket; returns the exit code."""
    limit_thread_pools()
    with contextlib.suppress(OSError):
        os.nice(_NICE)
    decode, encode = msgspec.msgpack.Decoder(ToAdapter).decode, msgspec.msgpack.Encoder().encode
    adapter = Adapter()
    begun = False
    with socket.socket(fileno=descriptor) as daemon:
        while packet := daemon.recv(MAX_PACKET_BYTES):
            message = decode(packet)
            if isinstance(message, Range) and not begun:
                begun = True
                threading.Thread(target=_train, args=(adapter, message), daemon=True).start()
            report = adapter.take(message)
            if report is not None:
                with contextlib.suppress(BlockingIOError):
                    daemon.send(encode(report), socket.MSG_DONTWAIT)
    return 0


def _train(adapter: Adapter, about: Range) -> None:
    """Train the network while the recursive estimate serves alone, then hand it over."""
    # Loads torch: seconds, in which samples already come in.
    from disco_hw.adaptation.network import Training, train_network, training_range  # noqa: PLC0415

    mean, low, high = (np.array(values) for values in (about.mean, about.low, about.high))
    training = Training(*training_range(mean, low, high), about.wheel_rad_s)
    adapter.equip(train_network(training, USUAL, Model(about.mean[1], about.mean[2], about.mean[0])))


if __name__ == "__main__":
    with contextlib.suppress(BrokenPipeError, ConnectionResetError, KeyboardInterrupt):
        sys.exit(main(int(sys.argv[1])))
