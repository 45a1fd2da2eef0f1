"""The permit to move: every stage with every event, and what must hold after any of them."""

import random

import pytest
from msgspec.structs import replace

from drivers.motor.permit import STOPPED_FROM_OUTSIDE, Controllers, MotionPermit, Stage
from drivers.types import DriverState, Request, WheelCommand

NOW = 7_000_000_000
MS = 1_000_000
WELL = Controllers()
ILL = {name: Controllers(**{name: "why"}) for name in ("missing", "refused", "stopped", "faulty", "unfit")}
HOT = Controllers(energised=True)
COMMAND = WheelCommand(3.0, -2.0, 0.1)
RAMP = 10.0
REST, ARMING, ARMED, STOPPING, BRAKING = Stage
STANDBY, READY, ARM, RESET = Request

AT = {
    "rest": MotionPermit(link_is_up=True),
    "ready": MotionPermit(link_is_up=True, target=READY, speeds=(2.0, 1.0), zeros=9, since_ns=NOW - 3),
    "resetting": MotionPermit(link_is_up=True, target=RESET, fault="old"),
    "e-stopped": MotionPermit(link_is_up=True, estopped=True),
    "arming": MotionPermit(link_is_up=True, stage=ARMING, target=ARM, since_ns=NOW - 5, zeros=3, fed_ns=NOW - 20 * MS),
    "armed": MotionPermit(
        link_is_up=True, stage=ARMED, target=ARM, since_ns=NOW - 5, speeds=(1.0, -0.1), fed_ns=NOW - 20 * MS
    ),
    "stopping": MotionPermit(link_is_up=True, stage=STOPPING, speeds=(1.0, -0.1), fed_ns=NOW - 20 * MS),
    "braking": MotionPermit(link_is_up=True, stage=BRAKING, since_ns=NOW - 5),
}
EVENTS = {
    "looked": lambda permit: permit.looked(NOW),
    "link up": lambda permit: permit.linked(True),
    "link down": lambda permit: permit.linked(False),
    "restarted": lambda permit: permit.restarted("it restarted", "met anew"),
    "stand by": lambda permit: permit.requested(STANDBY, WELL),
    "be ready": lambda permit: permit.requested(READY, WELL),
    "arm": lambda permit: permit.requested(ARM, WELL),
    "arm, unfit": lambda permit: permit.requested(ARM, ILL["unfit"]),
    "do reset": lambda permit: permit.requested(RESET, WELL),
    "begun": lambda permit: permit.begun(NOW),
    "zero": lambda permit: permit.fed_zero(NOW),
    "proof": lambda permit: permit.armed(NOW),
    "command": lambda permit: permit.commanded(NOW, COMMAND),
    "slowed": lambda permit: permit.slowed(NOW, RAMP),
    "ramped": lambda permit: permit.ramped(),
    "stands": lambda permit: permit.rested(),
    "given up": lambda permit: permit.given_up("why"),
    "lost": lambda permit: permit.lost("why"),
    "e-stop": lambda permit: permit.stopped(),
    "e-stop heard": lambda permit: permit.stop_received(),
    "command heard": lambda permit: permit.command_received("wheel 3"),
    "reset": lambda permit: permit.reset(WELL),
}

