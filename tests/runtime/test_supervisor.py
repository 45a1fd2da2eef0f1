import math
from dataclasses import replace

import pytest

from disco_hw.runtime import State
from disco_hw.runtime.supervisor import UserRequest
from drivers.types import DriverState, LinkState, Request
from firmware_protocol import status_codes
from tests.runtime.supervisor_bench import ARM, DISARM, ESTOP, RESET, SETTINGS, START, STOP, Bench


@pytest.fixture
def bench():
    return Bench()


def bench_in(state):
    return getattr(Bench(), state)()


def refusal(out):
    (reply,) = out.replies
    assert not reply.accepted
    return reply.text


# --- one test per row of the table -----------------------------------------------------------------------------------

STARTS = ["ready", "armed", "running", "stopping"]
NO_POSE = "no valid pose; check the pose sensor"
REFUSED = "udp: poses at (500000, 0) m are over 1000 m from the origin; set pose.origin"
UNKNOWN_HEADING = (
    "heading not known; the pose sensor measures none: drive one metre straight ahead by hand, on the page, to find it"
)
UNCERTAIN_HEADING = "heading too uncertain; wait for poses with a heading, then start again"
NOT_MEASURED = {"heading_missing": True, "measures_no_heading": True}
JUMP = "the pose jumped by 1.00 m and 0.10 rad, which the motion of the wheels does not explain"
AFTER_JUMP = f"{JUMP}; check that the robot is where the page shows it, then start again"


@pytest.mark.parametrize("start", [*STARTS, "faulted"])
@pytest.mark.parametrize(
    ("loss", "event"),
    [({"link_state": LinkState.CONNECTING}, "the link is down"), ({"link_generation": 2}, "the link was interrupted")],
    ids=["down", "interrupted"],
)
def test_a_lost_link_means_disconnected_no_command_and_another_handshake(start, loss, event):
    bench = bench_in(start)
    out = bench.tick(**loss)
    assert out.state is State.DISCONNECTED
    assert (out.motion_allowed, out.zero_only, out.running) == (False, False, False)
    assert event in out.events[-1]
    assert bench.tick(link_state=LinkState.UP, driver_state=DriverState.HANDSHAKE).state is State.HANDSHAKE


def test_without_a_link_it_says_why_and_what_to_do(bench):
    assert bench.tick(link_state=LinkState.CONNECTING).detail == "the link is connecting"
    hint = "serial /dev/ttyUSB0: no such device; plug the adapter in"
    out = bench.tick(ARM, link_state=LinkState.CONNECTING, link_error=hint)
    assert out.detail == hint
    assert hint in refusal(out)
    bench.tick(link_state=LinkState.UP, driver_state=DriverState.HANDSHAKE)
    mute = "/dev/ttyUSB0: open, but no frame received for 4 s"
    assert bench.tick(driver_state=DriverState.HANDSHAKE, link_error=mute).detail == mute
    assert bench.tick(driver_state=DriverState.HANDSHAKE, link_error=None).detail == "detail of the driver"


@pytest.mark.parametrize("start", STARTS)
@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"driver_state": DriverState.ESTOP}, "detail of the driver"),
        ({"driver_state": DriverState.FAULT}, "detail of the driver"),
        ({"driver_state": DriverState.REFUSED}, "detail of the driver"),
        ({"preflight_errors": ("speed limit above the firmware's",)}, "speed limit above the firmware's"),
    ],
)
def test_a_problem_means_fault_in_words_without_motion(start, changes, expected):
    bench = bench_in(start)
    out = bench.tick(**changes)
    assert out.state is State.FAULT
    assert out.driver_request is Request.STANDBY
    assert (out.motion_allowed, out.running) == (False, False)
    assert expected in out.detail
    assert expected in out.events[-1]
    assert out.estop == (changes.get("driver_state") is DriverState.ESTOP)


def test_a_fault_whose_words_end_with_the_remedy_has_it_once(bench):
    bench.running()
    out = bench.tick(driver_state=DriverState.FAULT, driver_detail="node 3 fell silent; remove the cause, then reset")
    assert out.detail == "node 3 fell silent; remove the cause, then reset"
    assert refusal(bench.tick(ARM)).count("reset") == 1
    assert bench.tick(preflight_errors=("limits differ",)).detail.endswith("then reset")


