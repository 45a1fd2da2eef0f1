"""Every driver of a vendor's controller, with what the conformance suite must know to drive and to break it."""

import struct
import tomllib
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from functools import partial

import msgspec

from drivers.motor import create_driver, find_driver
from sim.can_protocol import CanFrame
from sim.devices import find_controller
from tests.drivers.motor.bench import Bench
from tests.drivers.motor.vendor_rig import TICKS_PER_REV, VendorRig


@dataclass(frozen=True)
class Vendor:
    """A driver and its simulator, with the settings of its example and `changes` to them.

    `watchdog_s`: after what silence the controller lets go. `lose_left`: break the left side alone. `is_motion`: of a
    frame that moves a wheel; `is_forbidden`: one that no driver ever sends; `foreign`: one that another host would,
    None on a line that is one host's alone; `mend`: takes away the cause of `lose_left`, where a reset does not.
    """

    name: str
    label: str
    changes: str = ""
    _: KW_ONLY
    watchdog_s: float
    lose_left: Callable[[VendorRig], None]
    is_motion: Callable[[CanFrame], bool]
    is_forbidden: Callable[[CanFrame], bool]
    foreign: CanFrame | None
    mend: Callable[[VendorRig], None] = lambda _rig: None

    @property
    def is_serial(self):
        """Whether the controller is on a line with two ends, which no second host hears or speaks on."""
        return self.foreign is None

    @property
    def settings(self):
        driver = find_driver(self.name)
        return msgspec.convert({**tomllib.loads(driver.example), **tomllib.loads(self.changes)}, driver.settings)

    def bench(self, coasting_s=0.5, **options):
        controller = find_controller(self.name)(self.settings, TICKS_PER_REV)
        exchange = find_driver(self.name).exchange(self.settings) if self.is_serial else None
        rig = VendorRig(controller, exchange, coasting_s)
        return Bench(create_driver(self.name, self.settings), rig, **options)

    def __str__(self):
        return self.label


def fail_left_odrive(rig):
    axis = rig.controller.axes[0][0]
    axis.axis_error |= 0x40 if rig.controller.boards[0].generation == "0.5" else 0x1000
    axis.release_on_error()


def is_odrive_motion(frame):
    """A velocity that is not zero, a position or torque, or a state that calibrates or spins."""
    command = frame.can_id & 0x1F
    if command == 0x07:
        return frame.data[0] not in (1, 8)
    return command in (0x0C, 0x0E) or (command == 0x0D and frame.data[:4] not in (bytes(4), b"\0\0\0\x80"))


def is_odrive_forbidden(frame):
    """All but the stop, idle and closed loop, velocity control, velocities, the clearing of errors, and questions."""
    command, data = frame.can_id & 0x1F, frame.data
    if not data:
        return command not in (0x00, 0x02, 0x17, 0x18)
    if command in (0x07, 0x0B):
        return (command, data) not in [(0x07, struct.pack("<II", state, 0)) for state in (1, 8)] and (
            command != 0x0B or data != struct.pack("<II", 2, 1)
        )
    return (command, len(data)) not in ((0x0D, 8), (0x18, 1)) and not (command == 0x04 and data[0] == 0)


def set_left_vesc_fault(number):
    return lambda rig: setattr(rig.controller.sides[0][0].values, "fault", number)


def is_vesc_motion(frame):
    """Duty, current, speed, position: whatever is not zero moves at once."""
    return frame.can_id >> 8 in (0, 1, 3, 4, 10) and frame.data != bytes(4)


def is_vesc_forbidden(frame):
    """All but the current of zero, brake currents, speeds, pings, and questions for values and settings."""
    command, data = frame.can_id >> 8, frame.data
    if command == 8:
        return data[2] not in (17, 50)
    if not frame.extended or command == 17:
        return not frame.extended or len(data) != 1
    return command not in (1, 2, 3) or len(data) != 4 or (command == 1 and any(data))


def fail_left_agilex(rig):
    rig.controller.base.error_code, rig.controller.base.vehicle_state = 0x0010, 2


def is_agilex_motion(frame):
    """A speed that is not zero, or the mode in which the base obeys one."""
    return (frame.can_id == 0x111 and frame.data[:4] != bytes(4)) or (frame.can_id == 0x421 and frame.data[0] != 0)