GONE = {"stage": REST, "target": STANDBY, "since_ns": None}
DISARMED_BY_LINK = {**GONE, "note": "disarmed: the link was lost"}
MET = {**GONE, "events": ("met anew",)}
DISARMED_WITH_FAULT = {**GONE, "note": "disarmed: why", "fault": "why", "events": ("disarmed: why",)}
STOPPED = {**GONE, "note": "emergency stop sent", "estopped": True}
RECEIVED = {**GONE, "estopped": True, "events": (STOPPED_FROM_OUTSIDE,)}
SHARED = "another host is on the link: it commands wheel 3; disconnect it"
OTHER_HOST = "another host commands wheel 3; disconnect it"
FOREIGN = {
    **GONE, "shared": True, "note": f"disarmed: {OTHER_HOST}", "fault": OTHER_HOST,
    "events": (SHARED, f"disarmed: {OTHER_HOST}"),
}  # fmt: skip
ARMS = {"target": ARM, "stage": ARMING, "note": "arming", "since_ns": None, "zeros": 0, "speeds": (0.0, 0.0)}
SLOWS = {"stage": STOPPING, "note": "stopping as requested", "since_ns": None}
GIVEN_UP = {**GONE, "note": "why"}
LOOKED = {"looked_ns": NOW, "attentive_ns": NOW}
SAME = {
    "looked": LOOKED,
    "link up": GONE,
    "link down": {**GONE, "link_is_up": False},
    "restarted": MET,
    "stand by": {"target": STANDBY},
    "be ready": {"target": READY},
    "do reset": {"target": RESET},
    "begun": {"since_ns": NOW},
    "given up": GIVEN_UP,
    "lost": DISARMED_WITH_FAULT,
    "e-stop": STOPPED,
    "e-stop heard": RECEIVED,
    "command heard": FOREIGN,
    "arm": {"note": "not arming: on standby"},
    "arm, unfit": {"note": "not arming: on standby"},
}
"""What an event changes wherever nothing else is said below; nothing where it is not named either."""
AT_REST = {"command heard": {"shared": True, "events": (SHARED,)}}
LATCHED_FAULT = {"note": "not arming: old; remove the cause, then reset"}
LATCHED_STOP = {"note": "not arming: emergency stop; remove its cause, then reset"}
ON_THE_WAY = {
    "link up": DISARMED_BY_LINK,
    "link down": {**DISARMED_BY_LINK, "link_is_up": False},
    "restarted": {**MET, "note": "disarmed: it restarted"},
    "arm": {},
    "arm, unfit": {},
    "stand by": {**SLOWS, "target": STANDBY},
    "be ready": {**SLOWS, "target": READY},
    "do reset": {**SLOWS, "target": RESET},
    "begun": {},
}
OTHERWISE = {
    "rest": {**AT_REST, "arm": ARMS, "arm, unfit": {"note": "not arming: why"}},
    "ready": {**AT_REST, "begun": {}, "arm": ARMS, "arm, unfit": {"note": "not arming: why"}},
    "resetting": {
        **AT_REST,
        "arm": LATCHED_FAULT,
        "arm, unfit": LATCHED_FAULT,
        "reset": {"fault": None, "target": STANDBY},
    },
    "e-stopped": {
        **AT_REST,
        "arm": LATCHED_STOP,
        "arm, unfit": LATCHED_STOP,
        "e-stop heard": {**GONE, "estopped": True},
    },
    "arming": {
        **ON_THE_WAY,
        "zero": {"zeros": 4, "fed_ns": NOW},
        "proof": {"stage": ARMED, "note": "armed", "fed_ns": NOW, "speeds": (0.0, 0.0)},
    },
    "armed": {
        **ON_THE_WAY,
        "command": {"fed_ns": NOW, "speeds": (3.0, -2.0)},
    },
    "stopping": {
        "slowed": {"since_ns": NOW, "fed_ns": NOW, "speeds": (0.8, -0.0)},
        "ramped": {"stage": BRAKING, "since_ns": None},
        "stands": {"stage": REST, "since_ns": None},
    },
    "braking": {"begun": {}, "stands": {"stage": REST, "since_ns": None}},
}


@pytest.mark.parametrize("stage", AT)
def test_each_stage_takes_each_event_so(stage):
    before, otherwise = AT[stage], OTHERWISE[stage]
    expected = {event: replace(before, **otherwise.get(event, SAME.get(event, {}))) for event in EVENTS}
    assert {event: apply_event(before) for event, apply_event in EVENTS.items()} == expected


