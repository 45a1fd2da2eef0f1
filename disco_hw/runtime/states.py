"""The daemon's states and every way between them, as one table.

Rows are tried from top to bottom, one transition per step: what takes motion away stands above what gives it.
`disco_hw.runtime.supervisor` computes the conditions and acts on the state. E-stop is shown in FAULT: the robot's
firmware holds the latch, the supervisor repeats the request until the firmware shows it.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass


class State(enum.Enum):
    """Where the daemon is; the wheels can be driven in ARMED only."""

    DISCONNECTED = "disconnected"
    HANDSHAKE = "handshake"
    READY = "ready"
    ARMED = "armed"
    STOPPING = "stopping"
    FAULT = "fault"


class Condition(enum.Flag):
    """What is true now; the table is written in these."""

    NONE = 0
    LINK_UP = enum.auto()
    LINK_RENEWED = enum.auto()  # the link was down since the last step, however short
    ROBOT_TALKS = enum.auto()  # handshake complete, whatever the robot's state
    ROBOT_IDLE = enum.auto()  # robot in standby or ready: it executes nothing
    ROBOT_ARMED = enum.auto()
    ROBOT_MAY_MOVE = enum.auto()  # robot arming, armed or stopping
    ROBOT_REFUSED = enum.auto()
    ROBOT_FAULT = enum.auto()
    ROBOT_ESTOP = enum.auto()
    TELEMETRY_FRESH = enum.auto()
    TELEMETRY_LOST = enum.auto()
    WHEELS_STILL = enum.auto()
    ARM_PENDING = enum.auto()
    DISARM_ASKED = enum.auto()
    ESTOP_ASKED = enum.auto()  # held from the request until a reset is accepted
    RESET_PENDING = enum.auto()
    PREFLIGHT_ERROR = enum.auto()
    DAEMON_ERROR = enum.auto()


C = Condition
PROBLEM = C.DAEMON_ERROR | C.ESTOP_ASKED | C.ROBOT_ESTOP | C.ROBOT_FAULT | C.ROBOT_REFUSED | C.PREFLIGHT_ERROR
_CONNECTED = frozenset(State) - {State.DISCONNECTED}
_UNTROUBLED = _CONNECTED - {State.FAULT}


@dataclass(frozen=True, slots=True)
class Transition:
    """From any of `sources` to `target` when all of `needs` and none of `blocked_by` hold; `reason` is for a person."""

    sources: frozenset[State]
    target: State
    needs: Condition
    blocked_by: Condition
    reason: str


def _row(sources: frozenset[State], target: State, needs: Condition, blocked_by: Condition, reason: str) -> Transition:
    return Transition(sources, target, needs, blocked_by, reason)


def _from(*states: State) -> frozenset[State]:
    return frozenset(states)


S = State
TRANSITIONS: tuple[Transition, ...] = (
    # A lost link ends everything agreed with the robot.
    _row(_CONNECTED, S.DISCONNECTED, C.NONE, C.LINK_UP, "the link is down"),
    _row(_CONNECTED, S.DISCONNECTED, C.LINK_RENEWED, C.NONE, "the link was interrupted"),
    # Problems latch until a reset.
    _row(_UNTROUBLED, S.FAULT, C.DAEMON_ERROR, C.NONE, "the daemon failed"),
    _row(_UNTROUBLED, S.FAULT, C.ESTOP_ASKED, C.NONE, "e-stop requested here"),
    _row(_UNTROUBLED, S.FAULT, C.ROBOT_ESTOP, C.NONE, "the robot is in e-stop"),
    _row(_UNTROUBLED, S.FAULT, C.ROBOT_FAULT, C.NONE, "the robot reports a fault"),
    _row(_UNTROUBLED, S.FAULT, C.ROBOT_REFUSED, C.NONE, "the handshake was refused"),
    _row(_UNTROUBLED, S.FAULT, C.PREFLIGHT_ERROR, C.NONE, "a preflight check failed"),
    _row(_from(S.FAULT), S.HANDSHAKE, C.RESET_PENDING, PROBLEM, "reset"),
    # Motion is taken away.
    _row(_from(S.ARMED), S.STOPPING, C.DISARM_ASKED, C.NONE, "disarm requested"),
    _row(_from(S.ARMED), S.STOPPING, C.TELEMETRY_LOST, C.NONE, "telemetry lost"),
    _row(_from(S.ARMED), S.STOPPING, C.NONE, C.ROBOT_ARMED, "the robot is no longer armed"),
    _row(_from(S.READY), S.STOPPING, C.ROBOT_MAY_MOVE, C.ARM_PENDING, "the robot is armed unasked"),
    _row(_from(S.HANDSHAKE), S.STOPPING, C.ROBOT_MAY_MOVE, C.NONE, "the robot was found armed"),
    # The robot restarted or fell silent.
    _row(_from(S.READY, S.STOPPING), S.HANDSHAKE, C.NONE, C.ROBOT_TALKS, "the robot started a new handshake"),
    _row(_from(S.READY), S.HANDSHAKE, C.TELEMETRY_LOST, C.NONE, "telemetry lost"),
    # The way up.
    _row(_from(S.DISCONNECTED), S.HANDSHAKE, C.LINK_UP, C.NONE, "the link is up"),
    _row(_from(S.HANDSHAKE), S.READY, C.ROBOT_IDLE | C.TELEMETRY_FRESH, C.NONE, "handshake complete"),
    _row(_from(S.READY), S.ARMED, C.ARM_PENDING | C.ROBOT_ARMED | C.TELEMETRY_FRESH, C.NONE, "armed on request"),
    _row(_from(S.STOPPING), S.READY, C.ROBOT_IDLE | C.WHEELS_STILL | C.TELEMETRY_FRESH, C.NONE, "the wheels are still"),
)


# On the integers below the flags: this runs in every tick, and flags cost a microsecond an operation.
_ROWS_FROM = {
    state: tuple((row.needs.value, row.blocked_by.value, row) for row in TRANSITIONS if state in row.sources)
    for state in State
}


def next_transition(state: State, held: int) -> Transition | None:
    """Return the first row that leads out of `state`, or None to stay; `held` is the value of all that is true now."""
    for needs, blocked_by, row in _ROWS_FROM[state]:
        if held & needs == needs and not held & blocked_by:
            return row
    return None
