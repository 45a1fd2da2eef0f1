"""The driver of AgileX bases on CAN v2: Scout, Scout Mini, Bunker, Tracer.

The base takes speed and turn rate of the body and makes wheel speeds of them by its own track: what the model learns as
axial distance is base and inner factor together. Who holds the remote control comes first: then this driver stands by.
"""

from __future__ import annotations

from collections.abc import Sequence

from drivers.motor import agilex_protocol as protocol
from drivers.motor.agilex_protocol import TIMEOUT_S, AgilexSettings
from drivers.motor.body_port import BodyPort
from drivers.motor.permit import Controllers, MotionPermit, Stage
from drivers.motor.vendor_driver import (
    REJECTED_LENGTH,
    UNKNOWN,
    FrameReport,
    Objection,
    Pending,
    Source,
    VendorDriver,
    stop_confirmation,
)
from drivers.types import (
    Frame,
    Identity,
    Limit,
    MotorDriver,
    ReceivedFrame,
    Request,
    WheelSample,
)

# A base sends its state every 100 ms, a BUNKER PRO 2.0 every 200 ms, and its motion every 20 ms: three messages of the
# slower one, and five, which find a base that is gone. Gone: longer than a disturbance of the bus.
STATE_SILENT_NS, MOTION_SILENT_NS, GONE_NS = 650_000_000, 100_000_000, 1_000_000_000
# Chosen: some steps of 0.001 on the wire, so that noise does not keep a base that stands from standing by.
_STATIONARY_M_S, _STATIONARY_RAD_S = 0.01, 0.02
_WARNINGS = 0x0606
"""Bits of the error word that only warn, in the SDK's byte and in the manual's: battery low, remote control lost."""
_MODES = {protocol.STANDBY: "standby", protocol.UART_MODE: "serial mode", protocol.RC_MODE: "remote control"}
_HOST_COMMANDS = frozenset({protocol.MOTION_COMMAND, protocol.CONTROL_MODE, protocol.STATE_RESET, protocol.BRAKE})