@pytest.mark.parametrize(
    ("fault", "ending"),
    [("OVER_TEMPERATURE_LEFT", "; it clears by itself, then reset"),
     ("SELF_TEST_FAILED", "; then restart the controller, then reset"),
     ("STALL_LEFT", "motor's cable; then reset")],
)  # fmt: skip
def test_a_fault_of_the_robot_is_followed_by_this_hosts_reset_without_another_remedy(fault, ending, bench):
    bench.running()
    out = bench.tick(driver_state=DriverState.FAULT, driver_detail=status_codes.fault(fault))
    assert out.detail.endswith(ending)
    assert "correct it" not in out.detail
    assert refusal(bench.tick(ARM)).endswith(ending)


@pytest.mark.parametrize("start", [*STARTS, "arming"])
def test_estop_means_fault_in_the_same_tick_and_its_frames_until_the_robot_shows_it(start):
    bench = bench_in(start)
    bench.robot_obeys = False
    out = bench.tick(ESTOP)
    assert out.state is State.FAULT
    assert out.estop
    assert not out.motion_allowed
    assert out.replies[0].accepted
    for _ in range(5):
        assert out.send_estop
        out = bench.tick()
    out = bench.tick(driver_state=DriverState.ESTOP)
    assert out.estop
    assert not out.send_estop


def test_reset_leads_from_fault_by_handshake_to_ready_and_not_to_armed():
    bench = Bench().faulted()
    assert bench.tick(RESET).driver_request is Request.RESET
    assert bench.tick().state is State.HANDSHAKE
    assert bench.tick(count=50).state is State.READY
    assert Request.ARM not in bench.requests_sent


@pytest.mark.parametrize(
    ("requests", "changes", "zero_only"),
    [([DISARM], {}, True), *(([], {"telemetry_age_s": age_s}, False) for age_s in (0.16, None, math.nan, math.inf))],
    ids=["disarm", "late telemetry", "no telemetry", "nan", "inf"],
)
def test_a_disarm_stops_in_the_same_tick_and_lost_telemetry_stops_sending_too(requests, changes, zero_only):
    out = Bench().running().tick(*requests, **changes)
    assert out.state is State.STOPPING
    assert out.driver_request is Request.STANDBY
    assert (out.motion_allowed, out.zero_only, out.running) == (False, zero_only, False)


@pytest.mark.parametrize("robot", [DriverState.STOPPING, DriverState.STANDBY, DriverState.READY, DriverState.HANDSHAKE])
def test_a_robot_that_stops_by_itself_ends_the_run(robot):
    bench = Bench().running()
    out = bench.tick(driver_state=robot, driver_detail="no wheel command arrived in time")
    assert out.state is State.STOPPING
    assert "no longer armed: no wheel command arrived in time; waiting" in out.detail
    assert any("no longer armed: no wheel command arrived in time" in event for event in out.events)
    assert bench.tick(count=50).state is State.READY
    assert Request.ARM not in bench.requests_sent[-50:]


@pytest.mark.parametrize("start", ["connected", "ready"])
@pytest.mark.parametrize("robot", [DriverState.ARMING, DriverState.ARMED, DriverState.STOPPING])
def test_a_robot_armed_unasked_or_found_armed_is_stopped(start, robot):
    out = bench_in(start).tick(driver_state=robot)
    assert out.state is State.STOPPING
    assert out.driver_request is Request.STANDBY


@pytest.mark.parametrize(
    ("start", "changes"),
    [
        ("ready", {"driver_state": DriverState.HANDSHAKE}),
        ("stopping", {"driver_state": DriverState.HANDSHAKE}),
        ("ready", {"telemetry_age_s": 0.16}),
    ],
)
def test_a_robot_that_restarts_or_falls_silent_begins_with_a_handshake(start, changes):
    bench = bench_in(start)
    assert bench.tick(**changes).state is State.HANDSHAKE
    assert bench.tick(driver_state=DriverState.STANDBY, telemetry_age_s=0.01).state is State.READY


def test_the_way_up_to_ready(bench):
    bench.robot_obeys = False
    assert bench.tick(link_state=LinkState.CONNECTING).state is State.DISCONNECTED
    assert bench.tick(link_state=LinkState.UP).state is State.HANDSHAKE
    assert bench.tick(count=10).state is State.HANDSHAKE
    assert bench.tick(driver_state=DriverState.STANDBY, telemetry_age_s=None).state is State.HANDSHAKE
    assert bench.tick(telemetry_age_s=0.01).state is State.READY
    assert bench.out.driver_request is Request.READY


