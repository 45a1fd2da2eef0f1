"""Bridge process of `disco-hw bridge ros2-base`: speeds from the daemon to a ROS 2 base, wheel odometry back.

The daemon's driver speaks frames to it on a Unix socket, as to any controller; it speaks DDS to the base. One thread:
what stops the base waits for nothing.
"""

from __future__ import annotations

import contextlib
import os
import select
import socket
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

from cyclonedds.core import DDSException, Policy, Qos
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from disco_hw.bridge import ros2_messages as msg
from disco_hw.bridge.ros2 import (
    LATCHED,
    NEWEST,
    RELIABLE,
    SENSOR,
    TopicReaders,
    UnreadCounts,
    join_domain,
    take_samples,
    wire_name,
)
from disco_hw.bridge.ros2_inlets import WheelInlet
from disco_hw.config import RobotConfig, load_robot_config
from disco_hw.daemon import peer_uid
from disco_hw.daemon.process import StopSignals
from disco_hw.errors import InputError
from drivers.motor import ros2_base_wire as wire
from drivers.private_files import SocketPathError, bind_private, why_not_private
from drivers.types import Frame

INTERFACE = "unixcan"
_PACKET = struct.Struct("=IB3x8s")
"""Linux `struct can_frame`."""
# CAN_EFF_FLAG of linux/can.h.
_EXTENDED = 0x8000_0000
# Chosen: a fifth of STEP_S, by which what is due is late at most.
_WAIT_S = 0.004
# Chosen: half of DEADMAN_S: commands that waited through such a pause of this process are too old to drive by.
_DELAYED_NS = 100_000_000
# State: five within SILENT_NS of the driver; chosen: how often subscribers are looked for.
_STATE_NS, _LOOK_NS = 50_000_000, 100_000_000
# As SILENT_NS of the driver; chosen: how long another publisher of speeds counts as one.
_FRESH_NS, _OTHERS_NS = 250_000_000, 1_000_000_000
# Chosen: the daemon, `estop` and some that listen; and a flood must not hold up the base's speeds.
_MOST_CLIENTS, _MAX_BATCH = 8, 64
# User id of the superuser (POSIX).
_ROOT = 0
_OTHERS_QOS = Qos(
    Policy.Reliability.BestEffort,
    Policy.Durability.Volatile,
    Policy.History.KeepLast(1),
    Policy.IgnoreLocal.Participant,
)


def run_base_bridge(robot: Path) -> int:
    """Run until SIGTERM or SIGINT; returns the exit code. The daemon and the base may come and go.

    Raises InputError for a bad file or a robot without such a base, and WorkError where DDS cannot be had.
    """
    config = load_robot_config(robot)
    settings = config.link.settings()
    if not isinstance(settings, wire.Ros2BaseSettings):
        raise InputError(f"{robot}: link.driver: drives no base on ROS 2; this bridge is not needed")
    if config.link.interface != INTERFACE:
        raise InputError(
            f'{robot}: link.interface: "{config.link.interface}" does not lead to this bridge; write "{INTERFACE}"'
        )
    try:
        clients = Clients(Path(config.link.channel))
    except InputError as error:
        raise InputError(f"{robot}: link.channel: {error}") from None
    with closing(clients), StopSignals() as signals:
        bridge = BaseBridge(config, settings, clients)
        print(
            f"bridge: {config.link.channel} to {settings.speed_topic}, wheels from {settings.wheels_from}", flush=True
        )
        bridge.run(lambda: signals.received is not None)
    return 0


