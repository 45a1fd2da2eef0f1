"""Every fault and state of the protocol is reported with what to do about it."""

from pathlib import Path

import pytest

from disco_hw.runtime import State, advice, by_command, connection, describe, headline, next_step
from drivers.types import DriverState, LinkState
from firmware_protocol.status_codes import FAULTS

STATUS = {"estop": False, "robot_state": "READY", "fault": "NONE", "state": "READY", "running": False}


@pytest.mark.parametrize("fault", FAULTS.values(), ids=FAULTS)
def test_every_fault_of_the_protocol_has_its_sentence(fault):
    (sentence,) = advice({**STATUS, "fault": fault.name})
    assert sentence.startswith(f"{describe(fault.name)}. ")
    assert sentence.lower().endswith(f"{fault.advice.lower()}.")


def test_nobody_is_sent_to_reset_what_does_not_latch():
    sentences = advice({**STATUS, "fault": "OVER_TEMPERATURE_LEFT"})
    assert sentences == (
        "Over temperature left. Let the left motor cool down and drive more gently; it clears by itself.",
    )


@pytest.mark.parametrize("state", State)
def test_every_state_says_what_to_do(state):
    sentences = advice({**STATUS, "state": state.name})
    assert len(sentences) == 1
    assert sentences[0].endswith(".")


@pytest.mark.parametrize("state", ["READY", "ARMED", "FAULT"])
def test_in_a_terminal_it_names_commands_in_place_of_buttons(state):
    advice_style = by_command(Path("robots/mine.toml"))
    for running in (False, True):
        text = " ".join(advice({**STATUS, "state": state, "running": running}, advice_style))
        assert "disco-hw ctl robots/mine.toml " in text
        assert "press" not in text.lower()
    latched = advice({**STATUS, "state": "FAULT", "estop": True, "fault": "STALL_LEFT"}, advice_style)
    assert latched[0].endswith("then run `disco-hw ctl robots/mine.toml reset`.")
    assert by_command(Path("my robot.toml"))("arm") == "run `disco-hw ctl 'my robot.toml' arm`"


@pytest.mark.parametrize(
    ("link", "link_error", "driver", "expected"),
    [
        (LinkState.CONNECTING, None, DriverState.DISCONNECTED, "the link is connecting"),
        (LinkState.CONNECTING, "plug it in", DriverState.DISCONNECTED, "plug it in"),
        (LinkState.UP, None, DriverState.HANDSHAKE, "no answer"),
        (LinkState.UP, "open, but mute", DriverState.HANDSHAKE, "open, but mute"),
        (LinkState.UP, "transmit queue full", DriverState.READY, "no answer"),
    ],
)
def test_what_stands_between_the_host_and_the_robot(link, link_error, driver, expected):
    assert connection(link, link_error, driver, "no answer") == expected


@pytest.mark.parametrize(
    ("running", "estop", "by_hand", "line"),
    [(False, False, False, ("ARMED", "why")), (True, False, False, ("ARMED · running", "why")),
     (True, True, False, ("E-STOP", "why")), (True, False, True, ("ARMED · running", "driven by hand"))],
)  # fmt: skip
def test_the_headline(running, estop, by_hand, line):
    assert headline("ARMED", "why", running, estop, by_hand) == line


@pytest.mark.parametrize(
    ("state", "running", "button"),
    [("READY", False, "arm"), ("ARMED", False, "start"), ("ARMED", True, "stop"), ("FAULT", False, "reset"),
     ("STOPPING", False, ""), ("DISCONNECTED", False, "")],
)  # fmt: skip
def test_the_button_that_leads_on(state, running, button):
    assert next_step({**STATUS, "state": state, "running": running}) == button


def test_a_fault_and_a_latched_stop_come_before_everything_else():
    sentences = advice({**STATUS, "state": "FAULT", "fault": "STALL_LEFT"})
    assert sentences == ("Stall left. Free the left wheels, check their motor's cable; then reset.",)
    both = advice({**STATUS, "state": "FAULT", "fault": "STALL_LEFT", "estop": True})
    assert len(both) == 2
    assert "latched" in both[0]
    assert "Reset" in both[0]
    assert advice({**STATUS, "robot_state": "ESTOP"}) == both[:1]


def test_codes_are_said_in_words_also_of_an_unknown_fault():
    assert describe("OVER_CURRENT_RIGHT") == "Over current right"
    assert advice({**STATUS, "fault": "NEW_TROUBLE"})[0].startswith("New trouble. This version does not know the fault")


def test_driving_by_hand_has_its_own_words():
    status = {**STATUS, "drive": {"words": "hold the pad"}}
    assert advice(status) == ("hold the pad",)
    assert next_step(status) == ""
    assert advice({**status, "state": "FAULT", "fault": "BUS_OFF"})[0].startswith("Bus off.")


def test_who_has_just_armed_is_not_sent_to_arm_again():
    sentences = advice({**STATUS, "detail": "arming"}, by_command(Path("robots/mine.toml")))
    assert sentences == ("Wait: the robot is arming.",)
