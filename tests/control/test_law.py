"""A control law in the planner's place: what it is given, what its answer becomes, what of an answer is refused."""

from __future__ import annotations

import math

import numpy as np
import pytest

from disco_hw.control import NoValidControl, PlannerState
from disco_hw.control.plan import LawController
from disco_hw.model import Model
from disco_hw.model.step import simulate

STATE = PlannerState(7, 0.3, -0.2, 0.5, 1.0, 1.0)
MODEL = Model(0.06, 0.4, 0.2)


def test_a_law_gets_state_task_and_model_and_its_wheel_speeds_are_held():
    asked = []

    def law(*given):
        asked.append(given)
        return 1.0, np.float64(2.0)

    plan = LawController(law, MODEL, "task").plan(7, STATE)
    assert asked == [(STATE, "task", MODEL)]
    assert [plan.at(7 + round(t_s * 1e9)) for t_s in (0.0, 0.1, 0.4)] == [(1.0, 2.0)] * 3
    assert plan.t0_ns == 7


def test_the_pose_that_is_predicted_is_the_models():
    plan = LawController(lambda *_: (3.0, 4.0), MODEL, None).plan(0, STATE)
    start = np.array([STATE.x_m, STATE.y_m, STATE.yaw_rad, 3.0, 4.0])
    states = simulate(MODEL, np.full((400, 2), (3.0, 4.0)), 0.001, start)
    np.testing.assert_allclose(plan.trajectory, states[::100, :3], atol=2e-3)


@pytest.mark.parametrize(
    "answer", [None, (math.nan, 1.0), (1.0, math.inf), (1.0,), (1.0, 2.0, 3.0), "ab", 3.0, (None, 1.0)]
)
def test_an_answer_that_is_not_two_numbers_is_no_plan(answer):
    with pytest.raises(NoValidControl, match="two finite wheel speeds"):
        LawController(lambda *_: answer, MODEL, None).plan(0, STATE)


def test_another_task_is_handed_on_and_a_law_with_a_memory_is_reset():
    class Law:
        resets, tasks = 0, ()

        def __call__(self, _state, task, _model):
            self.tasks = (*self.tasks, task)
            return 0.0, 0.0

        def reset(self):
            self.resets += 1

    law = Law()
    controller = LawController(law, MODEL, "first")
    controller.reset()
    controller.plan(0, STATE)
    controller.set_task("second")
    controller.plan(0, STATE)
    assert (law.resets, law.tasks) == (1, ("first", "second"))
    assert not len(controller.sampled_rollouts(3).weights)
