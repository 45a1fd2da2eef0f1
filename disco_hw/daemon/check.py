"""Check for `disco-hw check` that everything is ready to drive, without moving or arming anything."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from statistics import median
from typing import Any

import msgspec

from disco_hw.adaptation.guard import choose_adaptation
from disco_hw.config import PoseInput, RobotConfig
from disco_hw.daemon import send_request, socket_path
from disco_hw.errors import InputError, WorkError
from disco_hw.estimation.pose_sources import APART_STDS
from disco_hw.processes import can_lock_memory, can_use_fifo
from disco_hw.runtime import connection
from disco_hw.runtime.assembly import create_link, create_pipeline, driver_of, pose_source_of
from disco_hw.runtime.obstacles import obstacle_source_of
from disco_hw.runtime.pipeline import NoPlanner, Off, Pipeline
from disco_hw.runtime.preflight import (
    Check,
    Level,
    check_command_timing,
    check_fence,
    check_firmware_limits,
    check_link_load,
    check_realtime,
    check_round_trip,
    check_safety,
    check_task,
    check_watchdog,
)
from disco_hw.runtime.robot_setup import Setup, link_key, load_setup, refuse_missing_effects
from disco_hw.runtime.supervisor import FIND_HEADING
from drivers.motor import find_driver
from drivers.types import (
    Driver,
    DriverState,
    LinkState,
    MessageSource,
    OutgoingFrame,
    PoseSample,
    PoseSource,
    ReceivedFrame,
    RobotStatus,
    Transport,
    WheelSample,
)
from firmware_protocol import status_codes
from firmware_protocol.codec import Codec, Decoded

# Chosen: longer than a link takes to open; then the check says that it does not.
_LINK_TIMEOUT_S = 2.0
# Three periods of the reference protocol's HOST_STATE, and more commands of a host that drives.
_OTHER_HOST_S = 0.3
# Above _SETTLED_S, so that half of it counts; three of what comes once a second.
_LISTEN_S = 3.0
# By then the handshake is over: what the robot rejects from now on it would reject while driving.
_SETTLED_S = 1.5
_STEP_S = 0.002


@dataclass(frozen=True, slots=True)
class CheckReport:
    """The checks in the order in which they were made."""

    checks: tuple[Check, ...]

    @property
    def ok(self) -> bool:
        """Whether no check failed; warnings do not count."""
        return all(check.level is not Level.FAIL for check in self.checks)

    def as_dict(self) -> dict[str, Any]:
        """Return the report as a JSON-serialisable dict."""
        return {
            "ok": self.ok,
            "checks": [{"name": check.name, "level": check.level.value, "text": check.text} for check in self.checks],
        }

    def as_text(self) -> str:
        """Return the report for the operator, one line a check."""
        return "\n".join(f"{check.level.value:4}  {check.name}: {check.text}" for check in self.checks)


def run_check(robot: Path, link: str | None = None) -> CheckReport:
    """Check files, link, firmware, timing and this computer; takes about three seconds.

    Raises InputError if a file is wrong, WorkError while a daemon or another host drives this robot, as the two would
    speak at once, and where the system refuses a port that `run` would open.
    """
    setup = load_setup(robot, None, link)
    key, transport = link_key(setup), create_link(setup)
    refuse_while_daemon_runs(setup.config)
    checks = [_model_check(setup), _adaptation_check(setup), check_task(setup.task_config)]
    checks.append(check_link_load(setup.config.link, setup.config.control))
    checks += check_fence(setup.config.robot, setup.config.fence)
    control = setup.config.control
    priority = setup.config.daemon.realtime_priority
    checks += check_realtime(priority, can_use_fifo(), can_lock_memory(), os.cpu_count() or 1)
    named = setup.config.link
    kind = find_driver(named.driver)
    checks += check_safety(setup.config.robot, kind.safety_card(named.settings()))
    obstacle_source = obstacle_source_of(setup.config)
    if obstacle_source is not None:
        obstacle_source.close()
    pose_source = pose_source_of(setup.config)
    transport.open()
    try:
        checks.append(_link_check(transport))
        if checks[-1].level is Level.OK:
            refuse_other_host(transport, driver_of(setup.config, key))
            pipeline = create_pipeline(setup.config, setup.model, NoPlanner())
            found = _query_robot(transport, driver_of(setup.config, key), pose_source, pipeline)
            checks.append(_firmware_check(found, kind.reports_reception))
            if kind.reports_reception:
                checks.append(_hearing_check(found))
                checks.append(check_round_trip(found.round_trips_s, 1.0 / control.rate_hz))
            checks.append(_telemetry_check(found))
            if found.wheels:
                checks.append(_wheels_check(found.wheels))
            checks += pose_source_checks(setup.config.pose, found.poses)
            limits = found.driver.limits
            if limits is not None:
                checks += check_firmware_limits(setup.config.robot, limits)
                checks.append(check_command_timing(control, limits))
                checks.append(check_watchdog(limits))
    finally:
        transport.close()
        pose_source.close()
    return CheckReport(tuple(checks))


@dataclass(frozen=True, slots=True)
class _Found:
    """Replies of the robot during a check; `pose_message` is the pose source's newest message, or empty.

    `pose_refusal`: why all poses of a source were refused, in words, or empty.
    """

    driver: Driver
    detail: str
    wheels: tuple[WheelSample, ...]
    poses: tuple[PoseSample, ...]
    pose_message: str
    pose_refusal: str
    rejected: int
    reported: tuple[RobotStatus, ...]
    round_trips_s: tuple[float, ...]


def refuse_while_daemon_runs(config: RobotConfig) -> None:
    """Raise WorkError while a daemon drives this robot, InputError where that cannot be seen."""
    path = socket_path(config)
    try:
        if not path.exists():
            return
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); run as the daemon's user, or correct daemon.control_socket"
        ) from None
    try:
        send_request(path, {"do": "status"}, timeout_s=1.0)
    except WorkError:
        return
    raise WorkError(
        f"{path}: a daemon is connected to this robot; see `disco-hw ctl ROBOT.toml status`, or stop the daemon first"
    )


def refuse_other_host(transport: Transport, driver: Driver) -> None:
    """Listen on the link for 0.3 s without sending; raise WorkError if another host speaks on it.

    A daemon of another user, such as the service, has its control socket where this user does not look. A host that
    says nothing, as a disarmed one of most vendors' controllers, is not heard. `driver`: one for this alone. A link
    that is not up after 0.3 s is not waited for.
    """
    start_ns = time.monotonic_ns()
    while transport.state is not LinkState.UP and time.monotonic_ns() < start_ns + _OTHER_HOST_S * 1e9:
        time.sleep(_STEP_S)
    start_ns = time.monotonic_ns()
    driver.link_up(start_ns)
    while (now_ns := time.monotonic_ns()) < start_ns + _OTHER_HOST_S * 1e9:
        other_host = driver.receive(now_ns, transport.receive()).other_host
        if other_host is not None:
            raise WorkError(
                f"another host speaks on this link: {other_host}; stop it first: a daemon (with "
                "`sudo systemctl stop disco-hw@NAME` if it is the service), or a program of the vendor's"
            )
        time.sleep(_STEP_S)


def _model_check(setup: Setup) -> Check:
    """Report the model file and its effects; warn if the robot has none, fail if `run` refuses it."""
    if setup.model_file is None:
        text = (
            "no model file is named: plans use the nominal geometry and the whole prior, and the robot may drive "
            "at half the task's speed; write a model from a log with `disco-hw infer`"
        )
        return Check("model", Level.WARNING, text)
    try:
        refuse_missing_effects(setup)
    except InputError as error:
        return Check("model", Level.FAIL, str(error))
    effects = ", ".join(effect.name for effect in setup.model.effects) or "none"
    return Check("model", Level.OK, f"{setup.model_file}, effects: {effects}")


def _adaptation_check(setup: Setup) -> Check:
    """Report the online adaptation chosen for this configuration; fail if the model does not allow it."""
    try:
        chosen = choose_adaptation(setup.config.control, setup.config.pose, setup.model)
    except InputError as error:
        return Check("adaptation", Level.FAIL, str(error))
    return Check("adaptation", Level.OK, f"{chosen.kind}, as {chosen.why}")


def _link_check(transport: Transport) -> Check:
    """Wait up to two seconds for the link to come up; fail if it does not."""
    deadline = time.monotonic() + _LINK_TIMEOUT_S
    while transport.state is not LinkState.UP:
        if time.monotonic() > deadline:
            state = connection(transport.state, transport.last_error, DriverState.DISCONNECTED, "")
            return Check("link", Level.FAIL, state)
        time.sleep(_STEP_S)
    return Check("link", Level.OK, transport.name)


def _query_robot(transport: Transport, driver: Driver, pose_source: PoseSource, pipeline: Pipeline) -> _Found:
    """Shake hands, listen for three seconds and time the answers to the driver's own clock requests.

    `pipeline` takes in wheels and poses as while driving.
    """
    stopwatch = _Stopwatch()
    wheels: list[WheelSample] = []
    poses: list[PoseSample] = []
    pose_message = ""
    reported: list[RobotStatus] = []
    # What came while nobody listened would count as of the time of listening.
    transport.receive()
    start_ns = time.monotonic_ns()
    driver.link_up(start_ns)
    end_ns = start_ns + round(_LISTEN_S * 1e9)
    while (now_ns := time.monotonic_ns()) < end_ns:
        frames = transport.receive()
        stopwatch.received(frames)
        readings = driver.receive(now_ns, frames)
        wheels += readings.wheels
        came = pose_source.receive(now_ns, readings.poses)
        poses += came
        pipeline.step(now_ns, pipeline.screen(msgspec.structs.replace(readings, poses=tuple(came))), Off())
        if isinstance(pose_source, MessageSource):
            pose_message = next(reversed(pose_source.new_messages()), pose_message)
        reported += [status for status in readings.status if status.t_ns - start_ns > _SETTLED_S * 1e9]
        for outgoing in driver.transmit(now_ns, None):
            if transport.send(outgoing, now_ns):
                stopwatch.sent(outgoing)
        time.sleep(_STEP_S)
    stats = driver.stats
    refusals = [one.refusal for one in pipeline.fusion.sources.all if one.refusal and not one.accepted]
    return _Found(
        driver=driver,
        detail=connection(transport.state, transport.last_error, driver.state, driver.detail),
        wheels=tuple(wheels),
        poses=tuple(poses),
        pose_message=pose_message,
        pose_refusal="; ".join(refusals),
        rejected=stats.rejected_crc + stats.rejected_sequence + stats.rejected_length + transport.stats.malformed,
        reported=tuple(reported),
        round_trips_s=tuple(stopwatch.round_trips_s),
    )


def pose_source_checks(source: PoseInput, poses: Sequence[PoseSample]) -> list[Check]:
    """Check each of several pose sources on a robot that stands, and whether they agree."""
    labels, every = source.labels(), source.every()
    if len(labels) == 1:
        return []
    checks: list[Check] = []
    for number, (label, named) in enumerate(zip(labels, every, strict=True)):
        poses_here = [pose for pose in poses if pose.source == number]
        frame = f"frame at {list(named.origin)}, sensor at {list(named.offset)}"
        if not poses_here:
            checks.append(
                Check(f"poses {label}", Level.WARNING, f"no pose received; {frame}; check that the sensor sends")
            )
            continue
        age_s = median((pose.received_ns - pose.t_ns) * 1e-9 for pose in poses_here)
        heading = f"{poses_here[-1].yaw_std_rad:.3g} rad" if poses_here[-1].has_heading else "no heading"
        position = f"{poses_here[-1].position_std_m:.3g} m"
        text = f"{len(poses_here) / _LISTEN_S:.0f} a second, {1e3 * age_s:.0f} ms old, {position}, {heading}"
        checks.append(Check(f"poses {label}", Level.OK, f"{text}; {frame}"))
    for one, other in combinations(range(len(labels)), 2):
        apart = _apart(*([pose for pose in poses if pose.source == number] for number in (one, other)))
        if apart:
            text = f"{apart} more than their stated noise; correct origin, offset or the standard deviations of one"
            checks.append(Check(f"poses {labels[one]} and {labels[other]}", Level.FAIL, text))
    return checks


def _apart(one: Sequence[PoseSample], other: Sequence[PoseSample]) -> str:
    """Describe the offset between two pose sources; empty if they agree.

    Medians taken while the robot stands still are compared.
    """
    if not one or not other:
        return ""
    dx, dy = (median(getattr(pose, name) for pose in one) - median(getattr(pose, name) for pose in other)
              for name in ("x_m", "y_m"))  # fmt: skip
    # Without a heading a position is the sensor's, which may be anywhere around.
    lever_m = sum(math.hypot(each[-1].lever_x_m, each[-1].lever_y_m) for each in (one, other))
    noise_m = APART_STDS * math.hypot(one[-1].position_std_m, other[-1].position_std_m)
    if math.hypot(dx, dy) > noise_m + lever_m:
        return f"{math.hypot(dx, dy):.2f} m apart,"
    if one[-1].has_heading and other[-1].has_heading:
        turn = abs(math.remainder(one[-1].yaw_rad - other[-1].yaw_rad, 2.0 * math.pi))
        # Of single poses, as angles have no median.
        if turn > 2.0 * APART_STDS * math.hypot(one[-1].yaw_std_rad, other[-1].yaw_std_rad):
            return f"{turn:.2f} rad apart,"
    return ""


class _Stopwatch:
    """Round trips of the clock requests that pass by."""

    def __init__(self) -> None:
        self._codec = Codec()
        self._sent_ns: dict[float, int] = {}
        self.round_trips_s: list[float] = []

    def sent(self, outgoing: OutgoingFrame) -> None:
        decoded = self._codec.decode(outgoing.frame.can_id, outgoing.frame.data)
        if isinstance(decoded, Decoded) and decoded.name == "TIME_REQUEST":
            self._sent_ns[decoded.values["sequence"]] = time.monotonic_ns()

    def received(self, frames: Sequence[ReceivedFrame]) -> None:
        for received in frames:
            decoded = self._codec.decode(received.frame.can_id, received.frame.data)
            if isinstance(decoded, Decoded) and decoded.name == "TIME_RESPONSE":
                sent_ns = self._sent_ns.pop(decoded.values["sequence"], None)
                if sent_ns is not None:
                    self.round_trips_s.append((received.t_ns - sent_ns) * 1e-9)


def _firmware_check(found: _Found, has_clock: bool) -> Check:
    """Fail if the robot did not identify itself, or is refused, faulty or in e-stop; `has_clock`: report clock sync."""
    name = "firmware"
    identity, state = found.driver.identity, found.driver.state
    if identity is None:
        return Check(name, Level.FAIL, found.detail)
    if state in {DriverState.REFUSED, DriverState.FAULT, DriverState.ESTOP}:
        return Check(name, Level.FAIL, f"{state.value}: {found.detail}")
    if found.reported and found.reported[-1].fault_code:
        text = f"{state.value}: the robot reports {status_codes.fault(found.reported[-1].fault)}"
        return Check(name, Level.FAIL, text)
    is_synchronised = found.driver.clock_offset_ns is not None
    clock = f", clock {'synchronised' if is_synchronised else 'NOT synchronised'}" if has_clock else ""
    return Check(name, Level.OK, f"{identity.describe()}, {state.value}{clock}")


def _hearing_check(found: _Found) -> Check:
    """Whether the robot takes what this host sends; a wrong key shows nowhere else."""
    name = "hearing"
    if not found.reported:
        return Check(name, Level.FAIL, "the robot did not report which frames it receives; check the firmware")
    first, last = found.reported[0], found.reported[-1]
    rejected = (last.rejected_count - first.rejected_count) % 256
    if not rejected:
        return Check(name, Level.OK, "the robot rejects no frames")
    level = Level.FAIL if last.reject_reason == "AUTHENTICATION" else Level.WARNING
    return Check(name, level, f"the robot rejected {rejected} frames: {status_codes.reject_reason(last.reject_reason)}")


def _telemetry_check(found: _Found) -> Check:
    """Fail without wheel samples or if poses are refused; warn without poses or heading, or if frames were rejected."""
    name = "telemetry"
    rates = f"{len(found.wheels) / _LISTEN_S:.0f} wheel and {len(found.poses) / _LISTEN_S:.0f} pose samples a second"
    if not found.wheels:
        return Check(name, Level.FAIL, f"{rates}; check the encoders and the firmware")
    if not found.poses:
        why = found.pose_message and f"; {found.pose_message}"
        return Check(
            name,
            Level.WARNING,
            f"{rates}{why}; without a pose the task does not start while estimation.pose_required is true",
        )
    if found.pose_refusal:
        return Check(name, Level.FAIL, f"{rates}; {found.pose_refusal}")
    if not any(pose.has_heading for pose in found.poses):
        return Check(name, Level.WARNING, f"{rates}; heading not known; {FIND_HEADING}")
    if found.rejected:
        return Check(
            name,
            Level.WARNING,
            f"{rates}, {found.rejected} frames rejected; check the cable, and look for other senders",
        )
    return Check(name, Level.OK, f"{rates}, none rejected")


def _wheels_check(samples: Sequence[WheelSample]) -> Check:
    """Report how far and how fast each wheel turned, for an operator who turns it by hand."""
    sides = [
        ("left", [(sample.left_angle_rad, sample.left_speed_rad_s) for sample in samples]),
        ("right", [(sample.right_angle_rad, sample.right_speed_rad_s) for sample in samples]),
    ]
    texts = [
        f"{side} turned by {turned[-1][0] - turned[0][0]:+.2f} rad, at most at "
        f"{max((speed for _, speed in turned), key=abs):+.2f} rad/s"
        for side, turned in sides
    ]
    return Check("wheels", Level.OK, "; ".join(texts))
