"""Stop the robot from outside, with as little as possible in the way.

The frame goes out on the link by a connection of its own, beside the daemon's, and the daemon is asked at the same
time; each way is tried whether or not the other works. Only where the two would disturb each other is the daemon asked
first, and the link is left to it if that stops the robot. A robot.toml whose other sections are broken still says where
the link is; without one that can be read, the option --link does.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import serial

from disco_hw.config import Link, link_fields, link_of, names_address
from disco_hw.daemon import believed_users, default_socket_path, passed_over, send_request
from disco_hw.errors import InputError
from disco_hw.files import ROBOT_TOML, read_toml
from disco_hw.reports import as_json as json_of
from drivers.motor import find_driver
from drivers.motor.vendor_parts import ESTOP_LIFE_NS, ESTOP_REPEATS
from drivers.transport import SerialMedium, open_transport
from drivers.transport.can import FOR_ONE_PROCESS, write_to_held_slcan
from drivers.transport.reconnecting import TransportCounters
from drivers.transport.serial import EXCHANGE_READ_S, ExchangeConnection, open_port
from drivers.types import Frame, LinkState, OutgoingFrame, ReceivedFrame
from firmware_protocol.serial_framing import FrameDecoder, encode_frame

# Chosen: longer than a link takes to open, and short enough for an operator who waits to reach for the button.
_CONNECT_S = 1.0
# Chosen: five periods of SYSTEM_STATE (0.1 s); slower confirmations are reported as missing.
_CONFIRM_S = 0.5
_IsConfirmation = Callable[[ReceivedFrame], bool]
_T = TypeVar("_T")
_HINT = (
    "to stop the robot all the same, give --link can:INTERFACE:CHANNEL or --link serial:PORT, or use the robot's "
    "own e-stop button, now"
)

_BY_REFERENCE = ", and the reference controller's protocol, which no other controller understands"


@dataclass(frozen=True, slots=True)
class EstopOutcome:
    """The result of each way to stop the robot, and whether the robot said that it is in e-stop.

    `latches`: whether its controller itself keeps the stop. `file_error`: why robot.toml did not say where the link is,
    which --link then had to.
    """

    link: str
    link_error: str | None
    daemon_error: str | None
    confirmed: bool
    passed_over: tuple[str, ...] = ()
    file_error: str | None = None
    latches: bool = True

    @property
    def sent(self) -> bool:
        """Whether at least one way worked."""
        return self.link_error is None or self.daemon_error is None

    def as_dict(self) -> dict[str, Any]:
        """Return the outcome as a JSON-serialisable dict."""
        return {
            "sent": self.sent,
            "confirmed": self.confirmed,
            "link": self.link,
            "link_error": self.link_error,
            "daemon_error": self.daemon_error,
            "passed_over": list(self.passed_over),
            "file_error": self.file_error,
        }

    def as_text(self) -> str:
        """Return the outcome as text."""
        lines = [
            *([] if self.file_error is None else [f"{self.file_error}: only --link was used{_BY_REFERENCE}"]),
            f"{self.link}: {self.link_error or 'e-stop sent'}",
            *(f"daemon: {line}" for line in self.passed_over),
            f"daemon: {self.daemon_error or 'e-stop accepted'}",
        ]
        if self.confirmed and not self.latches:
            lines.append(
                "the robot stands still, but its controller does not latch the stop: the next command moves it. "
                "Use the robot's own e-stop button"
            )
        elif self.confirmed:
            lines.append("the robot reports ESTOP; it stays latched until `disco-hw ctl ROBOT.toml reset`")
        elif self.sent:
            lines.append("e-stop sent, but the robot has not confirmed it: look at the robot, use its e-stop button")
        else:
            lines.append("NOT SENT: use the robot's own e-stop button, now")
        return "\n".join(lines)


def stop_robot(
    robot: Path, link: str | None = None, kept: Mapping[str, Any] | None = None, *, daemon_failed: bool = False
) -> EstopOutcome:
    """Send the e-stop on the link and through the daemon, and wait half a second for the robot to confirm.

    `link` is what the option --link says; `kept`, what `read_robot_toml` read of the file before, is used where it
    cannot be read now. `daemon_failed`: the daemon was just asked, and is waited for no more before the link is used.

    Raises InputError only when neither it nor the file says where the link is, and no daemon takes the stop either.
    """
    raw, file_error = _read(robot)
    if file_error is not None and kept:
        raw, file_error = dict(kept), None
    socket_path = _socket_path(raw)
    refused = passed_over(socket_path) if socket_path is not None else ()
    try:
        settings, file_error = _settings(robot, raw, file_error, link)
    except InputError as error:
        confirmed, daemon_error = _request_stop(socket_path)
        if daemon_error is not None:
            raise InputError(f"{error}; {_HINT}") from None
        return EstopOutcome("link", str(error), None, confirmed, refused)
    driver = find_driver(settings.driver)
    frames, is_confirmation = driver.stop_frames(settings.settings()), driver.stop_confirmation(settings.settings())
    is_serial = settings.kind == "serial"
    is_exchange = is_serial and driver.exchange is not None
    way = _stop_over_exchange if is_exchange else _stop_over_serial if is_serial else _stop_over_transport
    address = settings.port if is_serial else f"{settings.interface} {settings.channel}"
    outcome = EstopOutcome(address, None, None, False, refused, file_error, driver.latches_stop)
    if not daemon_failed and (is_exchange or (not is_serial and settings.interface in FOR_ONE_PROCESS)):
        # Two that speak at once on a line of exchanges spoil each other's packets, and a second opening of an adapter
        # closes its CAN channel under the daemon: the daemon first, which has the line. A daemon may hang, but over
        # slcan frames can go at once into the channel that it has open.
        if not is_exchange and settings.interface == "slcan":
            with contextlib.suppress(OSError):
                write_to_held_slcan(settings.channel, ESTOP_REPEATS * tuple(frames))
        daemon_confirmed, daemon_error = _request_stop(socket_path)
        if daemon_confirmed or (is_exchange and daemon_error is None):
            return replace(outcome, link_error="left to the daemon, which holds the line", confirmed=daemon_confirmed)
        confirmed, link_error = _attempt(partial(way, settings, frames, is_confirmation))
    else:
        request_stop = partial(_request_stop, socket_path)
        await_daemon = request_stop if is_exchange else _begin(request_stop)
        confirmed, link_error = _attempt(partial(way, settings, frames, is_confirmation))
        daemon_confirmed, daemon_error = await_daemon()
    return replace(outcome, link_error=link_error, daemon_error=daemon_error, confirmed=confirmed or daemon_confirmed)


def read_robot_toml(robot: Path) -> Mapping[str, Any]:
    """Read robot.toml as it is now, to be kept for `stop_robot`; empty if it cannot be read."""
    return _read(robot)[0]


def _attempt(way: Callable[[], bool]) -> tuple[bool, str | None]:
    """Whether the robot confirmed, and why this way failed."""
    try:
        return way(), None
    except Exception as error:  # whatever the medium raises, the daemon is asked as well
        return False, str(error) or type(error).__name__


def _read(robot: Path) -> tuple[dict[str, Any], str | None]:
    """Read robot.toml, and return its contents and, if it cannot be read, the reason."""
    try:
        return read_toml(robot, ROBOT_TOML), None
    except InputError as error:
        return {}, str(error)


def _settings(robot: Path, raw: dict[str, Any], file_error: str | None, option: str | None) -> tuple[Link, str | None]:
    """Return the settings of the link, and why robot.toml did not give them."""
    given = link_fields(option)
    if file_error is None:
        try:
            section = raw.get("link", {})
            if not isinstance(section, dict):
                raise InputError(f"{robot}: link: not a section; write [link] above its fields")
            # A field that is none, misspelt or of another version, must not keep the stop from the robot.
            return link_of(robot, {**section, **given}), None
        except InputError as error:
            file_error = str(error)
    if not names_address(given):
        raise InputError(file_error)
    return msgspec.convert(given, Link), file_error


def _socket_path(raw: dict[str, Any]) -> Path | None:
    with contextlib.suppress(AttributeError, KeyError, TypeError, OSError):
        configured = raw.get("daemon", {}).get("control_socket")
        return Path(configured) if configured else default_socket_path(raw["robot"]["name"])
    return None


def _stop_over_transport(settings: Link, frames: Sequence[Frame], is_confirmation: _IsConfirmation) -> bool:
    # Not exclusive: a daemon that hangs may hold the adapter, and must not be able to keep the stop from the robot.
    transport = open_transport(**settings.medium_fields(), exclusive=False)
    try:
        deadline_ns = time.monotonic_ns() + round(_CONNECT_S * 1e9)
        while transport.state is not LinkState.UP:
            if time.monotonic_ns() > deadline_ns:
                raise ConnectionError(transport.last_error or "the link did not come up")
            time.sleep(0.002)
        requested_ns = time.monotonic_ns()
        for frame in ESTOP_REPEATS * tuple(frames):
            now_ns = time.monotonic_ns()
            if not transport.send(OutgoingFrame(frame, now_ns + ESTOP_LIFE_NS), now_ns):
                raise ConnectionError(transport.last_error or "the frame could not be queued")
        # What was under way before says nothing about this request.
        return _confirmed(lambda: [r for r in transport.receive() if r.t_ns >= requested_ns], is_confirmation)
    finally:
        transport.close()


def _stop_over_serial(settings: Link, frames: Sequence[Frame], is_confirmation: _IsConfirmation) -> bool:
    # Not exclusive: the daemon may hold the port, and must not be able to keep the stop from the robot.
    medium = SerialMedium(settings.port, settings.baud, settings.dtr, settings.rts)
    port = open_port(medium, timeout_s=0.01, write_timeout_s=0.5, exclusive=False)
    try:
        # Opening threw away what came in before. The delimiter ends what another sender may be in the middle of.
        port.write(b"\0" + ESTOP_REPEATS * b"".join(encode_frame(frame.can_id, frame.data) for frame in frames))
        decoder = FrameDecoder()

        def receive() -> list[ReceivedFrame]:
            # Two readers of one port take bytes from each other, which pyserial reports as a lost device.
            with contextlib.suppress(serial.SerialException):
                received = port.read(max(1, port.in_waiting))
                return [ReceivedFrame(time.monotonic_ns(), Frame(*each)) for each in decoder.feed(received)]
            return []

        return _confirmed(receive, is_confirmation)
    finally:
        # While the other end takes nothing the kernel closes the port half a minute later: nobody waits for that.
        _begin(port.close)


def _stop_over_exchange(settings: Link, frames: Sequence[Frame], is_confirmation: _IsConfirmation) -> bool:
    """Packet by packet, each with its reply, again and again until the robot confirms or the time is over."""
    driver = find_driver(settings.driver)
    assert driver.exchange is not None
    medium = SerialMedium(settings.port, settings.baud, settings.dtr, settings.rts)
    with open_port(medium, timeout_s=EXCHANGE_READ_S, write_timeout_s=0.5, exclusive=False) as port:
        line = ExchangeConnection(port, TransportCounters(), driver.exchange(settings.settings()))
        deadline_ns = time.monotonic_ns() + round(_CONFIRM_S * 1e9)
        went_out, confirmed = False, False
        while not confirmed:
            for frame in frames:
                try:
                    reply = line.exchange(frame)
                except serial.SerialException:
                    # Two readers of one port take bytes from each other, which pyserial reports as a lost device.
                    if time.monotonic_ns() > deadline_ns and not went_out:
                        raise
                else:
                    went_out = True
                    received = None if reply is None else ReceivedFrame(time.monotonic_ns(), reply)
                    confirmed = (received is not None and is_confirmation(received)) or confirmed
            if time.monotonic_ns() > deadline_ns:
                break
    return confirmed


def _confirmed(receive: Callable[[], list[ReceivedFrame]], is_confirmation: _IsConfirmation) -> bool:
    """Whether the robot reports the e-stop within the waiting time."""
    deadline_ns = time.monotonic_ns() + round(_CONFIRM_S * 1e9)
    while time.monotonic_ns() < deadline_ns:
        # Each frame counts: several controllers confirm one after the other.
        if True in [is_confirmation(received) for received in receive()]:
            return True
        time.sleep(0.002)
    return False


def _is_served(socket_path: Path) -> bool:
    """Whether there is a socket. Raises WorkError where a stranger could have put it there."""
    try:
        believed_users(socket_path)
    except FileNotFoundError:
        return False
    return socket_path.exists()


def _request_stop(socket_path: Path | None) -> tuple[bool, str | None]:
    try:
        if socket_path is None or not _is_served(socket_path):
            return False, "not running"
        requested_ns = time.monotonic_ns()
        reply = send_request(socket_path, {"do": "estop"}, timeout_s=0.5)
        if not reply.get("ok"):
            return False, str(reply.get("error"))
        link = None
        deadline_ns = time.monotonic_ns() + round(_CONFIRM_S * 1e9)
        while time.monotonic_ns() < deadline_ns:
            status = send_request(socket_path, {"do": "status"}, timeout_s=0.5)
            # What the robot said before the request is no answer to it.
            if status.get("robot_state") == "ESTOP" and status["robot_state_ns"] >= requested_ns:
                return True, None
            link = status.get("link")
            time.sleep(0.02)
        if link not in {None, LinkState.UP.value}:
            return False, f"will send the e-stop as soon as its link is up; the link is {link}"
    except Exception as error:  # a hung or dying daemon must not look like a failure of the link
        return False, str(error) or type(error).__name__
    return False, None


def _begin(work: Callable[[], _T]) -> Callable[[], _T]:
    """Do the work in a thread, or at once if none can be made; returns a function that waits for the result."""
    results: list[_T] = []
    thread = threading.Thread(target=lambda: results.append(work()), daemon=True)
    try:
        thread.start()
    except RuntimeError:
        results.append(work())
        return results.pop

    def wait() -> _T:
        thread.join()
        return results[0]

    return wait


def stop_and_report(robot: Path, link: str | None, as_json: bool) -> int:
    """Stop the robot, print the outcome, and return the exit code: 0 only if the robot confirmed that it is stopped."""
    outcome = stop_robot(robot, link)
    print(json_of(outcome.as_dict()) if as_json else outcome.as_text())
    return 0 if outcome.confirmed else 1
