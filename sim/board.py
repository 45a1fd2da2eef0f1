"""A virtual robot around somebody's board: the plant here, the firmware there, and between them the plant's line.

The other end is firmware_protocol/ports/plant_line.c. `BoardRobot` satisfies `sim.virtual_robot.Robot`, `PlantLine`
`sim.RobotLink`; the frames between them are those of this line, and the board's own link is not seen here.
"""

from __future__ import annotations

import math
import os
import struct
import sys
import time
from collections import deque
from collections.abc import Sequence

import serial

from drivers.transport.serial import SerialMedium, open_port
from drivers.types import Frame, ReceivedFrame
from firmware_protocol.codec import Codec
from firmware_protocol.firmware_core import FirmwareInputs, FirmwareOutputs, ResetCause
from firmware_protocol.serial_framing import FrameDecoder, encode_frame
from sim import LinkFaultError
from sim.bus import BusFault
from sim.injected_faults import RobotFaults
from sim.plant import Plant
from sim.python_can_link import RETRY_NS
from sim.sensors import PoseMeasurement
from sim.virtual_robot import sensor_inputs

# Frames of the plant's line, as firmware_protocol/ports/plant_line.c has them, which also brakes after SILENT_US.
WHEELS, POWER, POSITION, HEADING = 0x7E0, 0x7E1, 0x7E2, 0x7E3
SETPOINTS, STATE, ABOUT = 0x7E8, 0x7E9, 0x7EA
VERSION = 1
WHEELS_STEPS = 2
POWER_STEPS = 20
SILENT_US = 100_000
# Chosen: longer than a board takes to restart, which is no reason for a message.
SILENCE_NS = 1_000_000_000
# Speeds in 16 bits, by plant_line.c's SPEED_UNIT.
_PER_RAD_S = 500
_LARGEST_I16 = 2**15 - 1


class BoardRobot:
    """A plant that does what a board says, and says what the board's sensors would.

    `about` is the board's introduction once it has come: version of the line, ticks per turn. A board that has said
    nothing for 0.1 s drives nothing: the wheels brake.
    """

    def __init__(self, plant: Plant) -> None:
        self.plant = plant
        self.estop_button = False
        self.faults = RobotFaults()
        self.about: tuple[int, int] | None = None
        self._setpoints = (0.0, 0.0)
        self._state = (0, 0, 0, 0)
        self._session = 0
        self._received_us = -SILENT_US
        self._steps = 0
        codec = Codec()
        self._state_names = tuple(codec.choice_name("SYSTEM_STATE", "state", value) for value in range(256))

    @property
    def silent(self) -> bool:
        """Whether the board has not been heard for so long that its wheels are braked."""
        return self.plant.now_us - self._received_us >= SILENT_US

    @property
    def outputs(self) -> FirmwareOutputs:
        """Return the board's last outputs; zeros if they are too old."""
        flags, state, fault, accepted = self._state
        left, right = (0.0, 0.0) if self.silent else self._setpoints
        enabled, brake = bool(flags & 1) and not self.silent, bool(flags & 2) or self.silent
        name = self._state_names[state]
        return FirmwareOutputs(
            left, right, enabled, brake, False, name, fault, self._session, accepted_commands=accepted
        )

    def receive(self, now_us: int, frame: Frame) -> None:
        """One frame of the line; what is not of this line is ignored."""
        if len(frame.data) != 8:
            return
        if frame.can_id == SETPOINTS:
            left, right = struct.unpack("<ff", frame.data)
            self._setpoints = (left, right) if math.isfinite(left) and math.isfinite(right) else (0.0, 0.0)
            self._received_us = now_us
        elif frame.can_id == STATE:
            self._state = struct.unpack("<BBHI", frame.data)
        elif frame.can_id == ABOUT:
            version, self._session, ticks_per_rev = struct.unpack("<BBH", frame.data[:4])
            self.about = (version, ticks_per_rev)

    def step(self, now_us: int, error_counters: tuple[int, int] = (0, 0)) -> Sequence[Frame]:
        """Move on to robot time `now_us`; return what the board's sensors say then."""
        plant, faults, outputs = self.plant, self.faults, self.outputs
        setpoints = (outputs.left_setpoint_rad_s, outputs.right_setpoint_rad_s)
        turned = faults.setpoints(*setpoints, is_driven=outputs.driver_enabled)
        poses = faults.poses(now_us, plant.step(now_us, *turned, outputs.driver_enabled, outputs.brake))
        inputs = sensor_inputs(plant, self.estop_button, error_counters, ResetCause.POWER_ON)
        inputs = faults.inputs(inputs, setpoints, outputs.driver_enabled)
        frames = [_wheels(inputs)] if self._steps % WHEELS_STEPS == 0 else []
        if self._steps % POWER_STEPS == 0:
            frames.append(_power(inputs))
        self._steps += 1
        for pose in poses:
            frames += _pose(pose, now_us)
        return frames

    def jump_clock(self, step_us: int) -> None:
        """Do nothing, because the clock is the board's own, and `sim.app` refuses such a fault."""

    def reboot(self, cause: ResetCause = ResetCause.POWER_ON) -> None:
        """Raise LinkFaultError, because only an operator or the board itself can restart it."""
        raise LinkFaultError("reboot: not over this line; press the board's reset button")


