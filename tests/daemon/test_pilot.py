"""The pilot of `disco-hw run` leaves everything to the task."""

from __future__ import annotations

from disco_hw.daemon.pilot import PilotTick, TaskPilot
from disco_hw.daemon.supervisor import UserRequest
from disco_hw.pipeline import FollowTask, Manual, Source
from tests.daemon.simulated import simulated_stack


def test_a_task_is_followed_and_nothing_is_added():
    pilot = TaskPilot()
    assert pilot.step(0, None) == PilotTick((), FollowTask(), ())
    assert pilot.status() == {}
    assert not pilot.done


class Eager:
    """Wants to drive whatever the state, and asks for nothing."""

    done, needs_pose = False, True

    def step(self, now_ns, last):
        return PilotTick(motion=Manual(3.0, 3.0))

    def learn(self, now_ns, tick, replies):
        self.replies = replies

    def status(self):
        return {}


def test_what_a_pilot_wants_counts_only_where_the_supervisor_allows_motion():
    stack = simulated_stack()
    stack.pilot = Eager()
    assert all(tick.command is None for tick in stack.run(1.5))
    armed = stack.run(0.5, UserRequest.ARM)
    assert {tick.pipeline.source for tick in armed} <= {Source.OFF, Source.HOLD}
    running = stack.run(0.5, UserRequest.START)
    assert running[-1].pipeline.source is Source.MANUAL
    assert running[-1].command.left_rad_s == 3.0
    # Replies to others are none of the pilot's.
    assert stack.pilot.replies == ()