def test_arming_needs_a_request_and_holds_zero():
    bench = Bench().ready()
    assert bench.tick(count=100).state is State.READY
    assert bench.tick(ARM).driver_request is Request.ARM
    assert bench.tick(count=3).state is State.ARMED
    assert bench.requests_sent.count(Request.ARM) == 1
    assert bench.out.zero_only
    assert not bench.out.motion_allowed


def test_stopping_lasts_until_the_robot_is_disarmed_and_the_wheels_are_still():
    bench = Bench().stopping()
    assert bench.tick(wheel_speed_rad_s=3.0).zero_only
    assert bench.tick(driver_state=DriverState.STANDBY, wheel_speed_rad_s=0.051).state is State.STOPPING
    assert bench.tick(driver_state=DriverState.STANDBY, wheel_speed_rad_s=math.nan).state is State.STOPPING
    assert bench.tick(driver_state=DriverState.ARMED, wheel_speed_rad_s=0.0).state is State.STOPPING
    assert bench.tick(driver_state=DriverState.STANDBY, telemetry_age_s=0.2).state is State.STOPPING
    assert bench.tick(driver_state=DriverState.STANDBY, telemetry_age_s=0.01).state is State.READY


# --- the task ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("pose_required", "lost", "found", "reason"),
    [
        (True, {"pose_ok": False}, {"pose_ok": True}, NO_POSE),
        (True, {"pose_ok": False, "pose_refusal": REFUSED}, {"pose_ok": True}, f"no valid pose; {REFUSED}"),
        (True, NOT_MEASURED, {"heading_missing": False}, UNKNOWN_HEADING),
        (False, NOT_MEASURED, {"heading_missing": False}, UNKNOWN_HEADING),
        (
            True,
            {"heading_missing": True, "pose_ok": False},
            {"heading_missing": False, "pose_ok": True},
            UNCERTAIN_HEADING,
        ),
        (True, {"pose_jump": JUMP}, {"pose_jump": ""}, AFTER_JUMP),
    ],
    ids=["pose", "refused", "heading", "heading-no-pose-required", "heading-lost", "jump"],
)
def test_without_a_reliable_pose_a_task_stops_for_good_and_none_is_started(pose_required, lost, found, reason):
    bench = Bench(replace(SETTINGS, pose_required=pose_required)).running()
    out = bench.tick(**lost)
    assert (out.state, out.motion_allowed, out.zero_only) == (State.ARMED, False, True)
    assert out.events[-1] == f"task stopped: {reason}"
    # It is well again, and nobody has asked for motion again.
    assert not bench.tick(**found, count=10).motion_allowed
    assert refusal(bench.tick(START, **lost)) == reason
    assert not bench.tick(count=5).motion_allowed
    assert bench.tick(START, **found).motion_allowed


def test_without_pose_required_the_task_runs_on_odometry():
    assert Bench(replace(SETTINGS, pose_required=False)).running().tick(pose_ok=False).motion_allowed


@pytest.mark.parametrize(
    "lost", [{}, {"pose_ok": False}, {"heading_missing": True}], ids=["nothing", "pose", "heading"]
)
def test_start_during_arming_starts_once_armed_unless_the_pose_is_lost_meanwhile(lost):
    bench = Bench().ready()
    bench.tick(ARM, START)
    allowed = [bench.tick(**lost).motion_allowed for _ in range(4)]
    assert bench.out.state is State.ARMED
    assert any(allowed) is not bool(lost)
    assert bench.tick(pose_ok=True, heading_missing=False, count=4).running is not bool(lost)


def test_ready_says_that_the_heading_is_missing():
    assert "drive one metre" in Bench().ready().tick(**NOT_MEASURED).detail
    assert Bench().ready().tick(heading_missing=True).detail.endswith(UNCERTAIN_HEADING)


@pytest.mark.parametrize("by_hand", [True, False])
def test_who_started_by_hand_has_not_started_the_task_nor_the_other_way_round(by_hand):
    bench = Bench().ready()
    bench.tick(ARM, START, by_hand=by_hand)
    assert bench.tick(count=4).motion_allowed
    assert not bench.tick(by_hand=not by_hand).motion_allowed
    assert not bench.tick(by_hand=by_hand, count=5).motion_allowed


