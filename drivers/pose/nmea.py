"""Positions of a GPS receiver that speaks NMEA 0183, on a serial port or over TCP.

The receiver is read by a process of its own, which runs this file, as ports and networks block: NMEA sentences in,
positions in a local tangent plane out. Taken are GGA (position and quality), GST (its standard deviation), HDT and THS
(heading of two antennas). RMC and VTG give a course over ground, which is no heading for a robot that drives backward
and turns on the spot: the estimator finds that better from the positions.
"""

from __future__ import annotations

import contextlib
import importlib.util
import json
import math
import os
import re
import socket
import subprocess
import sys
import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from drivers.pose import PoseSourceError
from drivers.pose.udp import LONGEST_DATAGRAM, MOST_A_TICK, message_of, pose_of
from drivers.samples import FARTHEST_M, PoseSample

SOURCE = "nmea"
_READER = "drivers.pose.nmea"
# Chosen: the reader wakes every _READ_S; what does not end by then is killed.
_END_TIMEOUT_S = 1.0


def create_pose_source(
    *,
    device: str = "",
    baud: int = 115_200,
    datum: tuple[float, float] | None = None,
    heading_std_rad: float = 0.02,
    **_of_other_sources: Any,
) -> NmeaPoses:
    """Create the NMEA source from the fields of [pose].

    Raises PoseSourceError for a device that is not named, or the library not there.
    """
    if not device:
        raise PoseSourceError('no device; write pose.device = "/dev/serial/by-id/..." or "socket://HOST:PORT"')
    if importlib.util.find_spec("pynmeagps") is None:
        raise PoseSourceError("the library pynmeagps is not installed; run `pip install 'disco-hw[rtk]'`")
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours.setblocking(False)
    settings = {"device": device, "baud": baud, "datum": datum, "heading_std_rad": heading_std_rad}
    with theirs:
        # In a session of its own: Ctrl-C is for the daemon alone.
        process = subprocess.Popen(
            [sys.executable, "-m", _READER, str(theirs.fileno()), json.dumps(settings)],
            pass_fds=[theirs.fileno()],
            stdin=subprocess.DEVNULL,
            start_new_session=True,
        )
    return NmeaPoses(ours, process)


