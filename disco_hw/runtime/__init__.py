"""One tick of the robot, without a clock, a thread or a file; here the states that all of it is about.

One table has every way between the states, and what each means for the operator is in words. Rows are tried from top to
bottom, one transition per step: what takes motion away stands above what gives it. `disco_hw.runtime.supervisor`
computes the conditions and acts on the state. E-stop is shown in FAULT: the robot's firmware holds the latch, the
supervisor repeats the request until the firmware shows it.
"""

from __future__ import annotations

import enum
import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drivers.types import DriverState, LinkState
from firmware_protocol import status_codes


class State(enum.Enum):
    """States of the daemon; the wheels can be driven in ARMED only."""

    DISCONNECTED = "disconnected"
    HANDSHAKE = "handshake"
    READY = "ready"
    ARMED = "armed"
    STOPPING = "stopping"
    FAULT = "fault"


IN_USE = frozenset({State.ARMED, State.STOPPING})
"""States in which nothing may be changed that a drive depends on."""


class Condition:
    """Conditions that hold in one tick, in which the table of transitions is written: bits of an integer.

    Flags of `enum` cost a microsecond an operation in Python 3.11, and these are combined in every tick.
    """

    NONE = 0
    LINK_UP = 1 << 0
    LINK_RENEWED = 1 << 1  # the link was down since the last step, however short
    ROBOT_TALKS = 1 << 2  # handshake complete, whatever the robot's state
    ROBOT_IDLE = 1 << 3  # robot in standby or ready: it executes nothing
    ROBOT_ARMED = 1 << 4
    ROBOT_MAY_MOVE = 1 << 5  # robot arming, armed or stopping
    ROBOT_REFUSED = 1 << 6
    ROBOT_FAULT = 1 << 7
    ROBOT_ESTOP = 1 << 8
    TELEMETRY_FRESH = 1 << 9
    TELEMETRY_LOST = 1 << 10
    WHEELS_STATIONARY = 1 << 11
    ARM_PENDING = 1 << 12
    DISARM_REQUESTED = 1 << 13
    ESTOP_REQUESTED = 1 << 14  # held from the request until a reset is accepted
    RESET_PENDING = 1 << 15
    PREFLIGHT_ERROR = 1 << 16


C = Condition
PROBLEM = C.ESTOP_REQUESTED | C.ROBOT_ESTOP | C.ROBOT_FAULT | C.ROBOT_REFUSED | C.PREFLIGHT_ERROR
_CONNECTED = frozenset(State) - {State.DISCONNECTED}
_UNTROUBLED = _CONNECTED - {State.FAULT}


@dataclass(frozen=True, slots=True)
class Transition:
    """From any of `sources` to `target` when all of `needs` and none of `blocked_by` hold; `reason` is for a person."""

    sources: frozenset[State]
    target: State
    needs: int
    blocked_by: int
    reason: str


def _from(*states: State) -> frozenset[State]:
    return frozenset(states)


S = State
_NO_WHEEL_DATA = "no wheel data from the robot; check the cable and the robot's power"
TRANSITIONS: tuple[Transition, ...] = (
    # A lost link ends everything agreed with the robot.
    Transition(_CONNECTED, S.DISCONNECTED, C.NONE, C.LINK_UP, "the link is down"),
    Transition(_CONNECTED, S.DISCONNECTED, C.LINK_RENEWED, C.NONE, "the link was interrupted"),
    # Problems latch until a reset.
    Transition(_UNTROUBLED, S.FAULT, C.ESTOP_REQUESTED, C.NONE, "e-stop requested by the operator"),
    Transition(_UNTROUBLED, S.FAULT, C.ROBOT_ESTOP, C.NONE, "the robot is in e-stop"),
    Transition(_UNTROUBLED, S.FAULT, C.ROBOT_FAULT, C.NONE, "the robot reports a fault"),
    Transition(_UNTROUBLED, S.FAULT, C.ROBOT_REFUSED, C.NONE, "the handshake was refused"),
    Transition(_UNTROUBLED, S.FAULT, C.PREFLIGHT_ERROR, C.NONE, "a preflight check failed"),
    Transition(_from(S.FAULT), S.HANDSHAKE, C.RESET_PENDING, PROBLEM, "reset"),
    # Motion is taken away.
    Transition(_from(S.ARMED), S.STOPPING, C.DISARM_REQUESTED, C.NONE, "disarm requested"),
    Transition(_from(S.ARMED), S.STOPPING, C.TELEMETRY_LOST, C.NONE, _NO_WHEEL_DATA),
    Transition(_from(S.ARMED), S.STOPPING, C.NONE, C.ROBOT_ARMED, "the robot is no longer armed"),
    Transition(
        _from(S.READY), S.STOPPING, C.ROBOT_MAY_MOVE, C.ARM_PENDING, "the robot armed without a request from this host"
    ),
    Transition(
        _from(S.HANDSHAKE),
        S.STOPPING,
        C.ROBOT_MAY_MOVE,
        C.NONE,
        "the robot was already armed when this daemon connected",
    ),
    # The robot restarted or fell silent.
    Transition(_from(S.READY, S.STOPPING), S.HANDSHAKE, C.NONE, C.ROBOT_TALKS, "the robot started a new handshake"),
    Transition(_from(S.READY), S.HANDSHAKE, C.TELEMETRY_LOST, C.NONE, _NO_WHEEL_DATA),
    # The way up.
    Transition(_from(S.DISCONNECTED), S.HANDSHAKE, C.LINK_UP, C.NONE, "the link is up"),
    Transition(_from(S.HANDSHAKE), S.READY, C.ROBOT_IDLE | C.TELEMETRY_FRESH, C.NONE, "handshake complete"),
    Transition(_from(S.READY), S.ARMED, C.ARM_PENDING | C.ROBOT_ARMED | C.TELEMETRY_FRESH, C.NONE, "armed on request"),
    Transition(
        _from(S.STOPPING),
        S.READY,
        C.ROBOT_IDLE | C.WHEELS_STATIONARY | C.TELEMETRY_FRESH,
        C.NONE,
        "the wheels have stopped",
    ),
)


