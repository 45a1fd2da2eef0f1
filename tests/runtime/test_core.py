"""The daemon's tick in simulated time against the virtual robot: from handshake to circle, and through trouble."""

from __future__ import annotations

import numpy as np
import pytest
from msgspec.structs import replace

from disco_hw.config import SHIPPED_ROBOT
from disco_hw.control import NoValidControl
from disco_hw.daemon import describe
from disco_hw.daemon.control_socket import loop_figures, status
from disco_hw.daemon.loop import LoopStats
from disco_hw.experiments.circle_report import Path, circle_figures
from disco_hw.log import records
from disco_hw.log.recorder import RecorderStats
from disco_hw.runtime import State, records_of_tick
from disco_hw.runtime.assembly import create_planner
from disco_hw.runtime.pipeline import NoPlanner, Source
from disco_hw.runtime.robot_setup import load_setup
from disco_hw.runtime.supervisor import UserRequest
from disco_hw.tasks.circle import CircleTask
from drivers.types import Identity, Limit, Limits, WheelSample
from firmware_protocol.firmware_core import FirmwareConfig
from sim.effects import hidden_effects
from sim.plant import Plant
from sim.plant_parameters import PlantParameters
from sim.virtual_robot import VirtualRobot
from tests.runtime.simulated import START, arm, recorded, replies, simulated_stack, start
from tests.tables import thinned

TASK = CircleTask(radius_m=0.3, speed_m_s=0.25)


@pytest.fixture(scope="module")
def lap():
    """One lap of the circle, and the stop after it."""
    stack = simulated_stack(start=replace(START, x_m=TASK.radius_m))
    stack.core.set_task(TASK)
    arm(stack)
    rows = []
    stack.run(0.02, UserRequest.START)
    while stack.core.progress.laps < 1.0 and stack.now_us < 60_000_000:
        stack.run(0.02)
        truth = stack.robot.truth
        rows.append((stack.now_us * 1e-6, truth.x_m, truth.y_m, truth.yaw_rad, truth.speed_m_s))
    stopping = stack.run(1.5, UserRequest.DISARM)
    return stack, Path(*np.array(rows).T), stopping


def test_the_circle_is_followed_and_the_stop_ends_in_ready_with_still_wheels(lap):
    stack, path, stopping = lap
    figures = circle_figures(path, TASK)
    assert figures.laps > 0.9
    assert figures.settled_rms_distance_m < 0.05
    assert stopping[-1].output.state is State.READY
    assert stack.robot.truth.left_speed_rad_s == pytest.approx(0.0, abs=0.05)
    assert stack.robot.board.outputs.state in {"STANDBY", "READY"}


def test_everything_is_recorded(lap):
    stack, _, _ = lap
    kinds = {type(record) for _, tick in stack.recorder.ticks for record in tick}
    assert {
        records.FrameIn, records.FrameOut, records.Estimate, records.Innovation, records.Plan, records.Command,
        records.Event,
    } <= kinds  # fmt: skip
    commands = recorded(stack, records.Command)
    assert len(commands) == len(stack.recorder.ticks)
    driven = [command for command in commands if command.in_force and command.source == "plan"]
    assert len(driven) > 300
    assert all(abs(command.left_rad_s) <= 8.0 and abs(command.right_rad_s) <= 8.0 for command in driven)


def test_no_command_frame_leaves_before_arming():
    stack = simulated_stack()
    stack.run(1.0)
    assert stack.core.last.output.state is State.READY
    sent = {frame.can_id for frame in recorded(stack, records.FrameOut)}
    assert sent
    assert 0x100 not in sent