class _AgilexPort(BodyPort):
    """Port of `VendorDriver` for AgileX bases."""

    settings: AgilexSettings

    def __init__(self, settings: AgilexSettings) -> None:
        super().__init__(settings, TIMEOUT_S, Limit(TIMEOUT_S, "fixed"))

    @property
    def seen(self) -> Controllers:
        is_complete = None not in (self._state_ns, self._motion_ns, self._turned[0].last)
        faulty = self._vehicle == protocol.EXCEPTION or bool(self._error & ~_WARNINGS)
        text = f"the base reports an error ({self._error:#06x}); its manual's table of faults names it"
        driven = "an operator drives it by remote control; switch that off to drive it from here"
        return Controllers(
            missing=None
            if is_complete
            else ("no answer from the base; check that it is switched on and the bus runs at 500 kbit/s"),
            stopped="a button on the base is pressed" if self._vehicle == protocol.EMERGENCY_STOP else None,
            faulty=text if faulty else None,
            unfit=driven if self._mode == protocol.RC_MODE else None,
            energised=self._mode == protocol.CAN_MODE,
        )

    @property
    def identity(self) -> Identity | None:
        """Identity of an AgileX base; None before it has reported its state."""
        return None if self._state_ns is None else Identity("AgileX base, CAN v2", "", "robot.toml")

    @property
    def is_stopped(self) -> bool:
        """Whether the base stands in a mode that CAN cannot drive, or one of its buttons is pressed."""
        if self._state_ns is None or self._motion_ns is None:
            return False
        standing_by = self._is_stationary and self._mode != protocol.CAN_MODE
        return standing_by or self._vehicle == protocol.EMERGENCY_STOP

    def reset_state(self, now_ns: int) -> None:
        super().reset_state(now_ns)
        self._state_ns: int | None = None
        self._motion_ns: int | None = None
        self._vehicle, self._mode, self._error = protocol.NORMAL, protocol.STANDBY, 0
        self._speed = (0.0, 0.0)

    def handle(self, received: ReceivedFrame, permit: MotionPermit) -> FrameReport:
        frame = received.frame
        if not frame.extended and frame.can_id in _HOST_COMMANDS:
            if frame not in self.stop_frames():
                return FrameReport(counts=("unknown_id",), commanded="the base")
            return FrameReport(counts=("unknown_id",), is_stop=frame.can_id == protocol.CONTROL_MODE)
        decoded = protocol.decode(frame)
        if decoded is None:
            if frame.extended or frame.can_id not in protocol.LAYOUTS.keys() | protocol.IGNORED:
                return UNKNOWN
            is_ignored = frame.can_id in protocol.IGNORED and len(frame.data) == 8
            return FrameReport() if is_ignored else REJECTED_LENGTH
        values = decoded.values
        match decoded.name:
            case "system_state":
                self._vehicle, self._mode = int(values["vehicle_state"]), int(values["control_mode"])
                self._error, self._state_ns = int(values["error_code"]), received.t_ns
                return FrameReport(is_status=True)
            case "motion_state":
                self._motion_ns = received.t_ns
                self._speed = (float(values["linear_m_s"]), float(values["angular_rad_s"]))
            case "odometry":
                counts = (int(values["left_mm"]), int(values["right_mm"]))
                fastest = 1.5e3 * self.settings.max_speed_m_s
                return self._handle_counts(counts, received.t_ns, permit.looked_ns, fastest, 10.0)
        return FrameReport()

    def sources(self) -> Sequence[Source]:
        return (
            Source("the base", self._state_ns, STATE_SILENT_NS, GONE_NS),
            Source("the base's motion", self._motion_ns, MOTION_SILENT_NS),
        )

    def objection(self, permit: MotionPermit) -> Objection | None:
        """Return what keeps the base from being driven: a button, an error, or another mode, but no remote control."""
        seen = self.seen
        if seen.stopped is not None:
            return Objection("a button on the base was pressed")
        if seen.faulty is not None:
            return Objection(seen.faulty)
        if permit.stage is not Stage.ARMING and self._mode == protocol.RC_MODE:
            return Objection("disarmed: an operator has taken the remote control", is_fault=False)
        if permit.stage is Stage.ARMED and self._mode != protocol.CAN_MODE:
            return Objection(f"the base left its CAN mode without a request, for {_MODES.get(self._mode, self._mode)}")
        return None

    def prepare(self, now_ns: int, permit: MotionPermit) -> Pending | None:
        """Let the base listen to CAN."""
        if not self._is_stationary:
            return Pending(why="the base is moving; wait until it stands still", is_final=True)
        if self._mode != protocol.CAN_MODE:
            why = "the base did not enter its CAN mode; switch the remote control off"
            return Pending(why=why, frames=(protocol.control_mode(protocol.CAN_MODE),))
        return None

    def rest(self, now_ns: int, permit: MotionPermit) -> Sequence[Frame]:
        """Bring a base that listens to CAN to standby, standing; clear errors when requested."""
        seen = self.seen
        clears = permit.target is Request.RESET and (seen.missing or seen.stopped or seen.faulty)
        if not (clears or seen.energised) or not self._is_due(now_ns):
            return ()
        return (protocol.clear_errors(),) if clears else self.stop_frames()

    def stop_frames(self) -> tuple[Frame, ...]:
        """Return the frames for zero and standby, because the base has no e-stop by frame."""
        return protocol.motion(0.0, 0.0), protocol.control_mode(protocol.STANDBY)

    @property
    def _is_stationary(self) -> bool:
        linear, angular = self._speed
        return abs(linear) < _STATIONARY_M_S and abs(angular) < _STATIONARY_RAD_S

    def _motion(self, linear_m_s: float, angular_rad_s: float) -> Frame:
        return protocol.motion(linear_m_s, angular_rad_s)

    def _standby_frames(self) -> tuple[Frame, ...]:
        return self.stop_frames()

    def _sample(self, t_ns: int) -> WheelSample | None:
        if self._motion_ns is None:
            return None
        radius, track = self.settings.wheel_radius_m, self.settings.track_m
        linear, angular = self._speed
        left, right = (1e-3 * side.total / radius for side in self._turned)
        speeds = (linear - 0.5 * track * angular, linear + 0.5 * track * angular)
        return WheelSample(t_ns, t_ns, left, right, speeds[0] / radius, speeds[1] / radius)


DRIVER = MotorDriver(
    "agilex",
    lambda settings, _key: VendorDriver(_AgilexPort(settings)),
    settings=AgilexSettings,
    takes_body_speeds=True,
    largest_difference_rad_s=lambda settings: settings.largest_difference_rad_s,
    example=protocol.EXAMPLE,
    recognise=protocol.recognise,
    latches_stop=False,
    stop_frames=lambda settings: _AgilexPort(settings).stop_frames(),
    stop_confirmation=lambda settings: stop_confirmation(_AgilexPort(settings)),
    cyclic_frames=protocol.cyclic_frames,
    safety_card=protocol.safety_card,
)