@pytest.mark.parametrize("lost", [{"heading_missing": True, "pose_ok": False}, {"pose_jump": JUMP}])
def test_by_hand_the_robot_is_started_and_moves_without_a_reliable_pose(lost):
    bench = Bench().ready()
    bench.tick(ARM, START, by_hand=True, **lost)
    assert bench.tick(count=4).motion_allowed


@pytest.mark.parametrize("undo", [STOP, DISARM, ESTOP])
def test_what_comes_after_arm_and_start_in_the_same_tick_wins(undo):
    bench = Bench().ready()
    bench.tick(ARM, START, undo)
    assert not bench.tick(count=20).running


# --- pending requests -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("loss", [{"link_state": LinkState.CONNECTING}, {"link_generation": 2}])
def test_arm_and_start_pending_at_a_link_loss_are_dropped_and_nothing_rearms(loss):
    bench = Bench().ready()
    bench.robot_obeys = False
    bench.tick(ARM, START)
    bench.requests_sent.clear()
    bench.tick(**loss)
    assert any("arm request dropped" in event for event in bench.events)
    assert any("start request dropped" in event for event in bench.events)
    bench.robot_obeys = True
    bench.tick(link_state=LinkState.UP, link_generation=3, driver_state=DriverState.HANDSHAKE)
    assert bench.tick(count=100).state is State.READY
    assert Request.ARM not in bench.requests_sent


def test_arming_that_the_robot_never_finishes_or_refuses_is_given_up(bench):
    bench.ready().robot_obeys = False
    bench.tick(ARM)
    assert bench.tick(count=99, driver_state=DriverState.ARMING).detail == "arming"
    assert bench.tick(count=3).state is State.STOPPING
    assert any("the robot did not arm within 2 s: detail of the driver" in event for event in bench.events)
    refusing = Bench().ready()
    refusing.robot_obeys = False
    refusing.tick(ARM)
    refusing.tick(driver_state=DriverState.ARMING)
    assert refusing.tick(driver_state=DriverState.READY).driver_request is Request.READY
    assert any("did not arm: detail of the driver" in event for event in refusing.events)


def test_a_reset_without_effect_is_given_up_and_said_and_an_estop_ends_it():
    bench = Bench().faulted()
    bench.robot_obeys = False
    bench.tick(RESET)
    assert bench.tick(count=149).driver_request is None
    assert bench.tick(count=2).driver_request is Request.STANDBY
    assert any("did not reset within 3 s: detail of the driver" in event for event in bench.events)
    bench.tick(RESET)
    out = bench.tick(ESTOP)
    assert (out.state, out.driver_request) == (State.FAULT, Request.STANDBY)


@pytest.mark.parametrize("start", ["ready", "running"])
def test_after_a_disarm_even_during_arming_the_robot_can_be_armed_again(start):
    bench = bench_in(start)
    bench.tick(ARM)
    assert bench.tick(DISARM).state is State.STOPPING
    assert bench.tick(count=50).state is State.READY
    bench.tick(ARM, START)
    assert bench.tick(count=5).motion_allowed


def test_estop_asked_while_disconnected_is_sent_when_the_link_is_up(bench):
    bench.tick(link_state=LinkState.CONNECTING)
    out = bench.tick(ESTOP)
    assert not out.send_estop
    assert "as soon as the link is up" in out.replies[0].text
    assert bench.tick(link_state=LinkState.UP).send_estop
    assert bench.tick(count=5).state is State.FAULT


# --- refusals in words ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("start", "request_", "changes", "reason"),
    [
        ("connected", ARM, {"link_state": LinkState.CONNECTING}, "link is connecting"),
        ("connected", ARM, {"driver_state": DriverState.HANDSHAKE}, "detail of the driver"),
        ("ready", ARM, {"wheel_speed_rad_s": 0.06}, "turning"),
        ("ready", ARM, {"telemetry_age_s": 0.06}, "no recent wheel data"),
        ("stopping", ARM, {}, "stopping"),
        ("faulted", ARM, {}, "e-stop requested by the operator"),
        ("ready", START, {}, "arm it first"),
        ("armed", START, {"telemetry_age_s": 0.06}, "no recent wheel data"),
        ("ready", RESET, {}, "nothing to reset"),
    ],
)
def test_a_request_is_refused_with_the_reason(start, request_, changes, reason):
    assert reason in refusal(bench_in(start).tick(request_, **changes))


