"""The permit to move: what a driver proves of controllers that know no session, as one immutable value.

Such controllers latch little and report to no host that another one drives them. What the reference protocol proves in
the controller is kept in `MotionPermit`: arming only when asked and only from rest, the ramp of a stop, a fault and an
e-stop that stay until a reset, and that nothing re-arms by itself. `vendor_driver.py` says what happened; stopping is
taken in every stage, and what does not belong to a stage leaves the permit as it is.
"""

from __future__ import annotations

import enum
import math
from typing import Literal

import msgspec
from msgspec.structs import replace

from drivers.types import DriverState, Request, WheelCommand

# Chosen: after a longer pause of the host the ramp goes on from where it was, rather than jump to zero.
_LONGEST_STEP_S = 0.1
# Longer than a period at the slowest rate, 50 ms; with the 20 ms between two messages still shorter than the 100 ms
# after which the first driver calls its controllers silent.
_PAUSE_NS = 75_000_000
ON_STANDBY = "on standby"
STOPPED_FROM_OUTSIDE = "e-stop received on the link, sent by `disco-hw estop` or another host"


class Stage(enum.Enum):
    """Stages of a driver between standing by and driving.

    STOPPING is the ramp down, BRAKING what follows it, or replaces it, until the wheels stand.
    """

    REST = "rest"
    ARMING = "arming"
    ARMED = "armed"
    STOPPING = "stopping"
    BRAKING = "braking"


Idle = Literal[Stage.REST, Stage.BRAKING]
_DRIVING = (Stage.ARMING, Stage.ARMED, Stage.STOPPING)


class Controllers(msgspec.Struct, frozen=True, kw_only=True):
    """State of the controllers as received, in their vendor's meaning; None for what is well.

    For a person: what is `missing` that must be known of them, why they are `refused`, which e-stop of their own holds
    (`stopped`), what is `faulty`, and why they are `unfit` to be driven now although they are well. `energised`: they
    would obey a command. `offline`: what to do about a link that is down.
    """

    missing: str | None = None
    refused: str | None = None
    stopped: str | None = None
    faulty: str | None = None
    unfit: str | None = None
    energised: bool = False
    offline: str = "the link is down"