class Clients:
    """Clients of the bridge, the daemon and an e-stop beside it; each receives what the others send, as on a bus.

    Only this user and root are let in. Raises InputError for a path that cannot be listened at.
    """

    def __init__(self, path: Path) -> None:
        self.dropped = 0
        self._path = path
        self._clients: list[socket.socket] = []
        self._listener = _listen(path)

    def receive(self, timeout_s: float) -> Iterator[tuple[socket.socket, Frame | None]]:
        """Frames since the last call, waiting for the first; None for a client that has gone."""
        ready, _, _ = select.select([self._listener, *self._clients], (), (), timeout_s)
        if self._listener in ready:
            ready.remove(self._listener)
            self._accept()
        for client in ready:
            for _ in range(_MAX_BATCH):
                try:
                    packet = client.recv(_PACKET.size + 1)
                except BlockingIOError:
                    break
                except OSError:
                    packet = b""
                if not packet:
                    self._clients.remove(client)
                    client.close()
                    yield client, None
                    break
                if len(packet) == _PACKET.size:
                    can_id, length, data = _PACKET.unpack(packet)
                    self._send(packet, [other for other in self._clients if other is not client])
                    yield client, Frame(can_id & ~_EXTENDED, data[: min(length, 8)], bool(can_id & _EXTENDED))

    def send(self, frame: Frame) -> None:
        """Send a frame to all clients; what one does not read in time is dropped and counted."""
        self._send(_PACKET.pack(frame.can_id, len(frame.data), frame.data), self._clients)

    def close(self) -> None:
        """Hang up and take the socket away; safe to call twice."""
        for opened in (*self._clients, self._listener):
            opened.close()
        self._clients.clear()
        self._path.unlink(missing_ok=True)

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            client, _ = self._listener.accept()
            if len(self._clients) >= _MOST_CLIENTS or peer_uid(client) not in (os.geteuid(), _ROOT):
                client.close()
                return
            client.setblocking(False)
            self._clients.append(client)

    def _send(self, packet: bytes, to: list[socket.socket]) -> None:
        for client in to:
            try:
                client.send(packet)
            except OSError:
                self.dropped += 1


