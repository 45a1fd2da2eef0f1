"""Driving by hand in simulated time: the real tick, the real firmware, a finger of the test's."""

from __future__ import annotations

import re

import numpy as np
import pytest

from disco_hw.drive import ManualInput
from disco_hw.drive.coverage import Coverage
from disco_hw.drive.hand_pilot import HandPilot
from disco_hw.drive.script import ScriptSource, Unattended
from disco_hw.drive.scripts import STEP_S, STEPS, create_script
from disco_hw.log import records
from disco_hw.runtime import State
from disco_hw.runtime.pipeline import NoPlanner, Source
from disco_hw.runtime.supervisor import Reply, UserRequest
from tests.runtime.simulated import simulated_stack


class Hand:
    """Source of manual input that the test sets."""

    def __init__(self):
        self.wheels, self.held, self.gone, self.silent_since_ns = (3.0, 5.0), False, False, None
        self.ended, self.completed, self.status_text, self.task = None, True, "words", ""

    def poll(self, now_ns, robot):
        self.robot = robot
        if self.gone:
            return None
        return ManualInput(self.silent_since_ns or now_ns, *self.wheels, self.held)

    def close(self):
        pass


class Bench:
    def __init__(self):
        self.stack = simulated_stack(NoPlanner())
        self.hand, self.coverage = Hand(), Coverage(8.0)
        self.stack.pilot = HandPilot(self.hand, self.coverage)

    def run(self, seconds, **changes):
        for name, value in changes.items():
            setattr(self.hand, name, value)
        return self.stack.run(seconds)

    def driving(self):
        self.run(0.5)
        assert self.stack.core.last.output.state is State.READY
        self.run(0.9, held=True)
        assert self.stack.robot.truth.right_speed_rad_s == pytest.approx(5.0, abs=0.3)
        return self

    def largest_setpoint_rad_s(self):
        outputs = self.stack.robot.board.outputs
        return max(abs(outputs.left_setpoint_rad_s), abs(outputs.right_setpoint_rad_s))


@pytest.fixture
def bench():
    return Bench().driving()


def test_what_is_held_is_driven_and_recorded_as_executed(bench):
    commands = [r for _, tick in bench.stack.recorder.ticks for r in tick if isinstance(r, records.Command)]
    driven = [command for command in commands if command.in_force and command.source == "manual"]
    assert driven
    assert (driven[-1].left_rad_s, driven[-1].right_rad_s) == (3.0, 5.0)
    # The governor's ramp is what was executed, the step what was asked.
    assert driven[0].requested_right_rad_s == 5.0
    assert 0.0 < driven[0].right_rad_s < 0.7
    assert {item.name for item in bench.coverage.items() if item.found > 0.5} == {"curve left fast"}


@pytest.mark.parametrize("loss", [{"held": False}, {"gone": True}])
def test_release_and_loss_stop_and_disarm(loss, bench):
    ticks = bench.run(0.02, **loss)
    assert ticks[0].output.state is State.STOPPING
    assert ticks[0].pipeline.source is Source.HOLD
    bench.run(0.4)
    assert bench.largest_setpoint_rad_s() == 0.0
    bench.run(1.0)
    assert bench.stack.core.last.output.state is State.READY
    assert max(abs(bench.stack.robot.truth.left_speed_rad_s), abs(bench.stack.robot.truth.right_speed_rad_s)) < 0.05


def test_silence_stops_200_ms_after_the_last_input_and_nothing_arms_again(bench):
    bench.hand.silent_since_ns = bench.stack.now_us * 1000
    ticks = bench.run(0.3)
    moving = [tick for tick in ticks if tick.pipeline.source is Source.MANUAL]
    assert len(moving) == 10
    bench.run(1.5)
    assert bench.stack.core.last.output.state is State.READY
    bench.run(2.0, silent_since_ns=None)
    assert bench.stack.core.last.output.state is State.READY
    bench.run(0.1, held=False)
    bench.run(1.0, held=True)
    assert bench.stack.core.last.output.state is State.ARMED


def test_no_number_is_a_stop(bench):
    bench.run(0.6, wheels=(float("nan"), 5.0))
    assert bench.largest_setpoint_rad_s() == 0.0


def test_the_status_says_what_is_going_on(bench):
    reported = bench.stack.pilot.status()["drive"]
    assert reported["driving"]
    assert reported["words"] == "words"
    assert any("deadman pressed" in text for text in reported["messages"])
    assert reported["coverage"]["missing"]
    bench.run(0.1, held=False)
    assert any("released" in text for text in bench.stack.pilot.status()["drive"]["messages"])


def test_a_press_while_not_ready_is_reported_and_sends_nothing():
    bench = Bench()
    bench.run(0.5)
    bench.stack.robot.link.plug(False)
    bench.run(0.1)
    ticks = bench.run(0.5, held=True)
    assert all(tick.command is None for tick in ticks)
    assert any("not ready" in text for text in reported(bench))


def test_a_refusal_is_reported_and_needs_a_new_press(bench):
    bench.stack.pilot.learn(0, bench.stack.core.last, [Reply(UserRequest.ARM, False, "no recent wheel data")])
    assert bench.run(0.02)[0].output.state is State.STOPPING
    assert any("no recent wheel data" in text for text in reported(bench))
    assert bench.run(1.5)[-1].output.state is State.READY


def test_without_a_planner_a_task_does_nothing():
    stack = simulated_stack(NoPlanner())
    stack.run(0.5)
    stack.run(0.5, UserRequest.ARM)
    ticks = stack.run(1.0, UserRequest.START)
    assert {tick.pipeline.source for tick in ticks} == {Source.RAMP}
    assert "planner: there is no planner: the robot is driven by hand" in ticks[0].events
    assert all(tick.command.left_rad_s == tick.command.right_rad_s == 0.0 for tick in ticks)


def reported(bench):
    return bench.stack.pilot.status()["drive"]["messages"]


def test_the_end_of_the_source_is_the_pilots(bench):
    assert not bench.stack.pilot.done
    bench.run(0.02, ended="the end", held=False)
    assert bench.stack.pilot.done
    assert "the end" in bench.stack.pilot.status()["drive"]["messages"]


@pytest.mark.thorough
def test_steps_are_driven_within_the_limits_that_the_robot_showed():
    """The robot's wheels stop at 5 rad/s; 6.4 were asked for."""
    bench = Bench()
    bench.stack = simulated_stack(NoPlanner(), hide={"speed_limit": 5.0})
    script = create_script("steps", bench.stack.core.config.robot, bench.stack.core.task, 0.8, seed=1)
    bench.hand = ScriptSource(script, Unattended())
    bench.stack.pilot = HandPilot(bench.hand, bench.coverage)
    search_s = script.duration_s - STEPS * STEP_S
    bench.stack.run(1.5 + search_s + 2.0 * STEP_S)
    commands = [r for _, tick in bench.stack.recorder.ticks for r in tick if isinstance(r, records.Command)]
    driven = np.array([(c.requested_left_rad_s, c.requested_right_rad_s) for c in commands if c.source == "manual"])
    assert np.abs(driven).max() == pytest.approx(6.4)
    steps = [step for step in script.manoeuvres if step.within_limits]
    for number in (0, 1):
        here = driven[round((search_s - 0.6 + (number + 0.5) * STEP_S) * 50)]
        assert here == pytest.approx(np.array(steps[number].wheels(0.0)) * 5.0 / 6.4, abs=0.08)
    reported = [float(number) for number in re.findall(r"[-+]\d\.\d", bench.hand.task)]
    assert reported == pytest.approx([-5.0, 5.0, -5.0, 5.0], abs=0.15)