ESTOP_TEXT = "emergency stop; remove its cause, then reset"
STATES = [
    ({"link_is_up": False, "estopped": True}, WELL, DriverState.DISCONNECTED, "the link is down"),
    (
        {"estopped": True, "fault": "old"},
        ILL["refused"],
        DriverState.ESTOP,
        ESTOP_TEXT,
    ),
    ({}, ILL["stopped"], DriverState.ESTOP, "why"),
    ({"fault": "old"}, ILL["refused"], DriverState.REFUSED, "why"),
    ({"fault": "old"}, ILL["missing"], DriverState.FAULT, "old; remove the cause, then reset"),
    ({"stage": ARMED}, Controllers(missing="this", faulty="that"), DriverState.HANDSHAKE, "this"),
    ({"stage": ARMED}, ILL["faulty"], DriverState.FAULT, "why; remove the cause, then reset"),
    ({"stage": ARMED, "note": "armed"}, HOT, DriverState.ARMED, "armed"),
    ({"stage": ARMING, "target": ARM, "note": "arming"}, HOT, DriverState.ARMING, "arming"),
    ({"stage": STOPPING, "target": READY}, WELL, DriverState.STOPPING, "on standby"),
    ({"stage": BRAKING, "target": READY}, WELL, DriverState.STOPPING, "on standby"),
    ({"target": READY}, HOT, DriverState.STOPPING, "on standby"),
    ({"target": READY}, WELL, DriverState.READY, "on standby"),
    ({"target": READY}, ILL["unfit"], DriverState.READY, "why"),
    ({}, WELL, DriverState.STANDBY, "on standby"),
    ({}, ILL["unfit"], DriverState.STANDBY, "why"),
    ({"target": RESET}, WELL, DriverState.STANDBY, "on standby"),
]


@pytest.mark.parametrize(("fields", "seen", "state", "detail"), STATES)
def test_what_is_latched_comes_before_what_is_not_known_and_that_before_the_stage(fields, seen, state, detail):
    permit = MotionPermit(**{"link_is_up": True, **fields})
    assert permit.state(seen) is state
    assert permit.detail(seen) == detail


@pytest.mark.parametrize("ill", [*ILL.values(), HOT])
def test_only_controllers_that_are_well_and_at_rest_are_armed(ill):
    refused = AT["rest"].requested(ARM, ill)
    assert refused.stage is REST
    assert refused.target is STANDBY
    assert refused.note.startswith("not arming: ")
    assert AT["rest"].requested(ARM, WELL).stage is ARMING


@pytest.mark.parametrize("ill", [ILL["missing"], ILL["stopped"], ILL["faulty"], HOT])
def test_what_is_latched_is_not_cleared_of_controllers_that_were_not_heard_to_be_well(ill):
    latched = replace(AT["resetting"], estopped=True)
    assert latched.reset(ill) == latched
    cleared = latched.reset(WELL)
    assert (cleared.fault, cleared.estopped, cleared.target) == (None, False, STANDBY)


def test_refused_controllers_are_reset_for_nothing_arms_them():
    assert AT["resetting"].reset(Controllers(missing="its version", refused="another firmware")).fault is None


@pytest.mark.parametrize("event", ["restarted", "given up", "link up", "link down"])
def test_controllers_that_are_stopped_by_frames_are_sent_them_after_whatever_ends_a_drive(event):
    assert EVENTS[event](replace(AT["armed"], idle=BRAKING, after_loss=BRAKING)).stage is BRAKING


@pytest.mark.parametrize("event", ["lost", "e-stop", "e-stop heard", "command heard"])
def test_a_loss_and_an_emergency_stop_end_where_the_driver_says(event):
    assert EVENTS[event](replace(AT["armed"], after_loss=BRAKING)).stage is BRAKING
    assert EVENTS[event](replace(AT["armed"], idle=BRAKING)).stage is REST


def test_whoever_else_is_on_the_link_is_said_once_and_again_after_a_restart():
    reported = AT["rest"].command_received("wheel 3")
    assert reported.command_received("wheel 4").events == (SHARED,)
    assert reported.restarted("it restarted").command_received("wheel 3").events == (SHARED, SHARED)
    stopped = AT["armed"].stop_received()
    assert stopped.stop_received().events == (STOPPED_FROM_OUTSIDE,)


def test_an_emergency_stop_that_is_heard_again_stops_again():
    assert replace(AT["e-stopped"], after_loss=BRAKING).stop_received().stage is BRAKING


