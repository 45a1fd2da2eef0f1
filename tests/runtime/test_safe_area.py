"""Fence and obstacles in the daemon's tick: tasks and hands are stopped inside, it is said, recorded and replayed."""

from __future__ import annotations

import math
import socket
from pathlib import Path

import msgspec
import numpy as np
import pytest

from disco_hw.config import SHIPPED_ROBOT
from disco_hw.experiments.simulated_time import SimulatedRun, virtual_robot
from disco_hw.fence import Circle, Fence, Footprint
from disco_hw.fence.clearance import Boundaries
from disco_hw.log import records
from disco_hw.runtime import State
from disco_hw.runtime.core import PilotTick
from disco_hw.runtime.fence_guard import FenceGuard, FenceVerdict, StoppingSettings
from disco_hw.runtime.obstacles import (
    MOST_OBSTACLES,
    ObstacleRefused,
    ObstacleReport,
    Obstacles,
    UdpObstacles,
    obstacle_source_of,
    report_from,
    reports_in,
)
from disco_hw.runtime.pipeline import Limited, Manual, NoPlanner
from disco_hw.runtime.robot_setup import load_setup
from disco_hw.runtime.safe_area import OVERRIDE_NS, FenceRefused, SafeArea, fence_of_record, report_of_record
from disco_hw.runtime.supervisor import UserRequest
from drivers.pose.senders import RefusedDatagrams
from sim.body_dynamics import BodyPose
from sim.plant_parameters import PlantParameters
from tests.drivers.waiting import free_port
from tests.runtime.simulated import ROBOT_TEXT, arm, recorded, replayed, write_run

ROOM = ((-2.0, -1.5), (2.0, -1.5), (2.0, 1.5), (-2.0, 1.5))
FENCE = "\n[fence]\nkeep_in = [[-2, -1.5], [2, -1.5], [2, 1.5], [-2, 1.5]]\n"
SECOND_NS = 1_000_000_000
MIDDLE = BodyPose(0.0, 0.0, 0.0)
BOX = {"name": "box", "x_m": 0.0, "y_m": 0.0, "radius_m": 0.1}


class Hand:
    """A pilot by hand, at wheel speeds that a test sets."""

    needs_pose = False
    done = False

    def __init__(self):
        self.wheels = (0.0, 0.0)

    def step(self, now_ns, last):
        return PilotTick(motion=Manual(*self.wheels), by_hand=True)

    def learn(self, now_ns, tick, replies):
        pass


class FewObstacles:
    """A source that reports these obstacles once."""

    def __init__(self, reports):
        self.reports = reports
        self.refused = RefusedDatagrams()

    def receive(self, now_ns):
        reports, self.reports = self.reports, []
        return reports

    def close(self):
        pass