def test_a_reset_is_refused_while_a_check_fails_and_before_the_robot_shows_the_estop():
    bench = Bench().ready()
    bench.tick(preflight_errors=("limits differ",))
    assert "limits differ" in refusal(bench.tick(RESET))
    bench = Bench().ready()
    bench.robot_obeys = False
    bench.tick(ESTOP)
    assert "not confirmed" in refusal(bench.tick(RESET))


@pytest.mark.parametrize("order", [(ESTOP, ARM), (ARM, ESTOP)])
def test_estop_beats_arm_in_the_same_tick_in_either_order(order):
    bench = Bench().ready()
    out = bench.tick(*order)
    assert [reply.accepted for reply in out.replies] == [request is ESTOP for request in order]
    assert out.state is State.FAULT
    assert Request.ARM not in bench.requests_sent


def test_what_it_says_and_allows_in_each_step_of_a_drive(bench):
    def seen(*requests, **changes):
        out = bench.tick(*requests, **changes)
        return out.state, out.detail, out.motion_allowed, out.zero_only

    assert bench.ready().out.detail == "ready to be armed"
    assert bench.tick(ARM).detail == "arming"
    bench.tick(count=3)
    holding = (State.ARMED, "armed, commanding zero speed", False, True)
    running = (State.ARMED, "running the task", True, False)
    assert seen() == holding
    assert seen(START) == running
    assert bench.out.running
    stale = (State.ARMED, "no recent wheel data from the robot: commanding zero speed", False, True)
    assert seen(telemetry_age_s=0.06) == stale
    assert seen(telemetry_age_s=0.01) == running
    assert seen(STOP) == holding
    assert not bench.out.running


def test_asking_twice_is_harmless():
    bench = Bench().running()
    assert bench.tick(ARM, START).replies[0].text == "already armed"
    assert bench.out.motion_allowed
    bench.tick(STOP, STOP, DISARM, DISARM)
    assert all(reply.accepted for reply in bench.out.replies)


# --- recording -------------------------------------------------------------------------------------------------------


def test_what_would_not_be_recorded_is_armed_only_if_that_is_asked_for_and_not_stopped(bench):
    fault = "nothing is being recorded: no room"
    assert refusal(bench.ready().tick(ARM, recording_fault=fault)) == fault
    assert bench.tick(count=5).state is State.READY
    assert bench.tick(UserRequest.ARM_UNRECORDED).replies[0].accepted
    assert bench.tick(count=5).state is State.ARMED
    out = Bench().running().tick(recording_fault=fault, count=5)
    assert (out.state, out.running) == (State.ARMED, True)
    assert bench.tick(ARM).replies[0].text == "already armed"


@pytest.mark.parametrize(
    ("start", "changes"), [("faulted", {}), ("stopping", {}), ("ready", {"wheel_speed_rad_s": 1.0})]
)
def test_to_arm_unrecorded_needs_all_else_that_arming_needs(start, changes):
    assert not bench_in(start).tick(UserRequest.ARM_UNRECORDED, **changes).replies[0].accepted


@pytest.mark.parametrize(
    ("off_end_m", "event"),
    [
        (0.07, "task stopped: the end of the path is reached"),
        (3.0, "task stopped: the end of the path is reached, 3.00 m beside it"),
    ],
)
def test_a_task_that_ends_beside_its_end_says_how_far(off_end_m, event):
    bench = Bench().ready()
    bench.tick(ARM, START, count=10)
    assert bench.out.running
    out = bench.tick(task_finished=True, off_end_m=off_end_m)
    assert (out.running, out.events[-1]) == (False, event)


@pytest.mark.parametrize(("off_end_m", "where"), [(0.07, "its end;"), (3.0, "its end, 3.00 m off;")])
def test_a_task_that_is_over_as_it_starts_is_no_success(off_end_m, where):
    bench = Bench().ready()
    bench.tick(ARM, count=10)
    bench.tick(START)
    (event,) = bench.tick(task_finished=True, off_end_m=off_end_m).events
    assert event.startswith(f"task stopped: nothing was driven, as the nearest place of the path is {where}")
    assert "first way-point" in event
