"""Protocol between the driver of bases on ROS 2 and the bridge, on their local link, and the bridge's end of it.

Frames as of CAN: the link may be recorded, watched and broken as any other. The bridge's end latches an e-stop, and
stops the base when the commands fall silent; when the bridge itself dies, only the base's own time-out does.
"""

from __future__ import annotations

import math
import struct
import zlib
from dataclasses import dataclass
from typing import Annotated

import msgspec
from msgspec import Meta

from drivers.motor.body_port import BodySettings
from drivers.types import CyclicFrame, Frame, SafetyCard, SettingsFault

# Chosen for this link alone: e-stop first, as low identifiers go first on CAN.
STOP, ENABLE, SPEEDS, RESET = 0x010, 0x011, 0x012, 0x013
STATE, ANGLES, WHEELS = 0x110, 0x111, 0x112
HOST_FRAMES = frozenset({STOP, ENABLE, SPEEDS, RESET})
LENGTHS = {STOP: 0, ENABLE: 1, SPEEDS: 8, RESET: 0, STATE: 8, ANGLES: 8, WHEELS: 8}
"""Data bytes of each frame.

ENABLE: 1 to drive, 0 to stand by. SPEEDS: forward (m/s) and to the left (rad/s), float32. ANGLES: left and right,
int32, 0.1 mrad, modulo 2^32. WHEELS, after the ANGLES of the same instant: left and right (2 mrad/s), int16, and how
long ago both were true (0.1 ms), uint16. STATE: flags, why odometry was refused, a check sum of the settings. All of
them big endian.
"""
DRIVING, LATCHED, BUTTON, ODOMETRY, RECEIVED, OTHERS, FELL_SILENT = (1 << bit for bit in range(7))
# Chosen: longer than a burst of lost commands at 50 Hz; added to the base's own time-out it is the reaction time of the
# safety card.
DEADMAN_S = 0.2
# Chosen: zeros are repeated for so long, so that a base that misses some still stops.
ZEROS_S = 0.5
# Period of those zeros: 50 Hz, as the commands.
STEP_S = 0.02
# Steps on the wire; WHEELS' speeds in 16 bits reach 65 rad/s, and the age 6.5 s.
ANGLE_RAD = 1e-4
_SPEED_RAD_S, _AGE_S = 2e-3, 1e-4
REFUSALS = (
    "nothing is received on link.wheels_topic",
    "its stamps are late or of another clock; synchronise the clocks of both computers and leave use_sim_time off",
    "joints of link.left_joints or link.right_joints, or their positions, are missing",
    "its values are not finite, or faster than the base can turn",
    "its messages come out of order",
)
EXAMPLE = """wheel_radius_m = 0.06
track_m = 0.31
max_speed_m_s = 1.5
watchdog_s = 0.5
"""