@pytest.fixture(scope="module")
def robot_file(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("fenced") / "robot.toml"
    # The controller brakes twice as hard as the robot may.
    gentle = ROBOT_TEXT.replace("max_wheel_acceleration_rad_s2 = 20.0", "max_wheel_acceleration_rad_s2 = 10.0")
    assert gentle != ROBOT_TEXT
    path.write_text(gentle + FENCE)
    return path


def by_hand(robot_file: Path, start: BodyPose = MIDDLE, **plant) -> tuple[SimulatedRun, Hand]:
    setup, hand = load_setup(robot_file), Hand()
    run = SimulatedRun(setup, virtual_robot(setup, PlantParameters(**plant), start), NoPlanner(), hand)
    arm(run)
    run.run(0.02, UserRequest.START)
    return run, hand


def left_m(run: SimulatedRun) -> float:
    truth, config = run.robot.truth, run.core.config
    bounds = Boundaries(config.robot.footprint, config.fence)
    return float(bounds.clearance_m(np.array([[truth.x_m, truth.y_m, truth.yaw_rad]]))[0])


def events_of(ticks, of: str = "fence:") -> list[str]:
    return [event for tick in ticks for event in tick.events if event.startswith(of)]


def test_a_hand_is_stopped_before_the_wall_and_may_leave_it(robot_file, tmp_path):
    run, hand = by_hand(robot_file, BodyPose(1.4, 0.0, 0.0))
    hand.wheels = (5.0, 5.0)
    ticks = run.run(2.0)
    assert any(tick.pipeline.fence.verdict is FenceVerdict.SCALED for tick in ticks)
    assert Limited.FENCE in ticks[-1].pipeline.command.limited
    assert ticks[-1].command.left_rad_s == 0.0
    assert 0.0 < left_m(run) < 0.10
    (event,) = events_of(ticks)
    assert event.startswith("fence: stopped: the stopping path would leave the fence at (1.")
    assert run.core.area.status(run.now_us * 1000)["verdict"] == "stopped"
    hand.wheels = (-5.0, -5.0)
    ticks = run.run(1.0)
    assert events_of(ticks) == ["fence: motion is allowed again"]
    assert left_m(run) > 0.2
    guards = recorded(run, records.GuardVerdict)
    assert {"free", "scaled", "stopped"} <= {one.verdict for one in guards}
    assert sum(bool(one.path_x_m) for one in guards) > len(guards) / 6
    replayed(write_run(run, tmp_path / "run.mcap"))


def test_a_task_is_left_where_its_stopping_path_would_leave_the_fence(robot_file):
    setup = load_setup(robot_file)
    run = SimulatedRun(
        setup, virtual_robot(setup, PlantParameters(), BodyPose(0.75, 0.0, 1.57)), NoPlanner(), needs_pose=True
    )
    arm(run)
    area = run.core.area
    area.report(run.now_us * 1000, ObstacleReport(name="box", x_m=0.75, y_m=0.5, radius_m=0.3, age_limit_s=60.0))
    assert run.run(0.1, UserRequest.START)[-1].output.running
    # Nobody plans here: what a plan would ask for is put in the guard's place.
    run.pilot.step = lambda now_ns, last: PilotTick(motion=Manual(5.0, 5.0))
    ticks = run.run(1.0)
    assert not ticks[-1].output.running
    (event,) = events_of(ticks, "task stopped")
    assert event.startswith("task stopped: fence: the stopping path would leave the fence at (0.")
    assert ticks[-1].output.state is State.ARMED


def test_without_a_pose_only_an_override_moves_the_robot(robot_file, tmp_path):
    run, hand = by_hand(robot_file, pose_dropout_probability=1.0)
    hand.wheels = (3.0, 3.0)
    ticks = run.run(0.5)
    assert all(tick.command.left_rad_s == 0.0 for tick in ticks)
    assert ticks[-1].pipeline.fence.reason == "no valid pose while a fence is set; check the pose sensor"
    assert run.core.area.task_fault == "fence: no valid pose while a fence is set; check the pose sensor"
    assert run.core.area.override(run.now_us * 1000, on=True) == "manual driving may leave the fence for 60 s"
    ticks = run.run(0.5)
    assert ticks[-1].command.left_rad_s == pytest.approx(3.0)
    assert events_of(ticks)[0].startswith("fence: OVERRIDDEN by the operator")
    assert run.core.area.status(run.now_us * 1000)["overridden_s"] == pytest.approx(59.5, abs=0.1)
    assert any(one.overridden for one in recorded(run, records.GuardVerdict))
    # It is the hand's alone.
    run.pilot.step = lambda now_ns, last: PilotTick(motion=Manual(3.0, 3.0))
    assert run.run(0.5)[-1].command.left_rad_s == 0.0
    run.pilot.step = lambda now_ns, last: PilotTick(motion=Manual(3.0, 3.0), by_hand=True)
    assert run.core.area.override(run.now_us * 1000, on=False) == "the fence is in force again"
    assert run.run(0.5)[-1].command.left_rad_s == 0.0
    replayed(write_run(run, tmp_path / "run.mcap"))


def test_an_override_ends_by_itself():
    area = area_of(Fence(keep_in=ROOM))
    area.override(0, on=True)
    assert area.begin(OVERRIDE_NS - 1, by_hand=True)
    assert not area.begin(OVERRIDE_NS - 1, by_hand=False)
    assert not area.begin(OVERRIDE_NS, by_hand=True)
    events, _ = area.end(OVERRIDE_NS, area.last, overridden=False)
    assert events[-1] == "fence: the manual override has ended; the fence is in force again"


def area_of(fence: Fence) -> SafeArea:
    footprint = Footprint(0.5, 0.4, 0.05)
    guard = FenceGuard(Boundaries(footprint, fence), StoppingSettings(0.05, 0.1, 20.0, 0.02), fence.margin_m)
    return SafeArea(guard, fence, footprint)


def test_an_obstacle_is_kept_to_its_age_limit_and_then_stops_the_robot(robot_file):
    run, hand = by_hand(robot_file)
    hand.wheels = (1.0, 1.0)
    now_ns = run.now_us * 1000
    run.core.area.report(now_ns, ObstacleReport(name="cart", x_m=-1.0, y_m=0.5, radius_m=0.2, age_limit_s=0.5))
    ticks = run.run(0.5)
    assert ticks[-1].command.left_rad_s > 0.5
    ticks = run.run(0.5)
    assert ticks[-1].command.left_rad_s == 0.0
    assert events_of(ticks) == [
        "fence: obstacle cart not reported for 0.5 s; the robot stops",
        "fence: stopped: obstacle cart is no longer reported; report it again or remove it",
    ]
    assert run.core.area.task_fault.startswith("fence: obstacle cart")
    run.core.area.handle_request(run.now_us * 1000, {"change": "remove", "name": "cart"})
    assert run.run(0.5)[-1].command.left_rad_s > 0.5


def report(name: str = "person", **fields) -> ObstacleReport:
    return ObstacleReport(**{"name": name, "x_m": 1.0, "y_m": 2.0, "radius_m": 0.3, **fields})


def test_an_obstacle_goes_on_with_its_velocity():
    obstacles = Obstacles()
    obstacles.report(SECOND_NS, report(vx_m_s=0.5, vy_m_s=-1.0, age_s=0.5, age_limit_s=2.0))
    (circle,) = obstacles.circles(SECOND_NS)
    assert (circle.x_m, circle.y_m) == (1.25, 1.5)
    (circle,) = obstacles.circles(2 * SECOND_NS)
    assert (circle.x_m, circle.y_m, circle.vx_m_s, circle.vy_m_s, circle.radius_m) == (1.75, 0.5, 0.5, -1.0, 0.3)
    assert obstacles.step(round(2.5 * SECOND_NS)) == ()
    assert obstacles.step(round(2.5 * SECOND_NS) + 1) == (
        "fence: obstacle person not reported for 2 s; the robot stops",
    )
    assert obstacles.lost == ("person",)
    assert obstacles.status(3 * SECOND_NS)[0]["lost"]
    assert obstacles.step(3 * SECOND_NS) == ()
    obstacles.report(3 * SECOND_NS, report())
    assert obstacles.step(3 * SECOND_NS) == ("fence: obstacle person is reported again",)
    assert obstacles.lost == ()


def test_thirty_two_obstacles_are_kept_and_no_more():
    obstacles = Obstacles()
    for number in range(MOST_OBSTACLES):
        obstacles.report(0, report(f"one{number}"))
    with pytest.raises(ObstacleRefused, match="there are 32 already; remove one first"):
        obstacles.report(0, report("another"))
    obstacles.report(0, report("one3", x_m=7.0))
    obstacles.remove("one3")
    obstacles.report(0, report("another"))
    with pytest.raises(ObstacleRefused, match="obstacle one3: not known; known obstacles: another, one0"):
        obstacles.remove("one3")


@pytest.mark.parametrize(
    "fields",
    [
        {"x_m": math.nan}, {"x_m": 900.0}, {"radius_m": 0.0}, {"radius_m": -1.0}, {"name": ""}, {"name": "a b"},
        {"vx_m_s": 50.0}, {"age_s": -1.0}, {"age_limit_s": 0.0}, {"age_limit_s": math.inf}, {"colour": 3.0},
    ],
)  # fmt: skip
def test_what_is_no_obstacle_is_refused_in_one_line(fields):
    assert report_from(BOX).age_limit_s == 1.0
    with pytest.raises(ObstacleRefused, match=r"obstacle: .*; write"):
        report_from(BOX | fields)
    with pytest.raises(ObstacleRefused):
        reports_in(msgspec.json.encode(BOX | fields))


def test_datagrams_of_one_and_of_several_are_taken():
    one = BOX | {"y_m": 1.0}
    assert [each.name for each in reports_in(msgspec.json.encode(one))] == ["box"]
    many = [BOX | {"name": f"box{k}"} for k in range(40)]
    assert len(reports_in(msgspec.json.encode(many))) == 40
    assert [each.y_m for each in reports_in(msgspec.msgpack.encode([one]))] == [1.0]
    for garbage in (b"", b"{", b"[1]", b"\xff\xff", b"{}" * 3):
        with pytest.raises(ObstacleRefused, match="what is no report of obstacles"):
            reports_in(garbage)


def test_reports_come_over_udp_and_of_what_is_not_used_it_is_said_why(robot_file):
    port, config = free_port(socket.SOCK_DGRAM), load_setup(robot_file).config
    fence = msgspec.structs.replace(config.fence, obstacles_port=port)
    source = obstacle_source_of(msgspec.structs.replace(config, fence=fence))
    assert isinstance(source, UdpObstacles)
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.sendto(b'{"name": "box", "x_m": 0.5, "y_m": 0, "radius_m": 0.1}', ("127.0.0.1", port))
            sender.sendto(b"nonsense", ("127.0.0.1", port))
            assert [one.name for one in source.receive(0)] == ["box"]
            assert list(source.receive(0)) == []
            (text,) = source.refused.new_messages()
            assert f"127.0.0.1:{sender.getsockname()[1]} sends what is no report of obstacles (" in text
            many = [BOX | {"name": f"box{k}"} for k in range(MOST_OBSTACLES + 2)]
            sender.sendto(msgspec.msgpack.encode(many), ("127.0.0.1", port))
            assert len(source.receive(10_000_000_000)) == MOST_OBSTACLES
        (text,) = source.refused.new_messages()
        assert text.startswith("obstacle box32 from 127.0.0.1:")
        assert "there may be 32; report the nearest ones" in text
        assert source.refused.count == 3
    finally:
        source.close()
    assert obstacle_source_of(config) is None


def test_of_an_obstacle_that_is_one_too_many_an_event_says_so(robot_file):
    run, _ = by_hand(robot_file)
    run.core.obstacle_source = FewObstacles([report(f"box{k}", x_m=9.0, y_m=9.0) for k in range(33)])
    assert [event for event in events_of(run.run(0.1)) if "box32" in event] == [
        "fence: obstacle box32: not used (1 datagrams); there may be 32; report the nearest ones"
    ]


def test_a_person_adds_and_removes_obstacles_and_all_is_recorded():
    area = area_of(Fence(keep_in=ROOM))
    added = area.handle_request(5, {"change": "add", "name": "pillar", "x_m": 0.5, "y_m": 0.0, "radius_m": 0.1})
    assert added == "obstacle pillar: valid for 600 s; without a newer report the robot then stops"
    assert area.handle_request(6, {"change": "remove", "name": "pillar"}) == "obstacle pillar: removed"
    _, written = area.end(7, area.last, overridden=False)
    assert [one.removed for one in written] == [False, True]
    assert report_of_record(written[0]).radius_m == 0.1
    for wrong in ({}, {"change": "add"}, {"change": "remove"}, {"change": "remove", "name": "x", "x_m": 1.0}):
        with pytest.raises(ObstacleRefused):
            area.handle_request(8, wrong)


def test_an_obstacle_whose_sender_says_that_it_is_gone_does_not_stop_the_robot():
    area = area_of(Fence(keep_in=ROOM))
    for name in ("box", "cart"):
        area.report(0, report(name))
    gone = report_from(BOX | {"removed": True})
    area.report(SECOND_NS // 2, gone)
    # A sender may repeat it, or mean one that was never reported.
    area.report(SECOND_NS // 2, gone)
    area.begin(2 * SECOND_NS, by_hand=False)
    assert area.obstacles.lost == ("cart",)
    _, written = area.end(2 * SECOND_NS, area.last, overridden=False)
    assert [(one.name, one.removed) for one in written] == [("box", False), ("cart", False), ("box", True)]
    with pytest.raises(ObstacleRefused, match="write add or remove"):
        area.handle_request(0, {"change": "add", **BOX, "removed": True})


def test_the_fence_is_changed_while_disarmed_only():
    area = area_of(Fence(keep_in=ROOM))
    for state in (State.ARMED, State.STOPPING):
        with pytest.raises(FenceRefused, match=rf"only while the robot is disarmed \(it is {state.name}\)"):
            area.change_fence(0, {"margin_m": 0.1}, state)
    for wrong in ({"keep_in": [[0, 0], [1, 1]]}, {"keep_in": 3}, {"margin": 0.1}, {"margin_m": -1.0}):
        with pytest.raises(FenceRefused, match="fence"):
            area.change_fence(0, wrong, State.READY)
    assert area.fence.keep_in == ROOM
    area.change_fence(3, {"keep_in": {"center": [0, 0], "radius_m": 3.0}}, State.READY)
    assert area.fence == Fence(keep_in=Circle((0.0, 0.0), 3.0))
    assert area.guard.boundaries.fence == area.fence
    events, (record,) = area.end(4, area.last, overridden=False)
    assert fence_of_record(record) == area.fence
    assert events == ("fence: changed until the daemon ends; robot.toml is not changed",)


@pytest.mark.parametrize(("of_robot_toml", "is_planned_around"), [(Fence(keep_in=ROOM), True), (Fence(), False)])
def test_a_new_fence_that_plans_do_not_avoid_is_said_to_be_one(of_robot_toml, is_planned_around):
    text = area_of(of_robot_toml).change_fence(0, {"margin_m": 0.1}, State.READY)
    assert text.startswith("the fence is changed until the daemon ends; write it into robot.toml to keep it")
    assert text.endswith("now only the guard keeps the robot inside") is not is_planned_around


def test_the_log_of_a_drive_round_the_edge_makes_its_fence(tmp_path):
    from disco_hw.errors import InputError
    from disco_hw.first_use.fence_drive import fence_of_log, fence_toml

    run, hand = by_hand(SHIPPED_ROBOT)
    hand.wheels = (1.0, 8.0)
    log = tmp_path / "edge.mcap"
    turned, before = 0.0, run.robot.truth.yaw_rad
    for _ in run.ticks(60.0):
        yaw = run.robot.truth.yaw_rad
        turned, before = turned + math.remainder(yaw - before, 2 * math.pi), yaw
        if turned > 2 * math.pi:
            break
    write_run(run, log)
    text = fence_toml(fence_of_log(log))
    assert text.startswith("[fence]\nkeep_in = [[")
    setup = load_setup(SHIPPED_ROBOT)
    short = SimulatedRun(setup, virtual_robot(setup, PlantParameters(), MIDDLE), NoPlanner(), Hand())
    short.run(0.1)
    write_run(short, tmp_path / "short.mcap")
    with pytest.raises(InputError, match=r"short\.mcap: the log holds no poses; drive once round"):
        fence_of_log(tmp_path / "short.mcap")