def _i16(value: float) -> int:
    return max(-_LARGEST_I16, min(round(value), _LARGEST_I16))


def _wheels(inputs: FirmwareInputs) -> Frame:
    ticks = (inputs.left_ticks & 0xFFFF, inputs.right_ticks & 0xFFFF)
    speeds = (_i16(_PER_RAD_S * inputs.left_speed_rad_s), _i16(_PER_RAD_S * inputs.right_speed_rad_s))
    return Frame(WHEELS, struct.pack("<HHhh", *ticks, *speeds))


def _power(inputs: FirmwareInputs) -> Frame:
    currents = (_i16(100 * inputs.left_current_a), _i16(100 * inputs.right_current_a))
    voltage, hottest_c = round(100 * inputs.voltage_v), max(inputs.left_temperature_c, inputs.right_temperature_c)
    temperature = max(-127, min(round(hottest_c), 127))
    return Frame(POWER, struct.pack("<hhHbB", *currents, min(voltage, 0xFFFF), temperature, inputs.estop_button))


def _pose(pose: PoseMeasurement, now_us: int) -> list[Frame]:
    age = min(max((now_us - pose.sample_us) // 100, 0), 0xFFFF)
    # A deviation that is rounded down would have the host trust a pose more than its sensor does.
    deviations = [min(math.ceil(1000 * value), 0xFF) for value in (pose.position_std_m, pose.yaw_std_rad)]
    return [
        Frame(POSITION, struct.pack("<ff", pose.x_m, pose.y_m)),
        Frame(HEADING, struct.pack("<fHBB", pose.yaw_rad, age, *deviations)),
    ]


class PlantLine:
    """Link of this computer to the plant's line: a serial port, opened again when it breaks.

    Raises OSError or `serial.SerialException` if it cannot be opened at first.
    """

    def __init__(self, port: str) -> None:
        self._medium = SerialMedium(port, 921_600, dtr=False, rts=False)
        self._decoder = FrameDecoder()
        self._waiting: deque[Frame] = deque()
        self._unsent = b""
        self._retry_ns: int | None = None
        self._received_ns: int | None = None
        self.frames_in = 0
        self.frames_out = 0
        self.send_failures = 0
        self.errors = 0
        self._port: serial.Serial | None = self._open()

    @property
    def address(self) -> str:
        """Return a description of the board's link and port."""
        return f"the board on plant's line {self._medium.port}"

    @property
    def error_counters(self) -> tuple[int, int]:
        """Counters of transmit and receive errors, always zero: the board's link reports none."""
        return 0, 0

    def filenos(self) -> list[int]:
        """Return the file descriptor of the serial port."""
        return [] if self._port is None else [self._port.fileno()]

    def next_event_ns(self) -> int | None:
        """Return when the port is opened again."""
        return self._retry_ns

    def collect(self, now_ns: int) -> int:
        """Read what has come."""
        if self._retry_ns is not None and now_ns >= self._retry_ns:
            self._reopen(now_ns)
        try:
            received = b"" if self._port is None else self._port.read(4096)
        except (OSError, serial.SerialException) as error:
            received = b""
            self._lose(error, now_ns)
        frames = [Frame(can_id, data) for can_id, data in self._decoder.feed(received)]
        self.frames_in += len(frames)
        self._monitor_silence(now_ns, received=bool(frames))
        self._waiting += frames
        return len(self._waiting)

    def advance(self, now_ns: int, admit: int | None = None) -> list[ReceivedFrame]:
        """Hand over the oldest `admit` frames (None: all)."""
        count = len(self._waiting) if admit is None else admit
        return [ReceivedFrame(now_ns, self._waiting.popleft()) for _ in range(count)]

    def send(self, frames: Sequence[Frame]) -> None:
        """Send frames without waiting; while the line is full, whole frames are dropped and counted."""
        if self._unsent:
            self.send_failures += len(frames)
            frames = ()
        data = self._unsent + b"".join(encode_frame(frame.can_id, frame.data) for frame in frames)
        if self._port is None or not data:
            return
        try:
            # pyserial's own write would wait here for ever: it tries again at once as long as there is no room.
            written = os.write(self._port.fileno(), data)
        except BlockingIOError:
            written = 0
        except (OSError, serial.SerialException) as error:
            self._lose(error, time.monotonic_ns())
            return
        self.frames_out += len(frames)
        self._unsent = data[written:]

    def unplug(self, until_ns: int) -> None:
        """Leave the line until then."""
        self.close()
        self._retry_ns = until_ns

    def force_bus_off(self, who: str) -> None:
        """Raise LinkFaultError, because a serial line has no bus-off."""
        raise LinkFaultError(f"bus_off {who}: the board's own link is not the simulator's")

    def babble(self, frame: Frame) -> None:
        """Raise LinkFaultError, because faults of frames are not possible on the board's own link."""
        raise LinkFaultError("babble: the board's own link is not the simulator's")

    def set_bus_fault(self, fault: BusFault) -> None:
        """Do nothing, because faults of frames are those of the board's own link, and `sim.app` refuses them."""

    def summary(self) -> str:
        """Counters in one line."""
        return (
            f"in={self.frames_in} out={self.frames_out} malformed={self._decoder.stats.malformed} "
            f"send_failures={self.send_failures} errors={self.errors}"
        )

    def close(self) -> None:
        """Close the serial line; may be called twice."""
        port, self._port = self._port, None
        self._unsent = b""
        self._waiting.clear()
        if port is not None:
            port.close()

    def _open(self) -> serial.Serial:
        return open_port(self._medium, timeout_s=0, write_timeout_s=0, exclusive=True)

    def _reopen(self, now_ns: int) -> None:
        self.close()
        try:
            self._port, self._retry_ns = self._open(), None
        except (OSError, serial.SerialException):
            self._retry_ns = now_ns + RETRY_NS

    def _monitor_silence(self, now_ns: int, *, received: bool) -> None:
        if received:
            if self._received_ns is None and self.frames_in > 1:
                print(f"{self.address}: heard", file=sys.stderr, flush=True)
            self._received_ns = now_ns
        elif self._received_ns is not None and now_ns - self._received_ns > SILENCE_NS:
            print(f"{self.address}: says nothing; the wheels brake", file=sys.stderr, flush=True)
            self._received_ns = None

    def _lose(self, error: Exception, now_ns: int) -> None:
        self.errors += 1
        print(f"{self.address}: {error}; opening it again", file=sys.stderr, flush=True)
        self.close()
        self._retry_ns = now_ns + RETRY_NS
