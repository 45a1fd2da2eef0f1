"""The C firmware core as a Python object: what the virtual robot runs and what the tests hold to account."""

import enum
import math
import secrets
from dataclasses import dataclass, field, fields
from typing import Any

import msgspec

from firmware_protocol import _firmware
from firmware_protocol.codec import Codec

_lib: Any = _firmware.lib
_ffi: Any = _firmware.ffi
# Widths of the C core's uint32_t ticks and uint64_t entropy.
_TICKS_MASK = 0xFFFF_FFFF
_ENTROPY_MASK = 0xFFFF_FFFF_FFFF_FFFF
# Steps of POSE_POSITION and POSE_HEADING in disco_robot.dbc, and the C core's integers, which hold more than the frames
# do.
_POSITION_UNIT_M = 0.0001
_YAW_UNIT_RAD = 0.0001
_DEVIATION_UNIT = 0.001
_INT32 = (-0x8000_0000, 0x7FFF_FFFF)
_UINT16 = (0, 0xFFFF)


_DEFAULT: Any = _lib.disco_config_default(1, 1.0)


def _c_name(name: str) -> str:
    """Return the C core's name of a field of `FirmwareConfig`: without its unit, and durations in microseconds."""
    for unit in ("_rad_s2", "_rad_s", "_v", "_a", "_c"):
        if name.endswith(unit):
            return name.removesuffix(unit)
    return f"{name.removesuffix('_s')}_us" if name.endswith("_s") else name


def _default(name: str) -> float:
    """Return a default as C has it, in the decimal digits that a float carries."""
    value = getattr(_DEFAULT, _c_name(name))
    return value / 1e6 if isinstance(value, int) else float(f"{value:.7g}")


class ResetCause(enum.IntEnum):
    """Causes of the controller's start."""

    POWER_ON = 0
    WATCHDOG = 1
    BROWN_OUT = 2


@dataclass(frozen=True, slots=True)
class FirmwareConfig:
    """Configuration that differs between robots, with the defaults of `disco_config_default`.

    A value out of the bounds of `robot_config.c` makes the core refuse to leave FAULT.

    `capabilities` is the sum of the bits in the DBC's value table; `dbc_hash` and `protocol_major` are other than the
    packaged DBC's only to play a robot that speaks another one. With a `key` (16 bytes) commands need a proof made
    with it; empty: none. `cycle_s`: the period at which `FirmwareCore.step` is called.
    """

    ticks_per_rev: int
    max_wheel_speed_rad_s: float
    max_wheel_acceleration_rad_s2: float = _default("max_wheel_acceleration_rad_s2")
    stop_deceleration_rad_s2: float = _default("stop_deceleration_rad_s2")
    still_speed_rad_s: float = _default("still_speed_rad_s")
    cycle_s: float = _default("cycle_s")
    command_timeout_s: float = _default("command_timeout_s")
    drive_off_timeout_s: float = _default("drive_off_timeout_s")
    stop_timeout_s: float = _default("stop_timeout_s")
    host_state_timeout_s: float = _default("host_state_timeout_s")
    host_forget_timeout_s: float = _default("host_forget_timeout_s")
    reset_quiet_s: float = _default("reset_quiet_s")
    under_voltage_v: float = _default("under_voltage_v")
    over_voltage_v: float = _default("over_voltage_v")
    over_current_a: float = _default("over_current_a")
    over_temperature_c: float = _default("over_temperature_c")
    stall_current_a: float = _default("stall_current_a")
    encoder_check_current_a: float = _default("encoder_check_current_a")
    encoder_check_speed_rad_s: float = _default("encoder_check_speed_rad_s")
    voltage_debounce_s: float = _default("voltage_debounce_s")
    current_debounce_s: float = _default("current_debounce_s")
    temperature_debounce_s: float = _default("temperature_debounce_s")
    encoder_debounce_s: float = _default("encoder_debounce_s")
    fault_hold_s: float = _default("fault_hold_s")
    board_id: int = _DEFAULT.board_id
    firmware_version: tuple[int, int, int] = (*_DEFAULT.firmware_version,)
    capabilities: int = _DEFAULT.capabilities
    dbc_hash: int = _DEFAULT.dbc_hash
    protocol_major: int = _DEFAULT.protocol_major
    key: bytes = field(default=b"", repr=False)