@pytest.mark.parametrize("stage", [ARMING, ARMED, STOPPING, BRAKING])
def test_what_is_latched_is_cleared_at_rest_alone(stage):
    latched = replace(AT["resetting"], stage=stage)
    assert latched.reset(WELL) == latched


def test_driving_is_whatever_holds_speeds_or_is_about_to():
    assert {stage for stage in Stage if MotionPermit(stage=stage).is_driving} == {ARMING, ARMED, STOPPING}


@pytest.mark.parametrize(
    ("stage", "speeds", "is_late"),
    [
        (ARMED, (0.0, 0.0), True),
        (STOPPING, (0.0, 0.1), True),
        (STOPPING, (0.0, 0.0), False),
        (ARMING, (0.0, 0.0), False),
        (BRAKING, (1.0, 1.0), False),
        (REST, (1.0, 1.0), False),
    ],
)
def test_late_is_a_command_only_to_those_that_hold_a_speed(stage, speeds, is_late):
    permit = MotionPermit(stage=stage, speeds=speeds, fed_ns=NOW)
    assert permit.is_late(NOW + 101 * MS, 0.1) is is_late
    assert not permit.is_late(NOW + 100 * MS, 0.1)


def test_a_pause_of_the_host_is_no_silence_of_the_controllers():
    permit = MotionPermit()
    for at_ms in range(0, 101, 20):
        permit = permit.looked(NOW + at_ms * MS)
    assert permit.silent_ns(NOW + 30 * MS) == 70 * MS
    assert permit.silent_ns(0) == 100 * MS
    back = permit.looked(NOW + 201 * MS)
    assert back.silent_ns(NOW + 30 * MS) == 0
    assert back.looked(NOW + 261 * MS).silent_ns(NOW + 30 * MS) == 60 * MS
    assert permit.looked(NOW + 175 * MS).silent_ns(NOW + 30 * MS) == 145 * MS


def test_a_stage_lasts_since_its_first_tick():
    assert AT["arming"].lasts_ns(NOW) == 5
    assert AT["stopping"].lasts_ns(NOW) == 0
    assert AT["stopping"].begun(NOW).lasts_ns(NOW + 7) == 7


@pytest.mark.parametrize(("elapsed_ns", "left"), [(-5, 4.0), (10 * MS, 3.9), (100 * MS, 3.0), (900 * MS, 3.0)])
def test_a_pause_counts_for_a_tenth_of_a_second_of_the_ramp(elapsed_ns, left):
    before = MotionPermit(stage=STOPPING, speeds=(4.0, -4.0), fed_ns=NOW)
    assert before.slowed(NOW + elapsed_ns, RAMP).speeds == pytest.approx((left, -left))


ONWARD = ("link up", "do reset", "reset", "stands", "arm", "proof", "command", "stand by", "ramped")


@pytest.mark.parametrize("seed", range(4))
def test_no_order_of_events_moves_it_without_proof_or_clears_what_is_latched_without_a_reset(seed):
    generator = random.Random(seed)
    permit = MotionPermit(idle=generator.choice((REST, BRAKING)), after_loss=generator.choice((REST, BRAKING)))
    reached = set()
    for _ in range(5000):
        name = generator.choice([*EVENTS, *ONWARD, *ONWARD, *ONWARD])
        before, permit = permit, EVENTS[name](permit)
        reached.add(permit.stage)
        if permit.stage is ARMED and before.stage is not ARMED:
            assert (name, before.stage) == ("proof", ARMING)
        if permit.stage is ARMING and before.stage is not ARMING:
            assert name == "arm"
            assert before.stage is REST
            assert before.fault is None
            assert not before.estopped
            assert before.link_is_up
        if max(map(abs, permit.speeds)) > max(map(abs, before.speeds)):
            assert (name, before.stage) == ("command", ARMED)
        assert permit.estopped or not before.estopped or name == "reset"
        assert permit.fault is not None or before.fault is None or name == "reset"
        assert (permit.target is ARM) == (permit.stage in (ARMING, ARMED))
        assert permit.events[: len(before.events)] == before.events
        permit = replace(permit, events=())
    assert reached == set(Stage)
