"""The stack with poses by datagrams: a robot that is carried, a second sender, and headings that are no measurement."""

import math
from contextlib import ExitStack, closing

import msgspec
import pytest

from disco_hw.daemon.control_socket import status
from disco_hw.drive.coverage import Coverage
from disco_hw.drive.hand_pilot import HandPilot
from disco_hw.log.recorder import RecorderStats
from disco_hw.runtime.pipeline import NoPlanner
from disco_hw.runtime.robot_setup import load_setup
from disco_hw.runtime.supervisor import UserRequest
from drivers.types import PoseSample
from tests.drive.test_hand_pilot import Hand
from tests.runtime.pose_bench import PoseBench
from tests.runtime.simulated import arm, recorded, replayed, replies, robot_toml, simulated_stack, write_run
from tests.tables import thinned
from tools.faults.run import circling_planner


@pytest.fixture
def bench(tmp_path):
    with ExitStack() as opened:
        yield lambda lines="": opened.enter_context(
            closing(PoseBench(tmp_path, f'[pose]\nsource = "udp"\nport = PORT\n{lines}'))
        )


@thinned("off_m", [1.0, -0.3], quick=1)
def test_a_robot_that_is_carried_stops_its_task_and_says_so_and_its_operator_starts_it_again(bench, off_m):
    made = bench()
    carried = []
    made.send(25.0, lambda _t_s: off_m if carried else 0.0)
    assert made.start()
    assert made.stack.run(3.0)[-1].output.running
    assert not made.events("jump")
    carried.append(True)
    last = made.stack.run(2.0)[-1]
    assert not last.output.running
    assert last.command.left_rad_s == last.command.right_rad_s == 0.0
    (jump,) = made.events("poses: the pose jumped by")
    assert f"by {abs(off_m):.2f} m" in jump
    why = "which the motion of the wheels does not explain: the robot was carried or has slipped, or the measured poses"
    assert why in jump
    (stop,) = made.events("task stopped: the pose jumped by")
    assert stop.endswith("check that the robot is where the page shows it, then start again")
    (mismatch,) = made.events("poses: 3 poses in a row disagree with the wheels")
    assert f"{abs(off_m):.2f} m, and are not used" in mismatch
    # It never goes on by itself.
    assert not made.stack.run(1.5)[-1].output.running
    (reply,) = replies(made.stack.run(0.1, UserRequest.START))
    assert reply.accepted
    assert made.stack.run(0.5)[-1].output.running


def test_a_jump_while_nothing_runs_is_said_and_keeps_nobody_from_starting_later(bench):
    made = bench()
    carried = []
    made.send(25.0, lambda _t_s: 1.0 if carried else 0.0)
    made.stack.run(1.5)
    carried.append(True)
    made.stack.run(1.0)
    assert made.events("poses: the pose jumped by 1.00 m")
    made.stack.run(0.5, UserRequest.ARM)
    assert made.stack.run(0.5, UserRequest.START)[-1].output.running


@thinned(
    ("rate_hz", "stranger_hz", "off"),
    [(2.0, 25.0, lambda t_s: 1.0), (25.0, 250.0, lambda t_s: 0.03 * t_s), (25.0, 25.0, lambda t_s: 0.05)],
    quick=1,
)
def test_a_second_sender_is_refused_and_named_and_the_robot_stays_on_its_circle(bench, rate_hz, stranger_hz, off):
    made = bench()
    first = made.send(rate_hz)
    assert made.start()
    stranger = made.send(stranger_hz, off)
    last = made.stack.run(4.0)[-1]
    assert last.output.running
    assert made.error_m() < 0.05
    (named,) = made.events(f"poses: {stranger.name} sends poses while {first.name} does: not used")
    assert f"stop one of them; {first.name} is used until it has sent nothing for 2 s" in named
    assert made.stack.core.pose_source.refused > 3.5 * stranger_hz
    assert made.stack.core.pipeline.fusion.stats.poses_gated <= 2


def test_another_sender_takes_over_only_after_the_task_has_stopped_for_want_of_poses(bench):
    made = bench()
    first = made.send(25.0)
    assert made.start()
    second = made.send(25.0)
    made.stack.run(1.0)
    first.is_silent = True
    seen = made.stack.run(4.0)
    assert not seen[-1].output.running
    lines = made.events()
    stopped = lines.index("task stopped: no valid pose; check the pose sensor")
    (takeover,) = made.events(f"poses: poses now come from {second.name}; {first.name} has sent nothing for 2.0 s")
    assert stopped < lines.index(takeover)
    assert seen[-1].pipeline.estimate.pose_ok


def test_only_allowed_addresses_may_send(bench):
    made = bench('allow = ["10.0.0.0/8"]\n')
    sender = made.send(25.0)
    assert not made.start()
    (line,) = made.events("is not in pose.allow")
    assert line.startswith(f"poses: {sender.name} sends poses but is not in pose.allow: not used (1 datagrams)")


