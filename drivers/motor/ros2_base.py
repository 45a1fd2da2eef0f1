"""The driver of bases that are reached over ROS 2 alone: speeds of the body out, joint states or odometry in.

It speaks to `disco-hw bridge ros2-base`, a process of its own, as nothing of ROS belongs into the control process. A
base reports nothing of its time-out, its limits or of who else commands it: the weakest safety of all drivers here.
"""

from __future__ import annotations

from collections.abc import Sequence

from drivers.motor import ros2_base_wire as wire
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

# Chosen: five reports of the bridge, which come every 50 ms; gone, longer than a disturbance of the network.
SILENT_NS, GONE_NS = 250_000_000, 1_000_000_000
# Chosen: above the noise of odometry.
_STATIONARY_M_S = 0.02


class _Ros2BasePort(BodyPort):
    """Port of `VendorDriver` for bases on ROS 2."""

    settings: wire.Ros2BaseSettings

    def __init__(self, settings: wire.Ros2BaseSettings) -> None:
        super().__init__(settings, wire.DEADMAN_S, Limit(settings.watchdog_s, "robot.toml"))
        self._check_sum = settings.check_sum()
        self._refusal = self._bridge_sum = 0

    @property
    def seen(self) -> Controllers:
        stopped = f"a button on the base is pressed{self._or_unheard}" if self._flags & wire.BUTTON else None
        latched = "emergency stop; remove its cause, then reset" if self._flags & wire.LATCHED else None
        return Controllers(
            missing=self._missing,
            stopped=stopped or latched,
            unfit=self._unfit,
            energised=bool(self._flags & wire.DRIVING),
            offline="the link is down; start disco-hw bridge ros2-base ROBOT.toml",
        )

    @property
    def identity(self) -> Identity | None:
        """Identity of the base behind the bridge; a base reports nothing of itself on its topics."""
        is_met = self._state_ns is not None and not self._is_foreign_bridge
        return Identity("ROS 2 base", "", "robot.toml") if is_met else None

    @property
    def is_stopped(self) -> bool:
        """Whether the bridge has latched a stop and the base stands, or a button of it is pressed."""
        is_latched = self._flags & wire.LATCHED and not self._flags & wire.DRIVING
        return bool((is_latched and self._wheels_ns is not None and self._is_stationary) or self._flags & wire.BUTTON)

    def reset_state(self, now_ns: int) -> None:
        super().reset_state(now_ns)
        self._state_ns: int | None = None
        self._wheels_ns: int | None = None
        self._newest: tuple[int, int] | None = None
        self._flags, self._wheel_speeds, self._age_s = 0, (0.0, 0.0), 0.0

    def handle(self, received: ReceivedFrame, permit: MotionPermit) -> FrameReport:
        frame, data = received.frame, received.frame.data
        if frame.extended or frame.can_id not in wire.LENGTHS:
            return UNKNOWN
        if len(data) != wire.LENGTHS[frame.can_id]:
            return REJECTED_LENGTH
        if frame.can_id == wire.STOP:
            return FrameReport(counts=("unknown_id",), is_stop=True)
        if frame.can_id in wire.HOST_FRAMES:
            return FrameReport(counts=("unknown_id",), commanded="the base")
        if frame.can_id == wire.STATE:
            self._state_ns = received.t_ns
            self._flags, self._refusal, self._bridge_sum = wire.unpack_state(data)
            return FrameReport(is_status=True)
        if frame.can_id == wire.ANGLES:
            self._newest = wire.unpack_angles(data)
        elif self._newest is not None:
            self._wheel_speeds, self._age_s = wire.unpack_wheels(data)
            angles, self._newest, self._wheels_ns = self._newest, None, received.t_ns
            fastest = 1.5 * self.settings.fastest_rad_s / wire.ANGLE_RAD
            # Messages of a base do not come evenly.
            return self._handle_counts(angles, received.t_ns, permit.looked_ns, fastest, 0.1 * fastest)
        return FrameReport()

    def sources(self) -> Sequence[Source]:
        return (
            Source("the bridge", self._state_ns, SILENT_NS, GONE_NS),
            Source("the base's odometry", self._wheels_ns, SILENT_NS),
        )

    def objection(self, permit: MotionPermit) -> Objection | None:
        """Return what ends a drive: a button, a stop, other nodes, no odometry, or a bridge that drives no longer."""
        if self._flags & wire.BUTTON:
            return Objection(f"a button on the base was pressed{self._or_unheard}")
        if self._flags & wire.LATCHED:
            return Objection("e-stop received, sent by `disco-hw estop` or another host")
        if self._unfit is not None:
            return Objection(self._unfit)
        if not self._flags & wire.ODOMETRY:
            return Objection(f"no odometry: {wire.REFUSALS[self._refusal]}")
        if permit.stage is Stage.ARMED and not self._flags & wire.DRIVING:
            silent = self._flags & wire.FELL_SILENT
            return Objection(
                ("commands reached the bridge too late; check the load of the network and of both computers")
                if silent
                else ("the bridge no longer drives the base")
            )
        return None

    def prepare(self, now_ns: int, permit: MotionPermit) -> Pending | None:
        """Have the bridge drive."""
        if not self._is_stationary:
            return Pending(why="the base is moving; wait until it stands still", is_final=True)
        if not self._flags & wire.DRIVING:
            return Pending(why="the bridge did not start to drive", frames=(wire.enable(True),))
        return None

    def rest(self, now_ns: int, permit: MotionPermit) -> Sequence[Frame]:
        """Bring the bridge to standing by, or to a stop that it does not hold yet; reset it when requested."""
        is_latched, frames = self._flags & wire.LATCHED, self.stop_frames()
        if permit.target is Request.RESET and is_latched:
            frames = (Frame(wire.RESET, b""),)
        elif permit.target is Request.RESET or not permit.estopped or is_latched:
            frames = self._standby_frames() if self._flags & wire.DRIVING else ()
        return frames if frames and self._is_due(now_ns) else ()

    def stop_frames(self) -> tuple[Frame, ...]:
        """Return the stop that the bridge latches."""
        return (Frame(wire.STOP, b""),)

    def _motion(self, linear_m_s: float, angular_rad_s: float) -> Frame:
        return wire.speeds(linear_m_s, angular_rad_s)

    def _standby_frames(self) -> tuple[Frame, ...]:
        return (wire.enable(False),)

    @property
    def _missing(self) -> str | None:
        if self._state_ns is None:
            return "no answer from the bridge; start disco-hw bridge ros2-base ROBOT.toml"
        if self._is_foreign_bridge:
            return "the bridge runs with another [link] of robot.toml; restart it"
        if not self._flags & wire.ODOMETRY:
            return f"no odometry from {self.settings.wheels_from}: {wire.REFUSALS[self._refusal]}"
        is_alive = self._flags & wire.RECEIVED and self._turned[0].last is not None
        return None if is_alive else self._unfit or "waiting for the first odometry"

    @property
    def _unfit(self) -> str | None:
        """Reason why the base may not be driven, whatever is requested; None if it may."""
        topic = self.settings.speed_topic
        if self._flags & wire.OTHERS:
            return f"another node publishes on {topic}; end it, or give it a topic of its own"
        if not self._flags & wire.RECEIVED:
            return f"no node subscribes to {topic}; check that the base is switched on and in this domain"
        return None

    @property
    def _is_foreign_bridge(self) -> bool:
        return self._bridge_sum != self._check_sum

    @property
    def _or_unheard(self) -> str:
        return f", or nothing is received on {self.settings.stop_topic}" if self.settings.stop_topic else ""

    @property
    def _is_stationary(self) -> bool:
        return self.settings.wheel_radius_m * max(map(abs, self._wheel_speeds)) < _STATIONARY_M_S

    def _sample(self, t_ns: int) -> WheelSample:
        left, right = (wire.ANGLE_RAD * side.total for side in self._turned)
        return WheelSample(t_ns - round(self._age_s * 1e9), t_ns, left, right, *self._wheel_speeds)


DRIVER = MotorDriver(
    "ros2_base",
    lambda settings, _key: VendorDriver(_Ros2BasePort(settings)),
    settings=wire.Ros2BaseSettings,
    takes_body_speeds=True,
    largest_difference_rad_s=lambda settings: settings.largest_difference_rad_s,
    example=wire.EXAMPLE,
    stop_frames=lambda settings: _Ros2BasePort(settings).stop_frames(),
    stop_confirmation=lambda settings: stop_confirmation(_Ros2BasePort(settings)),
    cyclic_frames=wire.cyclic_frames,
    safety_card=wire.safety_card,
)