def test_a_lost_link_voids_the_session_and_nothing_rearms():
    stack = simulated_stack()
    start(stack, 1.0)
    session = stack.robot.board.outputs.session
    assert abs(stack.robot.truth.right_speed_rad_s) > 1.0
    stack.robot.link.plug(False)
    ticks = stack.run(1.5)
    assert ticks[-1].output.state is State.DISCONNECTED
    assert abs(stack.robot.truth.right_speed_rad_s) < 0.05
    stack.robot.link.plug(True)
    ticks = stack.run(1.5)
    assert ticks[-1].output.state is State.READY
    assert all(tick.command is None for tick in ticks)
    assert abs(stack.robot.truth.right_speed_rad_s) < 0.05
    stack.run(0.5, UserRequest.ARM)
    assert stack.core.last.output.state is State.ARMED
    assert stack.robot.board.outputs.session != session


def exchanged(stack, **firmware):
    """Put another controller, that starts now, in the robot's place; the link stays up."""
    since_us, plant = stack.now_us, Plant(PlantParameters(), hidden_effects({}), 1, START)
    robot = VirtualRobot(plant, FirmwareConfig(**{"ticks_per_rev": 2048, "max_wheel_speed_rad_s": 8.0, **firmware}))

    class Robot:
        def receive(self, now_us, frame):
            robot.receive(now_us - since_us, frame)

        def step(self, now_us):
            return robot.step(now_us - since_us)

    stack.robot.board = Robot()


@thinned("limits", [{"max_wheel_speed_rad_s": 4.0}, {"ticks_per_rev": 1024}], quick=1)
def test_a_controller_exchanged_on_a_living_link_is_judged_anew(limits):
    stack = simulated_stack(NoPlanner(), needs_pose=False)
    assert stack.run(0.5)[-1].output.state is State.READY
    exchanged(stack, **limits)
    last = stack.run(1.5)[-1].output
    assert last.state is State.FAULT, last.detail
    assert next(iter(limits)) in last.detail
    assert not any(reply.accepted for reply in replies(stack.run(0.1, UserRequest.ARM)))
    # The one that fits is taken again, once a person has reset.
    exchanged(stack)
    stack.run(1.5)
    stack.run(0.1, UserRequest.RESET)
    assert stack.run(1.5)[-1].output.state is State.READY


def test_the_log_says_which_controller_answers_and_who_says_its_limits():
    stack = simulated_stack(NoPlanner(), needs_pose=False)
    stack.run(1.5)

    (first,) = recorded(stack, records.Controller)
    assert (first.controller, first.said_by) == ("reference controller", "device")
    assert (first.told["max_wheel_speed_rad_s"], first.told["ticks_per_rev"]) == (8.0, 2048.0)
    assert first.fixed == first.declared == {}
    shown = status(stack.core, loop_figures(LoopStats()), RecorderStats())
    assert shown["controller"]["limits"]["max_wheel_speed_rad_s"] == {"value": 8.0, "said_by": "device"}
    assert "controller: reference controller, firmware" in describe({**shown, "do": "status"}, SHIPPED_ROBOT)
    exchanged(stack, max_wheel_speed_rad_s=4.0)
    stack.run(1.5)
    assert recorded(stack, records.Controller)[-1].told["max_wheel_speed_rad_s"] == 4.0


def test_limits_are_recorded_under_who_says_them():
    limits = Limits(Limit(15.0, "robot.toml"), Limit(0.5, "fixed"), Limit(10.0, "robot.toml"))
    found = records_of_tick.controller(7, Identity("AgileX base", "", "robot.toml"), limits)
    assert (found.t_ns, found.told, found.fixed) == (7, {}, {"command_timeout_s": 0.5})
    assert found.declared == {"max_wheel_speed_rad_s": 15.0, "stop_deceleration_rad_s2": 10.0}


@pytest.mark.parametrize("disconnected", ["link", "robot"])
def test_what_a_robot_said_that_is_not_heard_any_more_is_not_its_state(disconnected):
    stack = simulated_stack(NoPlanner(), needs_pose=False)
    stack.run(0.5)
    stack.run(0.5, UserRequest.ESTOP)
    assert stack.core.robot_status.state == "ESTOP"
    if disconnected == "link":
        stack.robot.link.plug(False)
    else:
        stack.robot.board.step = lambda _now_us: ()
    stack.run(1.0)
    assert stack.core.robot_status is None