class BaseBridge:
    """Bridge between the daemon's driver and the base, both directions in one thread."""

    def __init__(self, config: RobotConfig, settings: wire.Ros2BaseSettings, clients: Clients) -> None:
        self.end = wire.BaseEnd(settings)
        self._clients = clients
        self._settings = settings
        self._frame_id = config.ros2.base_frame or "base_link"
        self._inlet = WheelInlet(settings)
        self._driven_by: socket.socket | None = None
        self._domain, self._participant = join_domain(config)
        speed: Any = msg.TwistStamped if settings.speed_stamped else msg.Twist
        wheels: Any = msg.JointState if settings.left_joints else msg.Odometry

        def topic(name: str, kind: Any) -> Topic[Any]:
            return Topic(self._participant, wire_name(name, config.ros2.namespace), kind)

        self._writer = DataWriter(self._participant, topic(settings.speed_topic, speed), NEWEST)
        self._others = DataReader(self._participant, topic(settings.speed_topic, speed), _OTHERS_QOS)
        self._wheels = DataReader(self._participant, topic(settings.wheels_from, wheels), SENSOR)
        buttons = topic(settings.stop_topic, msg.Bool) if settings.stop_topic else None
        qualities = (LATCHED, RELIABLE, SENSOR)
        self._button = None if buttons is None else TopicReaders(self._participant, buttons, qualities)
        self.end.receives_button = self._button is None
        self._others_ns = self._wheels_ns = -_OTHERS_NS
        self._step_ns = self._state_ns = self._look_ns = 0
        self._unread, self._unwritten = UnreadCounts(), 0
        self._last_line = ""

    def run(self, should_stop: Callable[[], bool]) -> None:
        """Carry both ways until requested to stop, and leave the base with zeros."""
        last_ns = time.monotonic_ns()
        try:
            while not should_stop():
                received = list(self._clients.receive(_WAIT_S))
                now_ns = time.monotonic_ns()
                # After a pause of this process nobody knows how old the commands are that wait.
                self._handle_commands(received, now_ns, is_delayed=now_ns - last_ns > _DELAYED_NS)
                last_ns = now_ns
                self._handle_messages(now_ns)
                self._send_due(now_ns)
        finally:
            self._drive(self.end.hold_standstill(time.monotonic_ns()))

    def _handle_commands(
        self, received: list[tuple[socket.socket, Frame | None]], now_ns: int, *, is_delayed: bool
    ) -> None:
        """Handle received frames; stop the base after a pause (`is_delayed`) or if the driving client has gone."""
        if is_delayed and self.end.driving:
            self._drive(self.end.hold_standstill(now_ns))
        for client, frame in received:
            if frame is None:
                if client is self._driven_by and self.end.driving:
                    self._drive(self.end.hold_standstill(now_ns))
            elif frame.can_id == wire.STOP or not is_delayed:
                self._handle_command(client, frame, now_ns)

    def _handle_command(self, client: socket.socket, frame: Frame, now_ns: int) -> None:
        """Handle one frame of a client; while one client drives, ignore speeds from the others."""
        was_driving = self.end.driving
        if was_driving and frame.can_id == wire.SPEEDS and client is not self._driven_by:
            return
        self._drive(self.end.receive(now_ns, frame))
        if self.end.driving and not was_driving:
            self._driven_by = client
        if self.end.driving is not was_driving or frame.can_id in (wire.STOP, wire.RESET):
            self._clients.send(self.end.state())

    def _handle_messages(self, now_ns: int) -> None:
        """Read the base's topics: send wheel motion to the clients, note other publishers and the button."""
        wall_ns = time.time_ns()
        for message, sent_ns in self._samples(self._wheels):
            wheels = self._inlet.wheels(message, sent_ns, now_ns, wall_ns)
            if wheels is not None:
                self._wheels_ns = now_ns
                for frame in wire.wheel_frames(wheels):
                    self._clients.send(frame)
        if any(True for _ in self._samples(self._others)):
            self._others_ns = now_ns
        if self._button is not None:
            self._handle_button(self._button)

    def _handle_button(self, readers: TopicReaders) -> None:
        """Read the base's stop button; an unreadable message or no publisher ends driving, as a pressed one does."""
        before = replace(self._unread)
        for message, _ in readers.take(_MAX_BATCH, self._unread):
            self.end.button, self.end.receives_button = message.data, True
        if self._unread != before or not readers.has_publisher():
            self.end.receives_button = False

    def _send_due(self, now_ns: int) -> None:
        """Do the periodic work: look for subscribers, publish the speeds due, and send the state to the clients."""
        end = self.end
        if now_ns >= self._look_ns:
            self._look_ns = now_ns + _LOOK_NS
            # Its own reader of the topic, which ignores what this process says, is not among them.
            end.has_listener = bool(self._writer.get_matched_subscriptions())
            self._print_state()
        end.others_speak = now_ns - self._others_ns < _OTHERS_NS
        end.has_odometry = now_ns - self._wheels_ns < _FRESH_NS
        end.refusal = self._inlet.why(now_ns)
        if now_ns >= self._step_ns:
            self._step_ns = now_ns + round(wire.STEP_S * 1e9)
            self._drive(end.step(now_ns))
        if now_ns >= self._state_ns:
            self._state_ns = now_ns + _STATE_NS
            self._clients.send(end.state())

    def _drive(self, speeds: tuple[float, float] | None) -> None:
        """Publish the forward speed (m/s) and yaw rate (rad/s); publish nothing for None."""
        if speeds is None:
            return
        twist = msg.Twist(msg.Vector3(speeds[0], 0.0, 0.0), msg.Vector3(0.0, 0.0, speeds[1]))
        stamped = self._settings.speed_stamped
        header = msg.Header(msg.stamp_of(time.time_ns()), self._frame_id)
        try:
            self._writer.write(msg.TwistStamped(header, twist) if stamped else twist)
        except DDSException:
            self._unwritten += 1

    def _samples(self, reader: DataReader[Any]) -> Iterator[tuple[Any, int]]:
        return take_samples(reader, _MAX_BATCH, self._unread)

    def _print_state(self) -> None:
        """Print a line for the operator at each change."""
        end = self.end
        topics = self._settings
        parts = [
            f"{topics.speed_topic} {'has a listener' if end.has_listener else 'has no listener'}",
            *([f"another node publishes on {topics.speed_topic}"] if end.others_speak else []),
            "odometry received" if end.has_odometry else f"no odometry: {wire.REFUSALS[end.refusal]}",
            *(["e-stop"] if end.latched else []),
            *(["button pressed"] if end.button else []),
            *([] if end.receives_button else [f"{topics.stop_topic} sends nothing"]),
            "driving" if end.driving else "on standby",
        ]
        counts = {
            "messages refused": sum(self._inlet.refused.values()),
            "messages that were none": self._unread.malformed + self._unread.failed,
            "speeds not sent": self._unwritten,
        }
        line = "; ".join(parts)
        if line != self._last_line:
            self._last_line = line
            print(line + "".join(f"; {name}: {count}" for name, count in counts.items() if count), flush=True)


def _listen(path: Path) -> socket.socket:
    hint = "write a path in a directory of your own, such as one below $XDG_RUNTIME_DIR"
    try:
        why = why_not_private(path.parent, (os.geteuid(), _ROOT))
        if why is not None:
            raise InputError(f"{path.parent}: {why}; {hint}")
        return bind_private(path, socket.SOCK_SEQPACKET)
    except OSError as error:
        raise InputError(f"{path}: cannot listen there ({error.strerror or error}); {hint}") from None
    except SocketPathError as error:
        raise InputError(str(error)) from None