_ROWS_FROM = {state: tuple(row for row in TRANSITIONS if state in row.sources) for state in State}


def next_transition(state: State, conditions: int) -> Transition | None:
    """Return the first row that leads out of `state`, or None to stay; `conditions` is the mask of those that hold."""
    for row in _ROWS_FROM[state]:
        if conditions & row.needs == row.needs and not conditions & row.blocked_by:
            return row
    return None


AdviceStyle = Callable[[str], str]
"""How a person asks for an action, as "arm": in words that begin with a verb."""

ARMING = "arming"
"""Detail of a status while the robot has been asked to arm and has not yet."""
ESTOP_HINT = "The stop is latched. Make the place safe, release the robot's own button, then {reset}."
_NEXT = {
    "DISCONNECTED": "Check the robot's power and the cable to it.",
    "HANDSHAKE": "Wait: the daemon is identifying the robot.",
    "READY": "{arm}; arming does not move the robot.",
    "STOPPING": "Wait until the wheels stand still.",
    "FAULT": "Correct the fault shown above, then {reset}.",
}


def by_button(action: str) -> str:
    """Return how an operator requests an action on the page."""
    return f"press {action.capitalize()}"


def by_command(robot: Path) -> AdviceStyle:
    """Return a function that says how an operator requests an action in a terminal."""
    return lambda action: f"run `disco-hw ctl {shlex.quote(str(robot))} {action}`"


def connection(link: LinkState, link_error: str | None, driver: DriverState, driver_detail: str) -> str:
    """Return why the robot does not answer, and what to do about it.

    `link_error` is the link's newest, with its remedy, or None.
    """
    if link is not LinkState.UP:
        return link_error or f"the link is {link.value}"
    # A link that is open and brings nothing has said more than that there is no answer.
    return link_error if link_error and driver is DriverState.HANDSHAKE else driver_detail


def headline(state: str, detail: str, running: bool, estop: bool, by_hand: bool = False) -> tuple[str, str]:
    """Return the state in a word or two, and the sentence after it."""
    head = "E-STOP" if estop else f"{state} · running" if running else state
    return head, "driven by hand" if by_hand else detail


def status_headline(status: Mapping[str, Any]) -> tuple[str, str]:
    """Return the headline and its detail for a daemon's status that is `ok`."""
    by_hand = "drive" in status and bool(status["drive"]["driving"])
    return headline(status["state"], status["detail"], status["running"], is_estop(status), by_hand)


def is_estop(status: Mapping[str, Any]) -> bool:
    """Whether a status is to be shown as an e-stop."""
    return bool(status["estop"]) or status["robot_state"] == "ESTOP"


def advice(status: Mapping[str, Any], advice_style: AdviceStyle = by_button) -> tuple[str, ...]:
    """Sentences on what to do now, the most urgent first, for a status of the daemon that is `ok`."""
    sentences = []
    if is_estop(status):
        sentences.append(f"E-STOP. {_asking(ESTOP_HINT, advice_style)}")
    fault = str(status["fault"])
    if fault not in {"NONE", "UNKNOWN"}:
        sentences.append(fault_sentence(fault))
    state = str(status["state"])
    if sentences:
        return tuple(sentences)
    if "drive" in status and state in {"READY", "ARMED"}:
        return (str(status["drive"]["words"]),)
    if state == "ARMED":
        sentence = "{stop} to hold still, or {disarm} to end." if status["running"] else "{start} to drive the task."
        return (_asking(sentence, advice_style),)
    if state == "READY" and status.get("detail") == ARMING:
        return ("Wait: the robot is arming.",)
    return (_asking(_NEXT[state], advice_style),) if state in _NEXT else ()


def fault_sentence(name: str) -> str:
    """Return what a fault is and what to do about it."""
    todo = status_codes.advice(name) or (
        "this version does not know the fault: look it up in the documentation of the robot's firmware"
    )
    return f"{describe(name)}. {todo[0].upper()}{todo[1:]}."


def next_step(status: Mapping[str, Any]) -> str:
    """Return the action that leads on from here; empty where there is none."""
    state = str(status["state"])
    if "drive" in status and state in {"READY", "ARMED"}:
        return ""
    if state == "ARMED":
        return "stop" if status["running"] else "start"
    return {"READY": "arm", "FAULT": "reset"}.get(state, "")


def describe(code: str) -> str:
    """Return a code of the protocol as a person reads it: STALL_LEFT becomes Stall left."""
    return code.replace("_", " ").capitalize()


def _asking(sentence: str, advice_style: AdviceStyle) -> str:
    text = sentence.format(**{action: advice_style(action) for action in ("arm", "start", "stop", "disarm", "reset")})
    return text[0].upper() + text[1:]