class FirmwareInputs(msgspec.Struct, frozen=True, gc=False, kw_only=True):
    """Measurements of the board in one cycle; ticks are cumulative, a transmit error count over 255 means bus-off."""

    left_ticks: int
    right_ticks: int
    left_speed_rad_s: float
    right_speed_rad_s: float
    left_current_a: float = 0.0
    right_current_a: float = 0.0
    left_temperature_c: float = 25.0
    right_temperature_c: float = 25.0
    left_encoder_valid: bool = True
    right_encoder_valid: bool = True
    voltage_v: float = 24.0
    battery_current_a: float = 0.0
    battery_temperature_c: float = 25.0
    tx_error_count: int = 0
    rx_error_count: int = 0
    estop_button: bool = False
    estop_line: bool = False
    self_test_failed: bool = False
    reset_cause: ResetCause = ResetCause.POWER_ON


class FirmwareOutputs(msgspec.Struct, frozen=True, gc=False):
    """Commands of the core to the motor driver, and its state; setpoints are after all limits, 0 with driver off.

    `accepted_commands` counts the wheel commands ever accepted, `blockers` is the sum of the bits in the DBC's table of
    what keeps the controller from the next step towards motion.
    """

    left_setpoint_rad_s: float
    right_setpoint_rad_s: float
    driver_enabled: bool
    brake: bool
    limited: bool
    state: str
    fault: int = 0
    session: int = 0
    estop_source: str = "NONE"
    stop_cause: str = "NONE"
    blockers: int = 0
    accepted_commands: int = 0
    last_command_counter: int = 0
    rejected_frames: int = 0
    watchdog_events: int = 0


def random_entropy() -> int:
    """Return 64 bits from the system that are not all 0."""
    return 1 + secrets.randbelow(_ENTROPY_MASK)


def _nearest(value: float, unit: float, bounds: tuple[int, int]) -> int:
    """Return the number of units nearest to a value, within bounds; 0 for what is not a number."""
    if math.isnan(value):
        return 0
    least, most = bounds
    return math.floor(min(max(value / unit + 0.5, least), most))


def _fill_config(target: Any, config: FirmwareConfig) -> None:
    if config.key:
        target.authenticated = True
        target.key = tuple(config.key)
    for name in (each.name for each in fields(config) if each.name != "key"):
        value, c_name = getattr(config, name), _c_name(name)
        setattr(target, c_name, round(value * 1e6) if c_name.endswith("_us") else value)