class NmeaPoses:
    """Satisfies `drivers.types.PoseSource` and `drivers.types.MessageSource`."""

    def __init__(self, opened: socket.socket, process: subprocess.Popen[bytes]) -> None:
        self._socket = opened
        self._process = process
        self._ended = False
        self._messages: list[str] = []

    def receive(self, now_ns: int, from_robot: Sequence[PoseSample]) -> Sequence[PoseSample]:
        """Return the poses received since the last call, oldest first; never waits and never raises."""
        poses = []
        with contextlib.suppress(BlockingIOError):
            for _ in range(MOST_A_TICK):
                message = b"" if self._ended else self._received()
                if not message:
                    break
                pose = pose_of(message, now_ns, time.monotonic_ns())
                if isinstance(pose, PoseSample):
                    poses.append(pose)
                elif (text := message_of(message)) is not None:
                    self._messages.append(text)
        return poses

    def new_messages(self) -> Sequence[str]:
        """Return messages for the operator since the last call."""
        messages, self._messages = self._messages, []
        return messages

    def close(self) -> None:
        """Stop the reader process; safe to call twice."""
        self._socket.close()
        self._process.terminate()
        try:
            self._process.wait(_END_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _received(self) -> bytes:
        try:
            message = self._socket.recv(LONGEST_DATAGRAM)
        except BlockingIOError:
            raise
        except OSError:
            message = b""
        if not message:
            self._ended = True
            self._messages.append("the process that reads the GPS receiver has ended; restart the daemon")
        return message


# NMEA 0183 gives times of day, which begin anew at midnight.
DAY_S = 86_400.0
QUALITY_STD_M = {1: 3.0, 2: 0.8, 3: 2.0, 4: 0.02, 5: 0.4}
"""Of a coordinate, where the receiver says none (GST), by the quality of GGA: 1 alone, 2 differential, 3 precise, 4 RTK
with whole wavelengths, 5 without. 0 is no fix; 6, 7 and 8 are reckoned, typed in and simulated: no measurement."""
MEASURED_MODE = "A"
"""Of THS; E, M, S and V are reckoned, typed in, simulated and not valid: no measurement."""
# 0.4 m over a metre between two antennas, as said below.
WIDE_HEADING_STD_RAD = 0.4
WIDE_HEADING_QUALITIES = frozenset({0, 5, 6, 7, 8})
"""With a float fix, or none, the heading of two antennas is off by as much as 0.4 m over a metre between them."""
# Chosen: a receiver may report less than its antenna's place on the robot is known.
_LEAST_STD_M = 0.005
# Chosen: longer than the period of any sentence, so that a heading that comes is not missed.
_HINT_NS = 10_000_000_000
# Chosen: GST may come less often than GGA; two of it may be missed at 1 Hz.
_GST_HOLDS_S = 2.5
# docs/poses.md: position and heading, whichever comes first, wait so long for the other, but half the time to the next
# position at most, or that of another epoch would be taken for it; longer than an epoch's sentences take on the line.
_PAIR_NS = 60_000_000
# Chosen: a receiver that sent no heading for so long no longer makes positions wait for one.
_HEADING_HOLDS_NS = 2_000_000_000
# Chosen: longer finds a smaller delay, shorter follows a drifting clock sooner.
_CLOCK_WINDOW_S = 30.0
# Chosen: above any ground.
_HIGHEST_M = 10_000.0
# WGS 84.
_SEMI_MAJOR_M, _FLATTENING = 6_378_137.0, 1.0 / 298.257223563
# Above NMEA 0183's 82 characters, which receivers exceed in fields of their own.
_LONGEST_LINE = 256
# Talker and type; binary data may hold a dollar sign.
_SENTENCE = re.compile(rb"\$[A-Z]{4}")
# docs/poses.md: above the period of a receiver at 1 Hz, with a sentence or two lost.
_SILENT_S = 3.0
# Chosen: how late a heading's wait ends and an end is noticed.
_READ_S = 0.05
# Chosen: soon after a plug was pulled, later without flooding the console.
_RETRY_S = (0.5, 1.0, 2.0, 5.0)


@dataclass(frozen=True)
class _HeadingSentence:
    """A heading, clockwise from north; `is_wide`: it came while the fix was a float, or there was none."""

    arrival_ns: int
    heading_deg: float
    is_wide: bool


@dataclass(frozen=True)
class TangentPlane:
    """East and north (m) of the datum, on the WGS 84 ellipsoid at the datum's height."""

    latitude_deg: float
    longitude_deg: float
    height_m: float

    def east_north(self, latitude_deg: float, longitude_deg: float, height_m: float) -> tuple[float, float]:
        """Return the position of a place, east and north (m) of the datum, by geocentric coordinates."""
        here = _geocentric(latitude_deg, longitude_deg, height_m)
        datum = _geocentric(self.latitude_deg, self.longitude_deg, self.height_m)
        dx, dy, dz = (a - b for a, b in zip(here, datum, strict=True))
        latitude, longitude = math.radians(self.latitude_deg), math.radians(self.longitude_deg)
        outward = math.cos(longitude) * dx + math.sin(longitude) * dy
        east = -math.sin(longitude) * dx + math.cos(longitude) * dy
        return east, -math.sin(latitude) * outward + math.cos(latitude) * dz


def _geocentric(latitude_deg: float, longitude_deg: float, height_m: float) -> tuple[float, float, float]:
    latitude, longitude = math.radians(latitude_deg), math.radians(longitude_deg)
    squared = _FLATTENING * (2.0 - _FLATTENING)
    curve = _SEMI_MAJOR_M / math.sqrt(1.0 - squared * math.sin(latitude) ** 2)
    across = (curve + height_m) * math.cos(latitude)
    upward = ((1.0 - squared) * curve + height_m) * math.sin(latitude)
    return across * math.cos(longitude), across * math.sin(longitude), upward


class ReceiverClock:
    """The host's time of a fix: the receiver's own time, shifted by the least delay seen lately.

    A line is late by the port's and the network's moods; the receiver's stamps are not. What all lines are late by,
    `pose.latency_s` says.
    """

    def __init__(self) -> None:
        self._offsets: deque[tuple[float, float]] = deque()
        self._days, self._last_s, self._last_arrival_s = 0.0, 0.0, 0.0

    def host_ns(self, time_of_day_s: float, arrival_ns: int) -> int:
        """Return when a fix of this time was true, at the latest."""
        step_s, arrival_s = time_of_day_s - self._last_s, arrival_ns * 1e-9
        if step_s < -0.5 * DAY_S:
            self._days += DAY_S
        elif step_s <= 0.0 and arrival_s - self._last_arrival_s - step_s > 0.5:
            # The receiver has set its time back: the offsets before are too small. A line that is late goes on in time,
            # and a time that is set forward has the smallest offset at once.
            self._offsets.clear()
        self._last_s, self._last_arrival_s = time_of_day_s, arrival_s
        receiver_s = self._days + time_of_day_s
        self._offsets.append((receiver_s, arrival_s - receiver_s))
        while receiver_s - self._offsets[0][0] > _CLOCK_WINDOW_S:
            self._offsets.popleft()
        return min(arrival_ns, round(1e9 * (receiver_s + min(offset for _, offset in self._offsets))))


@dataclass
class Fixes:
    """Conversion of NMEA sentences into poses: `add_line` each with its arrival, `flush` now and then; pure.

    What they give is a datagram's map (`drivers.pose.udp`), or {"said": sentence} where something changed for the worse
    or the better. A heading belongs to one position: that which waits for it, or else the next one, if it comes soon.
    """

    datum: tuple[float, float] | None = None
    heading_std_rad: float = 0.02
    malformed: int = 0
    _plane: TangentPlane | None = None
    _quality: int | None = None
    _gst: tuple[float, float] | None = None
    _heading: _HeadingSentence | None = None
    _unused_heading: _HeadingSentence | None = None
    _waiting: dict[str, Any] | None = None
    _waits_since_ns: int = 0
    _waits_for_ns: int = _PAIR_NS
    _position_time_s: float | None = None
    _height_m: float | None = None
    _first_ns: int | None = None
    _heading_mode: str = "A"
    _is_heading_lost: bool = False
    _reported: set[str] = field(default_factory=set)
    _far: bool = False
    _clock: ReceiverClock = field(default_factory=ReceiverClock)

    def add_line(self, line: bytes, arrival_ns: int) -> list[dict[str, Any]]:
        """Take in one line as it came."""
        from pynmeagps import NMEAReader  # noqa: PLC0415
        from pynmeagps.exceptions import NMEAMessageError, NMEAParseError, NMEATypeError  # noqa: PLC0415

        ready = self.flush(arrival_ns)
        try:
            return ready + self._handle(NMEAReader.parse(line), arrival_ns)
        except (NMEAParseError, NMEAMessageError, NMEATypeError, ValueError, IndexError, KeyError, AttributeError):
            # A field that the sentence lacks is no attribute of its message: AttributeError.
            self.malformed += 1
            return ready

    def flush(self, now_ns: int) -> list[dict[str, Any]]:
        """Give the position that has waited for a heading long enough."""
        return [] if now_ns - self._waits_since_ns < self._waits_for_ns else self._end_wait()

    def _end_wait(self) -> list[dict[str, Any]]:
        """Give the position that waits for a heading, without one."""
        waiting, self._waiting = self._waiting, None
        return [] if waiting is None else [waiting]

    def _handle(self, message: Any, arrival_ns: int) -> list[dict[str, Any]]:
        kind = "" if message is None else message.msgID
        if kind == "GST":
            self._handle_deviation(message)
        elif kind == "HDT":
            return self._handle_heading(message.headingT, arrival_ns)
        elif kind == "THS":
            mode, heading_deg = str(message.mi), message.headt
            notes = self._mode_messages(mode)
            return notes + self._handle_heading(heading_deg, arrival_ns) if mode == MEASURED_MODE else notes
        elif kind == "GGA":
            return self._handle_position(message, arrival_ns)
        return []

    def _handle_deviation(self, message: Any) -> None:
        time_s, deviations = _time_of_day_s(message.time), (message.stdLat, message.stdLong)
        if time_s is not None and all(isinstance(one, float) and 0.0 < one < math.inf for one in deviations):
            self._gst = (time_s, max(deviations))

    def _handle_heading(self, heading_deg: Any, arrival_ns: int) -> list[dict[str, Any]]:
        if not isinstance(heading_deg, float) or not 0.0 <= heading_deg <= 360.0:
            return []
        self._heading = _HeadingSentence(arrival_ns, heading_deg, self._quality in WIDE_HEADING_QUALITIES)
        notes = [{"said": "headings received again"}] if self._is_heading_lost else []
        self._is_heading_lost = False
        waiting = self._end_wait()
        self._unused_heading = None if waiting else self._heading
        return notes + [self._with_heading(position, self._heading) for position in waiting]

    def _handle_position(self, message: Any, arrival_ns: int) -> list[dict[str, Any]]:
        quality, time_s, hdop = message.quality, _time_of_day_s(message.time), message.HDOP
        latitude_deg, longitude_deg, altitude_m, separation_m = message.lat, message.lon, message.alt, message.sep
        if quality != self._quality and self._gst is not None and self._gst[0] != time_s:
            # It was of the quality before.
            self._gst = None
        notes = self._quality_messages(quality)
        if quality not in QUALITY_STD_M:
            return notes
        if time_s is None or not (_is_within(latitude_deg, 90.0) and _is_within(longitude_deg, 180.0)):
            return notes + self._without_repeats("GGA sentences lack time, latitude or longitude and give no position")
        height_m, height_notes = self._height_of(altitude_m, separation_m)
        notes += height_notes + self._heading_hint(arrival_ns)
        if self._plane is None:
            latitude, longitude = self.datum or (latitude_deg, longitude_deg)
            self._plane = TangentPlane(latitude, longitude, height_m)
            notes.append({"said": f"datum: latitude {latitude:.8f}, longitude {longitude:.8f}"})
        east_m, north_m = self._plane.east_north(latitude_deg, longitude_deg, height_m)
        notes += self._range_messages(math.hypot(east_m, north_m))
        position = {
            "t_ns": self._clock.host_ns(time_s, arrival_ns),
            "x_m": east_m,
            "y_m": north_m,
            "position_std_m": self._deviation_m(quality, time_s, hdop),
        }
        notes += self._end_wait()
        self._waits_for_ns = self._longest_wait_ns(time_s)
        heading, self._unused_heading = self._unused_heading, None
        if heading is not None and arrival_ns - heading.arrival_ns < self._waits_for_ns:
            return [*notes, self._with_heading(position, heading)]
        if self._heading is None or arrival_ns - self._heading.arrival_ns > _HEADING_HOLDS_NS:
            return [*notes, position]
        self._waiting, self._waits_since_ns = position, arrival_ns
        return notes

    def _longest_wait_ns(self, time_s: float) -> int:
        """Return how far apart this position and its heading may come."""
        before_s, self._position_time_s = self._position_time_s, time_s
        epoch_s = 0.0 if before_s is None else abs(math.remainder(time_s - before_s, DAY_S))
        return min(_PAIR_NS, round(0.5e9 * epoch_s) or _PAIR_NS)

    def _deviation_m(self, quality: int, time_s: float, hdop: Any) -> float:
        if self._gst is not None and abs(math.remainder(time_s - self._gst[0], DAY_S)) < _GST_HOLDS_S:
            return max(self._gst[1], _LEAST_STD_M)
        usual = QUALITY_STD_M[quality]
        return usual * max(hdop, 1.0) if isinstance(hdop, float) else usual

    def _height_of(self, altitude_m: Any, separation_m: Any) -> tuple[float, list[dict[str, Any]]]:
        """Return the height over the ellipsoid: the fix's, else the last known one, else 0.

        The plane's scale hangs on it.
        """
        if _is_within(altitude_m, _HIGHEST_M):
            self._height_m = altitude_m + (separation_m if _is_within(separation_m, _HIGHEST_M) else 0.0)
            return self._height_m, []
        source_text = "0 m" if self._height_m is None else f"the last height, {self._height_m:.1f} m"
        return self._height_m or 0.0, self._without_repeats(
            f"GGA sentences lack an altitude; used instead: {source_text}"
        )

    def _with_heading(self, position: dict[str, Any], heading: _HeadingSentence) -> dict[str, Any]:
        """Clockwise from north, as the receiver says it, to counter-clockwise from east."""
        yaw_rad = math.remainder(math.radians(90.0 - heading.heading_deg), math.tau)
        is_wide = heading.is_wide or self._quality in WIDE_HEADING_QUALITIES
        std_rad = max(WIDE_HEADING_STD_RAD, self.heading_std_rad) if is_wide else self.heading_std_rad
        return {**position, "yaw_rad": yaw_rad, "yaw_std_rad": std_rad}

    def _heading_hint(self, arrival_ns: int) -> list[dict[str, Any]]:
        """Return which sentence brings a heading, once, where none has ever come; else each loss of it."""
        first_ns = self._first_ns = arrival_ns if self._first_ns is None else self._first_ns
        last_ns = first_ns if self._heading is None else self._heading.arrival_ns
        if self._is_heading_lost or arrival_ns - last_ns < _HINT_NS:
            return []
        if self._heading is not None:
            self._is_heading_lost = True
            return [{"said": f"no heading for {_HINT_NS // 1_000_000_000} s; positions only"}]
        return self._without_repeats(
            "the receiver sends no heading, positions only; if it has two antennas, switch on its sentence HDT or THS"
        )

    def _mode_messages(self, mode: str) -> list[dict[str, Any]]:
        before, self._heading_mode = self._heading_mode, mode
        if mode == before:
            return []
        why = {"V": "not valid", "E": "reckoned", "M": "entered by hand", "S": "simulated"}.get(
            mode, "of an unknown mode"
        )
        used = mode == MEASURED_MODE
        return [{"said": f"THS: the heading is {'measured again' if used else f'{why} ({mode}) and not used'}"}]

    def _without_repeats(self, text: str) -> list[dict[str, Any]]:
        if text in self._reported:
            return []
        self._reported.add(text)
        return [{"said": text}]

    def _range_messages(self, away_m: float) -> list[dict[str, Any]]:
        before, self._far = self._far, away_m > FARTHEST_M
        if self._far is before or not self._far:
            return []
        return [
            {
                "said": f"the position is {away_m:.0f} m from the datum, and {FARTHEST_M:.0f} m is the farthest "
                "allowed; correct pose.datum"
            }
        ]

    def _quality_messages(self, quality: int) -> list[dict[str, Any]]:
        before, self._quality = self._quality, quality
        if quality == before:
            return []
        names = {0: "no fix: the antenna needs a clear view of the sky", 4: "RTK fix", 5: "RTK with float ambiguities"}
        unused = "" if quality in QUALITY_STD_M else "; its positions are not used"
        return [{"said": f"fix quality {quality}: {names.get(quality, 'not RTK')}{unused}"}]


def _is_within(number: Any, limit: float) -> bool:
    """Whether a sentence's field is a number of this size at most; an empty field is a string."""
    return isinstance(number, float) and abs(number) <= limit


def _time_of_day_s(message: Any) -> float | None:
    if not hasattr(message, "microsecond"):
        return None
    return float(3600.0 * message.hour + 60.0 * message.minute + message.second + 1e-6 * message.microsecond)


def _lines(device: str, baud: int) -> Iterator[tuple[bytes, str | None]]:
    """Lines as they come, empty ones where none has come for a moment, and words where something is wrong; endless."""
    import serial  # noqa: PLC0415

    # A server that lost its power says nothing on its old connection, ever; a serial port goes on by itself.
    is_network = "://" in device
    hint = "connecting again; check the receiver" if is_network else "check the receiver and pose.baud"
    tries, is_silent = 0, False
    while True:
        try:
            with serial.serial_for_url(device, baudrate=baud, timeout=_READ_S) as port:
                if not is_silent:
                    yield b"", f"{device}: open"
                received_s, kept = time.monotonic(), b""
                while True:
                    kept += port.read(max(1, min(port.in_waiting, _LONGEST_LINE)))
                    *lines, kept = kept.split(b"\n")
                    for after_newline in lines:
                        # A binary block of the receiver's own protocol ends with no newline.
                        line = after_newline[max(after_newline.rfind(b"$"), 0) :]
                        if _SENTENCE.match(line):
                            received_s, tries = time.monotonic(), 0
                            if is_silent:
                                is_silent = False
                                yield b"", f"{device}: NMEA sentences received again"
                        yield line + b"\n", None
                    kept = kept[-_LONGEST_LINE:]
                    if time.monotonic() - received_s > _SILENT_S:
                        if not is_silent:
                            is_silent = True
                            yield b"", f"{device}: no NMEA sentence for {_SILENT_S:.0f} s; {hint}"
                        if is_network:
                            break
                    yield b"", None
        except (OSError, ValueError) as error:
            is_silent = False
            # serial.SerialException is an OSError.
            yield b"", f"{device}: {error}; trying again until it is there"
        wait_s = _RETRY_S[min(tries, len(_RETRY_S) - 1)]
        tries += 1
        until_s = time.monotonic() + wait_s
        while time.monotonic() < until_s:
            time.sleep(_READ_S)
            yield b"", None


def main(descriptor: int, settings: dict[str, Any]) -> None:
    """Read until the daemon has gone."""
    to_daemon = socket.socket(fileno=descriptor)
    parent, last_message = os.getppid(), ""
    datum = settings["datum"]
    fixes = Fixes(None if datum is None else tuple(datum), settings["heading_std_rad"])
    for line, messages in _lines(settings["device"], settings["baud"]):
        now_ns = time.monotonic_ns()
        ready = fixes.add_line(line, now_ns) if line else fixes.flush(now_ns)
        if messages is not None and messages != last_message:
            ready.append({"said": messages})
        last_message = messages or last_message
        if os.getppid() != parent:
            return
        try:
            for each in ready:
                to_daemon.send(json.dumps(each).encode())
        except OSError:
            return


if __name__ == "__main__":
    main(int(sys.argv[1]), json.loads(sys.argv[2]))
