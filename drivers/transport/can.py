"""Any CAN bus that python-can can open: classic frames with identifiers of 11 and 29 bits."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import socket
import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from types import MappingProxyType
from typing import Any

import can
from can.interfaces import VALID_INTERFACES

from drivers.transport.reconnecting import (
    MUTE_AFTER_S,
    LinkLostError,
    LinkMuteError,
    ReconnectingTransport,
    TransmitBusyError,
    TransportCounters,
    TransportSettingsError,
)
from drivers.transport.serial import READ_TIMEOUT_S, WRITE_TIMEOUT_S, error_number, explain_port, plain
from drivers.types import MAX_EXTENDED_ID, Frame, ReceivedFrame
from firmware_protocol.serial_framing import MAX_CAN_ID, MAX_DATA

# Classes of an error frame (linux/can/error.h). Of the errors among them: transmit timeout, lost arbitration, protocol
# violation, transceiver fault, no acknowledgement, bus error.
_ERROR_CLASSES = 0x001 | 0x002 | 0x008 | 0x010 | 0x020 | 0x080
_CONTROLLER_CLASS, _BUS_OFF_CLASS = 0x004, 0x040
# States of the controller in its second byte; above the errors is only that it is active again.
_CONTROLLER_ERRORS, _RECEIVE_OVERFLOW = 0x3F, 0x01
# Chosen: longer than a frame waits for a loaded bus; until then an equal frame of another host counts as the echo.
ECHO_NS = 1_000_000_000
# Of a bus whose library or system is not here; where a library was not loaded, some of python-can use it all the same.
_NOT_HERE = (can.CanInterfaceNotImplementedError, ImportError, NameError)
KIND = "can"
# Chosen: longer than a frame waits for the reading thread, and shorter than most steps of a clock.
MAX_STAMP_AGE_S = 1.0
# Chosen: a few invalid lines follow every opening of an adapter; so many are a wrong speed or firmware.
GARBAGE_LIMIT = 50
# IFF_UP of linux/if.h.
_INTERFACE_UP_FLAG = 0x1
# Chosen: longer than a server of the local network takes to answer; a connection that fails is tried again.
_PROBE_TIMEOUT_S = 1.0
_ECHO_OPTION = "receive_own_messages"
_ECHOING_INTERFACES = frozenset({"udp_multicast", "gs_usb"})
SLCAN_BITRATES = (10_000, 20_000, 50_000, 83_300, 100_000, 125_000, 250_000, 500_000, 750_000, 1_000_000)
OVER_A_TTY = frozenset({"slcan", "serial", "seeedstudio", "robotell"})
"""Interfaces over a serial port."""
FOR_ONE_PROCESS = OVER_A_TTY | {"gs_usb"}
"""Interfaces to an adapter whose CAN channel a second opening resets, or closes when it ends, for both."""
MAY_STAY_MUTE = FOR_ONE_PROCESS | {"socketcand"}
"""Interfaces that can be open and lead nowhere, without an error of the adapter, port or connection."""
_NAMED_FIELDS = ("interface", "channel", "bitrate", "ignore_config")
_GS_USB_DEVICE = {"index", "bus", "address"}
_NEEDED_OPTIONS = {"socketcand": ("host", "port")}
_PACKAGES = {
    "canalystii": ("canalystii", "canalystii"),
    "cantact": ("cantact", "cantact"),
    "gs_usb": ("gs_usb", "gs-usb"),
    "neovi": ("ics", "python-ics"),
    "udp_multicast": ("msgpack", "msgpack"),
}
"""By interface: the module that it imports, and the package that holds it."""


def create_transport(
    *,
    interface: str = "socketcan",
    channel: str = "can0",
    bitrate: int = 500_000,
    options: Mapping[str, Any] = MappingProxyType({}),
    exclusive: bool = True,
    **_of_other_media: Any,
) -> ReconnectingTransport:
    """Make a link over a CAN bus by the fields of robot.toml's [link]; `exclusive` as `CanMedium` has it.

    Raises TransportSettingsError for an interface, option or bit rate (bit/s) that does not exist, and for an interface
    whose Python package is not installed.
    """
    _check_can(interface, bitrate, options)
    mute_after_s = MUTE_AFTER_S if interface in MAY_STAY_MUTE else None
    return ReconnectingTransport(
        CanMedium(interface, channel, bitrate, options, exclusive), mute_after_s=mute_after_s, carries_extended=True
    )


def _check_can(interface: str, bitrate: int, options: Mapping[str, Any]) -> None:
    if interface not in VALID_INTERFACES:
        known = ", ".join(sorted(VALID_INTERFACES))
        raise TransportSettingsError(f'link.interface: python-can has no interface "{interface}"; write one of {known}')
    if interface == "slcan" and bitrate not in SLCAN_BITRATES:
        known = ", ".join(map(str, SLCAN_BITRATES))
        raise TransportSettingsError(f"link.bitrate: slcan has no {bitrate} bit/s; write one of {known}")
    for name in _NAMED_FIELDS:
        if name in options:
            raise TransportSettingsError(f"link.options: {name} has a field of its own; write it as link.{name}")
    missing = [name for name in _NEEDED_OPTIONS.get(interface, ()) if name not in options]
    if missing:
        raise TransportSettingsError(
            f"link.options: {interface} needs {' and '.join(missing)}; write options = "
            '{ host = "192.168.1.5", port = 29536 }'
        )
    module, package = _PACKAGES.get(interface, (None, ""))
    if module is not None and find_spec(module) is None:
        raise TransportSettingsError(
            f"link.interface: {interface} needs the Python package {package}, which is not installed; "
            f"run: pip install {package}"
        )


@dataclass(frozen=True, slots=True)
class CanMedium:
    """A CAN bus by python-can's interface name: "socketcan", "slcan", "unixcan", "virtual" and all others.

    `bitrate` is in bit/s; a socketcan interface has its own, set by `ip link`. `options` go to the python-can interface
    as they are. `exclusive`: whether an adapter behind a serial port is opened for this process alone.
    """

    interface: str
    channel: str
    bitrate: int
    options: Mapping[str, Any] = field(default_factory=dict)
    exclusive: bool = True

    @property
    def name(self) -> str:
        """Name of the bus by interface and channel."""
        return f"{self.interface} {self.channel}"

    def connect(self, counters: TransportCounters) -> CanConnection:
        """Open the CAN bus.

        Raises what python-can raises, LinkLostError for a socketcan interface that cannot work yet.
        """
        options: dict[str, Any] = {}
        if self.interface == "socketcan":
            require_working_interface(self.channel)
        else:
            options["bitrate"] = self.bitrate
        if self.interface == "slcan":
            # Its default is two seconds for boards that restart when the port opens; it polls at 1 kHz as well.
            options |= {"sleep_after_open": 0.0, "timeout": READ_TIMEOUT_S}
        if self.interface == "gs_usb" and self.channel.isdecimal() and not _GS_USB_DEVICE & self.options.keys():
            # python-can counts the adapters by the channel only if that is no text.
            options["index"] = int(self.channel)
        options |= self.options
        if self.interface == "socketcand":
            require_server(str(options["host"]), int(options["port"]))
        echoes = self.interface in _ECHOING_INTERFACES or bool(self.options.get(_ECHO_OPTION))
        with contextlib.ExitStack() as held:
            if self.exclusive and self.interface in OVER_A_TTY and "://" not in self.channel:
                held.callback(os.close, lock_port(self.channel))
            # Without ignore_config a file in the user's home could change what is opened.
            bus = can.Bus(interface=self.interface, channel=self.channel, ignore_config=True, **options)
            return CanConnection(bus, counters, SentFrames() if echoes else None, held.pop_all())

    def explain(self, error: Exception) -> str:
        """Say in one line what the error means and what to do."""
        number = error_number(error)
        text = plain(error)
        if isinstance(error, LinkMuteError):
            where = "the adapter"
            if self.interface in OVER_A_TTY:
                where += " (its number may have changed: use its name in /dev/serial/by-id)"
            text = f"{error}; check the robot's power, the bit rate and {where}"
        elif isinstance(error, LinkLostError):
            text = str(error)
        elif isinstance(error, TypeError):
            text = f"link.options do not fit this interface ({error}); correct them"
        elif isinstance(error, _NOT_HERE):
            text = f"cannot be used here ({text}); install its maker's driver, or use another interface"
        elif type(error).__name__ == "NoBackendError":
            text = "libusb is missing; run: sudo apt-get install libusb-1.0-0"
        elif self.interface == "socketcan" and number in (hints := self._socketcan_hints()):
            text = hints[number]
        elif self.interface in OVER_A_TTY and number is not None:
            return explain_port(self.channel, error)
        elif number in (errno.ENOENT, errno.ECONNREFUSED):
            text = "nothing listens there; start the other end first"
        return f"{self.name}: {text}"

    def _socketcan_hints(self) -> Mapping[int | None, str]:
        bring_up = f"sudo ip link set {self.channel} up"
        if self.channel.startswith("vcan"):
            create = f"run: sudo ip link add dev {self.channel} type vcan && {bring_up}"
        else:
            bring_up += f" type can bitrate {self.bitrate}"
            create = f"plug the adapter in and run: {bring_up}"
        check = f"check that another node is on the bus (ip -details link show {self.channel})"
        return {
            errno.ENODEV: f"no such CAN interface; {create}",
            errno.ENETDOWN: f"the interface is down; run: {bring_up}",
            errno.EAFNOSUPPORT: "this kernel has no CAN; load it with: sudo modprobe can_raw, or use another interface",
            errno.ENOBUFS: f"transmit queue full; {check}",
        }


class CanConnection:
    """An open python-can bus; satisfies `drivers.transport.reconnecting.Connection`.

    Whether a frame "is_rx" is not asked: on a virtual CAN every frame of another local process says it is not.
    """

    def __init__(
        self,
        bus: can.BusABC,
        counters: TransportCounters,
        sent_frames: SentFrames | None = None,
        held: contextlib.ExitStack | None = None,
    ) -> None:
        """Wrap an open bus; `sent_frames` is for a bus that returns a sender's own frames, which are then dropped.

        `held` is closed with the bus.
        """
        self._bus = bus
        self._counters = counters
        self._sent_frames = sent_frames
        self._held = held or contextlib.ExitStack()
        self._garbage = 0

    def read(self) -> Sequence[ReceivedFrame]:
        """Wait 0.1 s at most for a frame; raises LinkLostError at bus-off, and what python-can raises."""
        try:
            message = self._bus.recv(READ_TIMEOUT_S)
        except (ValueError, IndexError) as error:
            self._handle_garbage(error)
            return ()
        except can.CanError as error:
            # slcan: a byte that is no text makes every later call fail until the buffer is flushed. udp_multicast: what
            # is no frame fails in one of these ways.
            if not isinstance(error.__cause__, (ValueError, TypeError, AttributeError)):
                raise
            self._handle_garbage(error)
            return ()
        if message is None:
            return ()
        now_ns, wall_now_ns = time.monotonic_ns(), time.time_ns()
        if message.is_error_frame:
            self._handle_error_frame(message)
            return ()
        data = bytes(message.data)
        if (
            message.is_remote_frame
            or message.is_fd
            or message.arbitration_id > (MAX_EXTENDED_ID if message.is_extended_id else MAX_CAN_ID)
            or len(data) > MAX_DATA
            or len(data) != message.dlc
        ):
            self._counters.add(malformed=1)
            return ()
        self._garbage = 0
        frame = Frame(message.arbitration_id, data, message.is_extended_id)
        if self._sent_frames is not None and self._sent_frames.is_echo(now_ns, frame):
            return ()
        return (ReceivedFrame(monotonic_stamp_ns(message.timestamp, wall_now_ns, now_ns), frame),)

    def write(self, frame: Frame) -> None:
        """Send one frame, waiting 0.05 s at most; raises TransmitBusyError if there was no room."""
        message = can.Message(arbitration_id=frame.can_id, data=frame.data, is_extended_id=frame.extended, check=True)
        if self._sent_frames is not None:
            self._sent_frames.sent(time.monotonic_ns(), frame)
        try:
            self._bus.send(message, timeout=WRITE_TIMEOUT_S)
        except (can.CanError, OSError) as error:
            if self._sent_frames is not None:
                self._sent_frames.not_sent(frame)
            if is_busy(error):
                raise TransmitBusyError(str(error)) from error
            raise

    def close(self) -> None:
        """Shut the bus down; may raise what python-can raises on a device that is gone."""
        with self._held:
            try:
                self._bus.shutdown()
            finally:
                # slcan gives up before it closes the port, and a tty still held comes back under another name.
                port = getattr(self._bus, "serialPortOrig", None)
                if port is not None:
                    port.close()

    def _handle_garbage(self, error: Exception) -> None:
        flush = getattr(self._bus, "flush", None)
        if flush is not None:
            flush()
        self._counters.add(malformed=1)
        self._garbage += 1
        if self._garbage >= GARBAGE_LIMIT:
            raise LinkLostError(
                f"only invalid data arrive ({error}); check the adapter's firmware and serial speed"
            ) from error

    def _handle_error_frame(self, message: can.Message) -> None:
        counts = error_counts(message.arbitration_id, bytes(message.data))
        self._counters.add(**counts)
        if counts["bus_off"]:
            raise LinkLostError(
                "bus-off: the controller has left the bus after too many errors; check wiring, termination and bit rate"
            )


def monotonic_stamp_ns(timestamp_s: float, wall_now_ns: int, now_ns: int) -> int:
    """Turn python-can's stamp of a frame (seconds, the wall clock where the kernel stamps) into monotonic nanoseconds.

    The wall clock is read together with the monotonic one on reception, so a later step of it does no harm. A stamp
    that is not of the last second is of another clock (or the clock was stepped): then the reception counts.
    """
    age_ns = wall_now_ns - round(timestamp_s * 1e9)
    if 0 <= age_ns <= MAX_STAMP_AGE_S * 1e9:
        return now_ns - age_ns
    return now_ns


def is_busy(error: Exception) -> bool:
    """Whether a send failed only for want of room in a queue, so that a later attempt may succeed."""
    if error_number(error) == errno.ENOBUFS or isinstance(error, TimeoutError):
        return True
    seen: BaseException | None = error
    while seen is not None:
        # socketcan has no error number for a full socket buffer, pyserial none for a write timeout.
        if "Transmit buffer full" in str(seen) or "Write timeout" in str(seen):
            return True
        seen = seen.__cause__
    return False


def lock_port(channel: str) -> int:
    """Lock the serial port of a python-can channel (PORT or PORT@BAUD) as pyserial does, and return a descriptor of it.

    python-can has no such option, and a second link would write to the adapter before it could lock the port itself.
    Raises OSError where the port is absent or locked.
    """
    port = os.open(channel.partition("@")[0], os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        fcntl.flock(port, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(port)
        raise
    return port


def write_to_held_slcan(channel: str, frames: Sequence[Frame]) -> None:
    """Write frames to an slcan adapter that another process holds, whose CAN channel stays as it is; else do nothing.

    Raises OSError where the port is absent or takes nothing more.
    """
    port = os.open(channel.partition("@")[0], os.O_WRONLY | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        fcntl.flock(port, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        lines = [
            f"{f'T{frame.can_id:08X}' if frame.extended else f't{frame.can_id:03X}'}"
            f"{len(frame.data)}{frame.data.hex().upper()}"
            for frame in frames
        ]
        # The first return ends what the other process may be in the middle of.
        os.write(port, "\r".join(["", *lines, ""]).encode())
    finally:
        os.close(port)


def require_server(host: str, port: int) -> None:
    """Raise OSError where nothing listens, LinkLostError where a server sends no greeting.

    python-can would try again without a pause for ten seconds, and would wait for the greeting without end.
    """
    with socket.create_connection((host, port), _PROBE_TIMEOUT_S) as probe:
        try:
            probe.recv(64)
        except TimeoutError:
            raise LinkLostError(
                "the server sends no greeting; it may serve one client alone: end the other program that uses it, "
                "else restart it, or correct host and port"
            ) from None


def require_working_interface(channel: str, sysfs: Path = Path("/sys/class/net")) -> None:
    """Refuse a socketcan interface on which nothing can be sent: one that is absent, down, or in bus-off.

    After bus-off the kernel swallows what is sent without an error, so an open socket there says nothing.
    Raises OSError (ENODEV, ENETDOWN) or LinkLostError.
    """
    try:
        socket.if_nametoindex(channel)
    except OSError:
        raise OSError(errno.ENODEV, "no such CAN interface") from None
    try:
        up = int((sysfs / channel / "flags").read_text(), 16) & _INTERFACE_UP_FLAG
        carrier = (sysfs / channel / "carrier").read_text().strip() != "0" if up else False
    except (OSError, ValueError):
        return
    if not up:
        raise OSError(errno.ENETDOWN, "the interface is down")
    if not carrier:
        raise LinkLostError(
            f"the interface is in bus-off; check wiring, termination and bit rate, then run: "
            f"sudo ip link set {channel} type can restart (or set it up with restart-ms 100)"
        )


class SentFrames:
    """For buses that hand a sender its own frames; a sending and a receiving thread may use it at once.

    Each frame sent excuses one equal frame received within a second. So a second host is seen even if it sends the
    same: of two equal frames only one is excused.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._sent: deque[tuple[int, Frame]] = deque()

    def sent(self, now_ns: int, frame: Frame) -> None:
        """Note a frame, before it is handed to the bus: its echo can be faster than the call that sends it."""
        with self._lock:
            self._drop_old(now_ns)
            self._sent.append((now_ns, frame))

    def not_sent(self, frame: Frame) -> None:
        """Take back the newest note of a frame that the bus did not take."""
        with self._lock:
            for index in range(len(self._sent) - 1, -1, -1):
                if self._sent[index][1] == frame:
                    del self._sent[index]
                    return

    def is_echo(self, now_ns: int, frame: Frame) -> bool:
        """Whether a received frame is one's own; each note counts once."""
        with self._lock:
            self._drop_old(now_ns)
            for index, (_, sent) in enumerate(self._sent):
                if sent == frame:
                    del self._sent[index]
                    return True
        return False

    def _drop_old(self, now_ns: int) -> None:
        while self._sent and now_ns - self._sent[0][0] > ECHO_NS:
            self._sent.popleft()


def error_counts(error_class: int, data: bytes) -> dict[str, int]:
    """Return the transport's counters of an error frame's class bits (its identifier) and data of any length.

    What only reports a recovery (controller active again, restarted) or its own counters is no bus error.
    """
    controller = data[1] if error_class & _CONTROLLER_CLASS and len(data) > 1 else 0
    is_bus_off = bool(error_class & _BUS_OFF_CLASS)
    is_error = bool(error_class & _ERROR_CLASSES or controller & _CONTROLLER_ERRORS)
    return {
        "bus_off": int(is_bus_off),
        "bus_errors": int(is_error and not is_bus_off),
        "receive_overflow": int(bool(controller & _RECEIVE_OVERFLOW)),
    }