def is_agilex_forbidden(frame):
    """Lights, brakes, the serial mode, and a length that is not the command's."""
    lengths = {0x111: 8, 0x421: 8, 0x441: 1}
    return len(frame.data) != lengths.get(frame.can_id) or (frame.can_id == 0x421 and frame.data[0] > 1)


def set_left_roboclaw_status(status):
    return lambda rig: setattr(rig.controller.boards[128].registers, "status", status)


def is_roboclaw_motion(frame):
    """A speed or duty that is not zero."""
    zeros = {40: frame.data[6:14], 34: frame.data[2:6]}
    return frame.can_id & 0xFF in (32, 33, 34, 35, 36, 37, 40) and any(zeros.get(frame.can_id & 0xFF, b"!"))


def is_roboclaw_forbidden(frame):
    """All but the serial timeout, questions, ramped speeds, the stop, and the reset of an e-stop."""
    command = frame.can_id & 0xFF
    if command == 34:
        return any(frame.data[2:6])
    return command not in (14, 15, 21, 40, 55, 56, 78, 81, 90, 200)


def set_ros2_base_odometry(is_sent):
    return lambda rig: setattr(rig.controller, "joints", is_sent)


def is_ros2_base_motion(frame):
    """Speeds that are not zero, or the bridge commanded to drive."""
    return (frame.can_id == 0x012 and frame.data != bytes(8)) or (frame.can_id == 0x011 and frame.data != b"\0")


def is_ros2_base_forbidden(frame):
    """Whatever is none of the four frames of a host."""
    return len(frame.data) != {0x010: 0, 0x011: 1, 0x012: 8, 0x013: 0}.get(frame.can_id)


ODRIVE = partial(
    Vendor, "odrive", watchdog_s=0.1,
    lose_left=fail_left_odrive, is_motion=is_odrive_motion, is_forbidden=is_odrive_forbidden,
)  # fmt: skip
VESC = partial(
    Vendor, "vesc", watchdog_s=0.11, mend=set_left_vesc_fault(0),
    lose_left=set_left_vesc_fault(4), is_motion=is_vesc_motion, is_forbidden=is_vesc_forbidden,
)  # fmt: skip
ROBOCLAW = partial(
    Vendor, "roboclaw", watchdog_s=0.2, foreign=None, is_motion=is_roboclaw_motion, is_forbidden=is_roboclaw_forbidden
)
VENDORS = (
    ODRIVE("odrive-0.6", foreign=CanFrame(3 << 5 | 0x0D, bytes(8))),
    ODRIVE("odrive-0.5", 'firmware = "0.5"\n', foreign=CanFrame(5 << 5 | 0x0D, bytes(8))),
    ODRIVE("odrive-four-axes", "nodes = [[3, 5], [6, 7]]\n", foreign=CanFrame(6 << 5 | 0x0D, bytes(8))),
    VESC("vesc", foreign=CanFrame(3 << 8 | 23, bytes(4), extended=True)),
    VESC(
        "vesc-four-braking",
        "nodes = [[23, 24], [51, 52]]\ntimeout_brake_current_a = 10.0\n",
        foreign=CanFrame(3 << 8 | 52, bytes(4), extended=True),
    ),
    VESC("vesc-uart", "uart_node = 51\n", foreign=None),
    Vendor(
        "agilex", "agilex", watchdog_s=0.5, foreign=CanFrame(0x111, b"\0\x10" + bytes(6)),
        lose_left=fail_left_agilex, is_motion=is_agilex_motion, is_forbidden=is_agilex_forbidden,
    ),
    ROBOCLAW("roboclaw", lose_left=set_left_roboclaw_status(0x40), mend=set_left_roboclaw_status(0)),
    ROBOCLAW(
        "roboclaw-a-board-a-side",
        'motors = [["128/1", "128/2"], ["129/1", "129/2"]]\n',
        lose_left=lambda rig: rig.controller.dead.add(128),
        mend=lambda rig: rig.controller.dead.clear(),
    ),
    Vendor(
        "ros2_base", "ros2-base", watchdog_s=0.2, foreign=CanFrame(0x012, bytes(8)),
        lose_left=set_ros2_base_odometry(False), mend=set_ros2_base_odometry(True),
        is_motion=is_ros2_base_motion, is_forbidden=is_ros2_base_forbidden,
    ),
)  # fmt: skip
BY_LABEL = {vendor.label: vendor for vendor in VENDORS}