class MotionPermit(msgspec.Struct, frozen=True, kw_only=True):
    """Immutable state of the permission to move; each transition returns the next one.

    `idle`: where a restart or an arming that fails leaves it, `after_loss` where a fault or an e-stop does: BRAKING for
    controllers that must be sent something until they stand. `since_ns`: the first tick of the stage, None before it.
    `speeds`, `fed_ns`: wheel speeds (rad/s) commanded last, and when. `zeros`: commands of zero since arming began.
    `events`: said since the driver passed them on.
    """

    idle: Idle = Stage.REST
    after_loss: Idle = Stage.REST
    link_is_up: bool = False
    stage: Stage = Stage.REST
    since_ns: int | None = None
    target: Request = Request.STANDBY
    note: str = ON_STANDBY
    fault: str | None = None
    estopped: bool = False
    shared: bool = False
    speeds: tuple[float, float] = (0.0, 0.0)
    fed_ns: int = 0
    zeros: int = 0
    looked_ns: int = 0
    attentive_ns: int = 0
    events: tuple[str, ...] = ()

    @property
    def is_driving(self) -> bool:
        """Whether controllers hold speeds by command, or did just now: whatever is wrong with one then stops all."""
        return self.stage in _DRIVING

    def state(self, seen: Controllers) -> DriverState:
        """Return the driver's state with its controllers; what is latched comes before what is not known."""
        if not self.link_is_up:
            return DriverState.DISCONNECTED
        if self.estopped or seen.stopped is not None:
            return DriverState.ESTOP
        if seen.refused is not None:
            return DriverState.REFUSED
        if self.fault is not None:
            return DriverState.FAULT
        if seen.missing is not None:
            return DriverState.HANDSHAKE
        if seen.faulty is not None:
            return DriverState.FAULT
        if self.stage is Stage.ARMED:
            return DriverState.ARMED
        if self.stage in (Stage.STOPPING, Stage.BRAKING) or (self.stage is Stage.REST and seen.energised):
            return DriverState.STOPPING
        if self.stage is Stage.ARMING:
            return DriverState.ARMING
        return DriverState.READY if self.target is Request.READY else DriverState.STANDBY

    def detail(self, seen: Controllers) -> str:
        """Return why the state is what it is, and what to do about it."""
        match self.state(seen):
            case DriverState.DISCONNECTED:
                return seen.offline
            case DriverState.ESTOP:
                return seen.stopped or "emergency stop; remove its cause, then reset"
            case DriverState.REFUSED:
                return seen.refused or ""
            case DriverState.HANDSHAKE:
                return seen.missing or ""
            case DriverState.FAULT:
                return f"{self.fault or seen.faulty}; remove the cause, then reset"
            case DriverState.STANDBY | DriverState.READY:
                return seen.unfit or self.note
        return self.note

    def is_late(self, now_ns: int, timeout_s: float) -> bool:
        """Whether controllers that hold a speed must have stopped by themselves, as nothing was commanded for so long.

        Where they have no armed state to fall out of, the next command would move them again.
        """
        holds = self.stage is Stage.ARMED or (self.stage is Stage.STOPPING and any(self.speeds))
        return holds and now_ns - self.fed_ns > timeout_s * 1e9

    def silent_ns(self, received_ns: int) -> int:
        """Return how long nothing has come since `received_ns`, of the time in which the host looked without a pause.

        What was not heard in a pause is no silence of the controllers: the host was not there, or has not read yet.
        """
        return self.looked_ns - max(received_ns, self.attentive_ns)

    def looked(self, now_ns: int) -> MotionPermit:
        """Return the permit after the host has looked at its controllers, once in each tick."""
        paused = now_ns - self.looked_ns > _PAUSE_NS
        return replace(self, looked_ns=now_ns, attentive_ns=now_ns if paused else self.attentive_ns)

    def linked(self, is_up: bool) -> MotionPermit:
        """Return the permit after the medium has come up or is gone: all is void but what is latched."""
        return replace(self.restarted("the link was lost"), link_is_up=is_up)

    def restarted(self, why: str, event: str | None = None) -> MotionPermit:
        """Return the permit for controllers that must be synchronised again; what is latched stays."""
        note = f"disarmed: {why}" if self.target is Request.ARM else self.note
        permit_after = replace(self.given_up(note), shared=False)
        return permit_after if event is None else permit_after.with_event(event)

    def requested(self, request: Request, seen: Controllers) -> MotionPermit:
        """Return the permit after a request of the host.

        ARM is accepted only of controllers that stand by and are fit, and each time it is requested again.
        """
        if request is self.target:
            return self
        if request is Request.ARM:
            if self.state(seen) not in (DriverState.STANDBY, DriverState.READY) or seen.unfit is not None:
                return replace(self, note=f"not arming: {self.detail(seen)}")
            return replace(
                self, target=request, stage=Stage.ARMING, since_ns=None, zeros=0, speeds=(0.0, 0.0), note="arming"
            )
        if self.stage in (Stage.ARMING, Stage.ARMED):
            return replace(self, target=request, stage=Stage.STOPPING, since_ns=None, note="stopping as requested")
        return replace(self, target=request)

    def begun(self, now_ns: int) -> MotionPermit:
        """Return the permit with the stage's time running from its first tick."""
        return replace(self, since_ns=now_ns) if self.since_ns is None else self

    def lasts_ns(self, now_ns: int) -> int:
        """Time since the stage's first tick."""
        return 0 if self.since_ns is None else now_ns - self.since_ns

    def fed_zero(self, now_ns: int) -> MotionPermit:
        """Zero was commanded while arming."""
        return replace(self, fed_ns=now_ns, zeros=self.zeros + 1) if self.stage is Stage.ARMING else self

    def armed(self, now_ns: int) -> MotionPermit:
        """Return the permit once all proof is there: commands may move it from now on."""
        if self.stage is not Stage.ARMING:
            return self
        return replace(self, stage=Stage.ARMED, note="armed", fed_ns=now_ns, speeds=(0.0, 0.0))

    def commanded(self, now_ns: int, command: WheelCommand) -> MotionPermit:
        """Return the permit after a command is passed on."""
        if self.stage is not Stage.ARMED:
            return self
        return replace(self, fed_ns=now_ns, speeds=(command.left_rad_s, command.right_rad_s))

    def slowed(self, now_ns: int, deceleration_rad_s2: float) -> MotionPermit:
        """Return the permit after a step of the ramp: speeds nearer to zero; a pause counts for 0.1 s at most."""
        if self.stage is not Stage.STOPPING:
            return self
        step = deceleration_rad_s2 * min(max(now_ns - self.fed_ns, 0) * 1e-9, _LONGEST_STEP_S)
        left, right = (math.copysign(max(abs(speed) - step, 0.0), speed) for speed in self.speeds)
        return replace(self.begun(now_ns), fed_ns=now_ns, speeds=(left, right))

    def ramped(self) -> MotionPermit:
        """Return the permit after the ramp: brake until the wheels stand."""
        return replace(self, stage=Stage.BRAKING, since_ns=None) if self.stage is Stage.STOPPING else self

    def rested(self) -> MotionPermit:
        """Return the permit after the stop."""
        stopping = self.stage in (Stage.STOPPING, Stage.BRAKING)
        return replace(self, stage=Stage.REST, since_ns=None) if stopping else self

    def lost(self, why: str) -> MotionPermit:
        """One controller, or its host, is lost: all stop, and that stays a fault until a reset."""
        stopped = replace(self.given_up(f"disarmed: {why}"), stage=self.after_loss, fault=why)
        return stopped.with_event(f"disarmed: {why}")

    def stopped(self) -> MotionPermit:
        """Return the permit after an emergency stop was sent from here."""
        return replace(self.given_up("emergency stop sent"), stage=self.after_loss, estopped=True)

    def stop_received(self) -> MotionPermit:
        """Return the permit after an emergency stop was received that somebody else sent; reported once."""
        stopped = replace(self.given_up(self.note), stage=self.after_loss, estopped=True)
        return stopped if self.estopped else stopped.with_event(STOPPED_FROM_OUTSIDE)

    def command_received(self, whom: str) -> MotionPermit:
        """Return the permit after another host has commanded `whom`; a fault unless the controllers are at rest."""
        noted = (
            self if self.shared else self.with_event(f"another host is on the link: it commands {whom}; disconnect it")
        )
        noted = replace(noted, shared=True)
        return noted if self.stage is Stage.REST else noted.lost(f"another host commands {whom}; disconnect it")

    def reset(self, seen: Controllers) -> MotionPermit:
        """Clear what is latched, when that is wanted of controllers at rest that have reported and are well.

        Those that are refused may be reset: nothing arms them.
        """
        is_known = seen.missing is None or seen.refused is not None
        well = is_known and seen.stopped is None and seen.faulty is None and not seen.energised
        if self.stage is not Stage.REST or self.target is not Request.RESET or not well:
            return self
        return replace(self, fault=None, estopped=False, target=Request.STANDBY, note=ON_STANDBY)

    def with_event(self, event: str) -> MotionPermit:
        """Return the permit with one more event for the operator."""
        return replace(self, events=(*self.events, event))

    def given_up(self, note: str) -> MotionPermit:
        """Return the permit without a request: not armed, or disarmed, without a fault; `note` says why."""
        return replace(self, target=Request.STANDBY, stage=self.idle, since_ns=None, note=note)