class FirmwareCore:
    """Core of one controller: frames and measurements in, setpoints and frames out; time is passed in, microseconds."""

    __slots__ = (
        "_core",
        "_data",
        "_estop_sources",
        "_frame",
        "_inputs",
        "_outputs",
        "_pose",
        "_reasons",
        "_states",
        "_stop_causes",
    )

    def __init__(self, config: FirmwareConfig, entropy: int | None = None, last_entropy: int = 0) -> None:
        """`entropy` (64 bits) seeds challenges and nonces; None draws it from the system.

        The core refuses to leave FAULT if it is 0 or that of the start before, `last_entropy`. Raises OverflowError for
        a value that its C field cannot hold.
        """
        codec = Codec()
        self._states = _names(codec, "state")
        self._stop_causes = _names(codec, "stop_cause")
        self._estop_sources = _names(codec, "estop_source")
        self._reasons = codec.choices("SYSTEM_STATE", "reject_reason")
        self._core = _ffi.new("disco_firmware_t *")
        self._inputs = _ffi.new("disco_inputs_t *")
        self._outputs = _ffi.new("disco_outputs_t *")
        self._pose = _ffi.new("disco_pose_t *")
        self._frame = _ffi.new("disco_frame_t *")
        self._data = _ffi.buffer(self._frame.data)
        c_config = _ffi.new("disco_config_t *")
        _fill_config(c_config, config)
        random_bits = random_entropy() if entropy is None else entropy
        _lib.disco_firmware_init(self._core, c_config, random_bits & _ENTROPY_MASK, last_entropy & _ENTROPY_MASK)

    def receive(self, now_us: int, can_id: int, data: bytes) -> None:
        """Take in one frame from the bus; anything may come."""
        _lib.disco_firmware_receive(self._core, now_us, can_id & 0xFFFF_FFFF, data, min(len(data), 0xFF))

    def step(self, now_us: int, inputs: FirmwareInputs) -> FirmwareOutputs:
        """Run one cycle of the firmware; call it once in `cycle_s`."""
        c = self._inputs
        c.ticks = (inputs.left_ticks & _TICKS_MASK, inputs.right_ticks & _TICKS_MASK)
        c.wheel_speed = (inputs.left_speed_rad_s, inputs.right_speed_rad_s)
        c.current = (inputs.left_current_a, inputs.right_current_a)
        c.temperature = (inputs.left_temperature_c, inputs.right_temperature_c)
        c.encoder_valid = (inputs.left_encoder_valid, inputs.right_encoder_valid)
        c.voltage = inputs.voltage_v
        c.battery_current = inputs.battery_current_a
        c.battery_temperature = inputs.battery_temperature_c
        c.tx_error_count = inputs.tx_error_count
        c.rx_error_count = inputs.rx_error_count
        c.estop_button = inputs.estop_button
        c.estop_line = inputs.estop_line
        c.self_test_failed = inputs.self_test_failed
        c.reset_cause = inputs.reset_cause
        out = self._outputs
        _lib.disco_firmware_step(self._core, now_us, c, out)
        return FirmwareOutputs(
            out.left_setpoint,
            out.right_setpoint,
            out.driver_enabled,
            out.brake,
            out.limited,
            self._states[out.state],
            out.fault,
            out.session,
            self._estop_sources[out.estop_source],
            self._stop_causes[out.stop_cause],
            out.blockers,
            out.accepted_commands,
            out.last_command_counter,
            out.rejected_frames,
            out.watchdog_events,
        )

    def pose(
        self, x_m: float, y_m: float, yaw_rad: float, sample_us: int, position_std_m: float, yaw_std_rad: float
    ) -> None:
        """Queue one measured pose, true at `sample_us`; one that does not fit the frame is sent as not valid."""
        deviations = (position_std_m, yaw_std_rad)
        pose = self._pose
        pose.x, pose.y = _nearest(x_m, _POSITION_UNIT_M, _INT32), _nearest(y_m, _POSITION_UNIT_M, _INT32)
        pose.yaw = _nearest(yaw_rad, _YAW_UNIT_RAD, _INT32)
        pose.position_std, pose.yaw_std = (_nearest(std, _DEVIATION_UNIT, _UINT16) for std in deviations)
        # What fits only when rounded does not fit; written so that what is not a number is not valid.
        pose.valid = (
            abs(x_m) <= _POSITION_UNIT_M * 0x7F_FFFF
            and abs(y_m) <= _POSITION_UNIT_M * 0x7F_FFFF
            and abs(yaw_rad) <= _YAW_UNIT_RAD * 0x7FFF
            and all(0.0 <= std <= _DEVIATION_UNIT * 0xFF for std in deviations)
        )
        _lib.disco_firmware_pose(self._core, pose, sample_us)

    def drain(self) -> list[tuple[int, bytes]]:
        """Return the frames to send (CAN id, data), oldest first, and forget them."""
        frames = []
        frame = self._frame
        while _lib.disco_firmware_pop(self._core, frame):
            frames.append((frame.can_id, self._data[:]))
        return frames

    @property
    def challenge(self) -> int:
        """The arming challenge in force."""
        return int(self._core.session.challenge)

    @property
    def rejections(self) -> dict[str, int]:
        """Number of frames rejected for each reason of the DBC's table."""
        return {name: self._core.rejected[reason] for reason, name in self._reasons.items() if reason}

    @property
    def overflowed_frames(self) -> int:
        """Number of frames that did not fit into the transmit queue."""
        return int(self._core.transmit.overflow_count)

    @property
    def unknown_frames(self) -> int:
        """Number of frames whose identifier is not for this controller."""
        return int(self._core.unknown_frames)


def _names(codec: Codec, signal: str) -> tuple[str, ...]:
    return tuple(codec.choice_name("SYSTEM_STATE", signal, value) for value in range(16))