class Ros2BaseSettings(BodySettings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of bases on ROS 2 in [link]: the base takes speeds of the body, converted from wheel speeds by these.

    `watchdog_s`: after what silence on its topic the base stops by itself, which nobody can read back. `wheels_topic`:
    JointState where the joints are named, else Odometry. `stop_topic`: a Bool that is true while a button of the base
    is pressed.
    """

    watchdog_s: Annotated[float, Meta(gt=0.0, le=1.0)]
    speed_topic: Annotated[str, Meta(min_length=1, max_length=200)] = "/cmd_vel"
    speed_stamped: bool = False
    wheels_topic: Annotated[str, Meta(max_length=200)] = ""
    left_joints: Annotated[tuple[str, ...], Meta(max_length=8)] = ()
    right_joints: Annotated[tuple[str, ...], Meta(max_length=8)] = ()
    stop_topic: Annotated[str, Meta(max_length=200)] = ""

    def fault(self) -> SettingsFault | None:
        """Joints of one side alone, or a joint that stands there twice."""
        joints = (*self.left_joints, *self.right_joints)
        if bool(self.left_joints) is not bool(self.right_joints):
            side = "right_joints" if self.left_joints else "left_joints"
            return SettingsFault(
                side, "empty, but the other side's are given", "name the joints of both sides, or of none"
            )
        if len(set(joints)) < len(joints):
            return SettingsFault("left_joints", "a joint is listed twice", "write each once, on its side")
        return None

    @property
    def wheels_from(self) -> str:
        """The topic that says how the wheels turn."""
        return self.wheels_topic or ("/joint_states" if self.left_joints else "/odom")

    def check_sum(self) -> int:
        """Return a CRC-32 of all fields: driver and bridge must have been started with the same."""
        return zlib.crc32(msgspec.json.encode(self))


@dataclass(frozen=True, slots=True)
class Wheels:
    """Angles (rad, cumulative) and speeds (rad/s) of both sides, and how long ago they were true."""

    angles_rad: tuple[float, float]
    speeds_rad_s: tuple[float, float]
    age_s: float


def speeds(linear_m_s: float, angular_rad_s: float) -> Frame:
    """Return the command to the base."""
    return Frame(SPEEDS, struct.pack(">ff", linear_m_s, angular_rad_s))


def enable(drive: bool) -> Frame:
    """To drive from now on, or to stand by."""
    return Frame(ENABLE, bytes([drive]))


def wheel_frames(wheels: Wheels) -> tuple[Frame, Frame]:
    """Return the frames that report the wheels' angles and speeds to the driver."""
    angles = (round(angle / ANGLE_RAD) % 2**32 for angle in wheels.angles_rad)
    steps = (max(-32768, min(32767, round(speed / _SPEED_RAD_S))) for speed in wheels.speeds_rad_s)
    age = max(0, min(65535, round(wheels.age_s / _AGE_S)))
    return Frame(ANGLES, struct.pack(">II", *angles)), Frame(WHEELS, struct.pack(">hhHxx", *steps, age))


def unpack_angles(data: bytes) -> tuple[int, int]:
    """Left and right, in 0.1 mrad modulo 2^32."""
    left, right = struct.unpack(">II", data)
    return left, right


def unpack_wheels(data: bytes) -> tuple[tuple[float, float], float]:
    """Speeds of left and right (rad/s), and their age (s)."""
    left, right, age = struct.unpack(">hhHxx", data)
    return (_SPEED_RAD_S * left, _SPEED_RAD_S * right), _AGE_S * age


def unpack_state(data: bytes) -> tuple[int, int, int]:
    """Return flags, why odometry was refused (an index of REFUSALS), and the check sum of the settings."""
    flags, refusal, check_sum = struct.unpack(">BBxxI", data)
    return flags, min(refusal, len(REFUSALS) - 1), check_sum


class BaseEnd:
    """State machine of the bridge's end, with the speeds that the base is commanded now; pure.

    Who owns it says what is heard of the base.
    """

    def __init__(self, settings: Ros2BaseSettings) -> None:
        self.driving = self.latched = self.button = self.has_listener = self.others_speak = False
        self.has_odometry = False
        self.receives_button = True
        self.refusal = 0
        self._check_sum = settings.check_sum()
        self._fell_silent = False
        self._fed_ns = 0
        self._zeros_until_ns = 0
        self.refused_speeds = 0

    @property
    def is_stopped(self) -> bool:
        """Whether a button is pressed, or nobody says that it is not."""
        return self.button or not self.receives_button

    def receive(self, now_ns: int, frame: Frame) -> tuple[float, float] | None:
        """Take in a frame of the driver; the speeds to say at once (m/s, rad/s), None for nothing."""
        if frame.extended or LENGTHS.get(frame.can_id) != len(frame.data):
            return None
        match frame.can_id:
            case 0x010:
                self.latched = True
                return self.hold_standstill(now_ns)
            case 0x011 if frame.data[0] != 1:
                return self.hold_standstill(now_ns)
            case 0x011:
                if not (self.driving or self.latched or self.is_stopped):
                    # The time-out runs from here on, and only speeds feed it.
                    self.driving, self._fell_silent, self._fed_ns = True, False, now_ns
            case 0x012:
                linear, angular = struct.unpack(">ff", frame.data)
                self._check_silence(now_ns)
                if self.driving and math.isfinite(linear + angular):
                    self._fed_ns = now_ns
                    return linear, angular
                self.refused_speeds += 1
            case 0x013:
                self.latched = False
        return None

    def step(self, now_ns: int) -> tuple[float, float] | None:
        """Return the speeds that are due in this STEP_S, or None.

        Zeros after a stop and while one is latched; while it drives, None: only commands feed it.
        """
        if self.is_stopped and self.driving:
            return self.hold_standstill(now_ns)
        self._check_silence(now_ns)
        due = self.latched or self.button or now_ns < self._zeros_until_ns
        return (0.0, 0.0) if due and not self.driving else None

    def hold_standstill(self, now_ns: int) -> tuple[float, float]:
        """Stop driving and return the zeros that stop the base."""
        self.driving, self._zeros_until_ns = False, now_ns + round(ZEROS_S * 1e9)
        return 0.0, 0.0

    def state(self) -> Frame:
        """Return the frame that reports the bridge's state to the driver."""
        bits = (
            self.driving, self.latched, self.is_stopped, self.has_odometry, self.has_listener, self.others_speak,
            self._fell_silent,
        )  # fmt: skip
        flags = sum(1 << bit for bit, is_set in enumerate(bits) if is_set)
        return Frame(STATE, struct.pack(">BBxxI", flags, self.refusal, self._check_sum))

    def _check_silence(self, now_ns: int) -> None:
        if self.driving and now_ns - self._fed_ns > DEADMAN_S * 1e9:
            self._fell_silent = True
            self.hold_standstill(now_ns)


def cyclic_frames(_settings: Ros2BaseSettings, command_rate_hz: float, _authenticated: bool) -> tuple[CyclicFrame, ...]:
    """Return the frames of each period: the command, and the bridge's reports of a base with 50 messages a second."""
    return (
        CyclicFrame("speeds", "HOST", 8, command_rate_hz),
        *(CyclicFrame(name, "ROBOT", 8, rate) for name, rate in (("state", 20.0), ("angles", 50.0), ("wheels", 50.0))),
    )


def safety_card(settings: Ros2BaseSettings) -> SafetyCard:
    """Return the safety card of bases on ROS 2."""
    base_s = settings.watchdog_s
    odometry = () if settings.left_joints else (
        "the wheel data come from an Odometry, which the base has computed with its own kinematics: inference and "
        "gap cannot see what that leaves out",
    )  # fmt: skip
    return SafetyCard(
        host_silent=f"the bridge commands zero {DEADMAN_S:g} s after the last command, or at once when the daemon "
        f"dies; when the bridge or the network fails, only the base's own time-out of {base_s:g} s stops the robot",
        stops_by=f"slowing down as the base does; at {settings.max_speed_m_s:g} m/s the base drives "
        f"{(DEADMAN_S + base_s) * settings.max_speed_m_s:.2f} m before it begins to slow down, if command and "
        "network fail together",
        reaction_s=DEADMAN_S + base_s,
        brakes=True,
        stops_by_own_ramp=True,
        estop="zero speed, which the bridge repeats and latches until a reset, as long as the bridge and the network "
        "work; any other node on the topic can move the base: use the button on the base",
        wheel_fault="the bridge commands zero at once and stays on standby; no topic takes the torque off the "
        "motors: a base whose speed loops are not reset by a speed of zero may run on with a lost encoder: use the "
        "button on the base",
        unverified=(
            f"link.watchdog_s = {base_s:g} is declared: ROS 2 cannot read it back. Test it: with the wheels off the "
            "ground, kill the bridge while they turn; they must stop",
            "senders on a topic are not authenticated: other nodes are detected and stop the robot, but cannot be "
            "blocked",
            *odometry,
        ),
        setup=(f"the base's time-out for {settings.speed_topic} (cmd_vel_timeout or the like): {base_s:g} s or less",),
    )