@pytest.mark.parametrize("speeds", [(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)])
def test_a_wheel_that_turns_either_way_on_either_side_keeps_the_robot_from_being_armed(speeds):
    stack = simulated_stack(NoPlanner(), needs_pose=False)
    stack.run(0.5)
    receive = stack.core.driver.receive

    def turning(now_ns, frames):
        readings, (left, right) = receive(now_ns, frames), speeds
        wheels = tuple(replace(sample, left_speed_rad_s=left, right_speed_rad_s=right) for sample in readings.wheels)
        return replace(readings, wheels=wheels)

    stack.core.driver.receive = turning
    stack.run(0.1)
    (reply,) = replies(stack.run(0.02, UserRequest.ARM))
    assert (reply.accepted, "the wheels are turning" in reply.text) == (False, True)


class Altered:
    """The shipped robot's planner, each plan of which `change(now_ns, plan)` alters or refuses."""

    def __init__(self, change):
        setup = load_setup(SHIPPED_ROBOT)
        self.inner, self.change = create_planner(setup.config, setup.model), change

    def plan(self, now_ns, state):
        return self.change(now_ns, self.inner.plan(now_ns, state))

    def reset(self):
        self.inner.reset()

    def set_belief(self, belief):
        self.inner.set_belief(belief)


def events_of_planner(ticks):
    return [text for tick in ticks for text in tick.events if text.startswith("planner")]


def test_a_planner_that_gives_up_is_followed_on_its_tail_then_the_wheels_ramp_down():
    def give_up(now_ns, plan):
        if now_ns > 1_400_000_000:
            raise NoValidControl("planted")
        return plan

    stack = simulated_stack(Altered(give_up))
    ticks = start(stack, 1.6)
    sources = [tick.pipeline.source for tick in ticks]
    tail = [k for k, source in enumerate(sources) if source is Source.TAIL]
    assert len(tail) == 10
    assert sources[tail[0] - 1] is Source.PLAN
    assert set(sources[tail[-1] + 1 :]) == {Source.RAMP}
    assert ticks[-1].pipeline.command.left_rad_s == 0.0
    assert ticks[-1].output.state is State.ARMED
    assert events_of_planner(ticks) == ["planner: planted"]


def test_the_wheels_of_a_tick_are_announced_before_it_is_planned_and_recorded():
    happened = []

    def refuse(now_ns, _plan):
        happened.append(("plan", now_ns))
        raise NoValidControl("planted")

    stack = simulated_stack(Altered(refuse))
    stack.core.announce = lambda now_ns, wheels: happened.append(("wheels", now_ns, *wheels))
    start(stack, 0.1)
    planned = [k for k, (what, *_) in enumerate(happened) if what == "plan"]
    assert planned
    assert all(happened[k - 1][:2] == ("wheels", happened[k][1]) for k in planned)
    samples = [(now_ns, *(one for one in rows if type(one) is WheelSample)) for now_ns, rows in stack.recorder.ticks]
    assert [announced for what, *announced in happened if what == "wheels"] == [
        list(tick) for tick in samples if len(tick) > 1
    ]


def test_plans_that_hang_on_too_few_samples_are_reported_once():
    def collapse(now_ns, plan):
        if not 1_300_000_000 <= now_ns <= 1_600_000_000:
            return plan
        return replace(plan, diagnostics=replace(plan.diagnostics, ess=1.2, collapsed=True))

    assert events_of_planner(start(simulated_stack(Altered(collapse)), 1.2)) == [
        "planner: plans rest on 1.2 effective samples, too few to trust the plan",
        "planner: enough effective samples again",
    ]


def test_runs_with_one_seed_are_equal_bit_for_bit():
    def commands():
        commands = [tick.pipeline.command for tick in start(simulated_stack(seed=3), 1.0)]
        return [(command.left_rad_s, command.right_rad_s) for command in commands]

    first = commands()
    assert any(left != 0.0 for left, _ in first)
    assert first == commands()