@thinned(
    "heading",
    [
        {"yaw_rad": 0.0, "yaw_std_rad": 0.0},
        {"yaw_rad": 0.3, "yaw_std_rad": -1.0},
        {"yaw_rad": 0.3, "yaw_std_rad": 316.0},
    ],
    ids=["identity", "minus one", "large"],
    quick=1,
)
def test_a_heading_that_is_said_to_be_unknown_is_not_used_and_the_operator_is_told(bench, heading):
    made = bench()
    made.send(25.0, transform=lambda pose: {**pose, **heading})
    assert not made.start()
    last = made.stack.core.last
    assert (last.pipeline.estimate.initialised, last.pipeline.estimate.heading_known) == (True, False)
    assert last.output.detail == "armed, commanding zero speed"
    assert made.error_m() < 0.05
    (line,) = made.events("only the positions are used")
    assert line.startswith("poses: udp: its poses have no heading, or a covariance that marks it as unknown")
    assert status(made.stack.core, {}, RecorderStats())["poses"][0]["heading"] == "none"


def test_a_heading_that_never_moves_is_found_out_by_the_first_turn_and_the_estimate_forgets_it(bench):
    """At first it fits: the circle begins with it."""
    made = bench()
    made.send(25.0, transform=lambda pose: {**pose, "yaw_rad": 0.5 * math.pi})
    assert made.start()
    last = made.stack.run(3.0)[-1]
    assert not last.output.running
    assert not last.pipeline.estimate.heading_known
    (line,) = made.events("the heading stays at 1.57 rad while the wheels turn the robot by")
    assert line.endswith("only the positions are used; check the pose sensor")
    assert status(made.stack.core, {}, RecorderStats())["poses"][0]["heading"] == "stands still"


@pytest.mark.thorough
def test_a_heading_sensor_that_dies_is_left_out_and_the_drive_goes_on_by_positions(bench):
    made = bench("offset = [0.1, 0.0]\n")
    dead = []

    def with_dead_heading(pose):
        if made.stack.now_us > 6_000_000 and not dead:
            dead.append(pose["yaw_rad"])
        yaw = pose["yaw_rad"]
        x, y = pose["x_m"] + 0.1 * math.cos(yaw), pose["y_m"] + 0.1 * math.sin(yaw)
        return {**pose, "x_m": x, "y_m": y, "yaw_rad": dead[0] if dead and made.stack.now_us < 14_000_000 else yaw}

    made.send(25.0, transform=with_dead_heading)
    assert made.start()
    last = made.stack.run(10.0)[-1]
    assert made.events("udp: the heading stays at")
    assert last.output.running, made.events()
    assert made.error_m() < 0.05
    last = made.stack.run(5.0)[-1]
    assert made.events("udp: its headings are used again")
    assert last.output.running
    assert made.error_m() < 0.03


@pytest.mark.thorough
def test_a_drive_whose_heading_is_left_out_on_the_way_is_replayed_bit_for_bit(tmp_path):
    """By hand, as the harness' planner is not the one that a replay makes."""
    stack = simulated_stack(NoPlanner())
    received = stack.core.pose_source.receive
    stack.core.pose_source.receive = lambda now_ns, poses: [
        msgspec.structs.replace(pose, yaw_rad=1.5) for pose in received(now_ns, poses)
    ]
    hand = Hand()
    stack.pilot = HandPilot(hand, Coverage(8.0))
    stack.run(1.5)
    hand.held = True
    found, truth = stack.run(4.0)[-1].pipeline.estimate, stack.robot.truth
    # It was forgotten, and found again by positions and motion.
    assert (found.reinitialisations, found.heading_known) == (1, True)
    assert abs(math.remainder(found.yaw_rad - truth.yaw_rad, math.tau)) < 0.2
    replayed(write_run(stack, tmp_path / "run.mcap"))
    assert {pose.yaw_rad for pose in recorded(stack, PoseSample)} == {1.5}


def test_a_first_pose_that_is_not_where_the_wheels_led_to_from_the_origin_stops_the_task(tmp_path):
    file = robot_toml(tmp_path, "[estimation]\npose_required = false\n")
    stack = simulated_stack(circling_planner(load_setup(file)), robot_file=file)
    received, enabled = stack.core.pose_source.receive, []
    stack.core.pose_source.receive = lambda now_ns, poses: received(now_ns, poses) if enabled else []
    arm(stack)
    assert stack.run(2.0, UserRequest.START)[-1].output.running
    enabled.append(True)
    seen = stack.run(0.5)
    assert not seen[-1].output.running
    assert any("task stopped: the pose jumped by" in event for tick in seen for event in tick.events)
