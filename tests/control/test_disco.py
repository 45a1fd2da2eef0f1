"""The planner as a whole: it drives the circle, repeats itself bit for bit, and falls soft when nothing works."""

import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from disco_hw.control import (
    CommandLimits,
    Disco,
    DiscoSettings,
    NoValidControl,
    PlannerState,
    PlanOutcome,
    Sampler,
    SentCommand,
)
from disco_hw.control.kernel.step import disco_step
from disco_hw.experiments.circle import KinematicPlant
from disco_hw.model import EffectSetting, Gaussian
from disco_hw.tasks.circle import CircleCost
from tests.tables import thinned
from tests.tasks.costs import instant_cost
from tests.tasks.drives import MEAN, MODEL

LIMITS = CommandLimits(8.0, 20.0)
TANGENT = PlannerState(0, 0.75, 0.0, math.pi / 2, 0.0, 0.0)
PERIOD_NS = 100_000_000


def tangent(**changes):
    """Return the state on the circle that faces along it, otherwise at rest, with these changes."""
    return msgspec.structs.replace(TANGENT, **changes)


def planner(model=MODEL, task=None, seed=3, limits=LIMITS, **changes):
    return Disco(model, task or CircleCost(), replace(DiscoSettings(), **changes), limits, seed)


def sampling_planner(**changes):
    """Return a planner whose plans are those of the sampling update, without a refinement."""
    return planner(refine=False, **changes)


def drive(disco, seconds, period_s=0.1, wheel_noise=0.0, late_steps=0):
    """Drive a plant with the posterior's mean, to which commands come late; returns instant costs and commands."""
    plant = KinematicPlant(MEAN, (0.75, 0.0, math.pi / 2), 0.1, wheel_noise, 1)
    costs, commands, sent, queue = [], [], (), [(0.0, 0.0)] * late_steps
    for step in range(round(seconds / period_s)):
        now_ns = round(step * period_s * 1e9)
        state = PlannerState(now_ns, plant.x_m, plant.y_m, plant.yaw_rad, *plant.wheels, sent=sent)
        command = disco.plan(now_ns, state).at(now_ns)
        sent = (*sent[-20:], SentCommand(now_ns, *command))
        queue.append(command)
        plant.advance(*queue.pop(0), period_s)
        costs.append(instant_cost(disco.task, plant.x_m, plant.y_m, plant.forward_m_s))
        commands.append(command)
    return np.array(costs), np.array(commands)


def test_drives_the_circle_smoothly_from_rest():
    costs, commands = drive(planner(), 20.0, wheel_noise=0.05)
    assert costs[100:].mean() < 0.03
    assert np.abs(np.diff(commands, axis=0)).mean() / (2.0 * math.pi) < 0.03


def test_sampling_more_often_does_not_make_the_command_restless():
    _, slow = drive(sampling_planner(), 15.0, period_s=0.1, wheel_noise=0.05)
    _, fast = drive(sampling_planner(), 15.0, period_s=0.02, wheel_noise=0.05)
    steady_slow, steady_fast = slow[50:], fast[250:]
    in_a_tenth = [np.abs(steady_slow[1:] - steady_slow[:-1]).mean(), np.abs(steady_fast[5:] - steady_fast[:-5]).mean()]
    assert in_a_tenth[1] < in_a_tenth[0]
    travel = [np.abs(np.diff(steady_slow, axis=0)).mean() * 10.0, np.abs(np.diff(steady_fast, axis=0)).mean() * 50.0]
    assert travel[1] < 1.1 * travel[0]


def test_the_same_seed_and_states_give_the_same_plans_bit_for_bit():
    plans = []
    for _ in range(2):
        disco = planner(seed=5)
        plans.append([disco.plan(t * PERIOD_NS, TANGENT) for t in range(5)])
    for one, other in zip(*plans, strict=True):
        np.testing.assert_array_equal(one.wheel_speeds, other.wheel_speeds)
        np.testing.assert_array_equal(one.trajectory, other.trajectory)
        assert one.diagnostics == other.diagnostics
    assert not np.array_equal(planner(seed=6).plan(0, TANGENT).wheel_speeds, plans[0][0].wheel_speeds)


def test_warming_up_changes_no_plan():
    cold, warm = planner(seed=9), planner(seed=9)
    warm.warm_up()
    np.testing.assert_array_equal(cold.plan(0, TANGENT).wheel_speeds, warm.plan(0, TANGENT).wheel_speeds)


def test_commands_stay_within_speed_and_acceleration():
    disco = planner(task=CircleCost(speed_m_s=3.0), limits=CommandLimits(2.0, 1.0))
    for t in range(20):
        plan = disco.plan(t * PERIOD_NS, TANGENT)
        assert np.abs(plan.wheel_speeds).max() <= 2.0 + 1e-5
        steps = np.diff(np.vstack([[0.0, 0.0], plan.wheel_speeds]), axis=0)
        assert np.abs(steps).max() <= 0.1 + 1e-5


def test_the_first_command_is_tied_to_what_was_sent_and_to_the_measured_wheels():
    disco = planner(task=CircleCost(speed_m_s=3.0), limits=CommandLimits(8.0, 5.0))
    sent = (SentCommand(-PERIOD_NS, 4.0, 4.0),)
    rolling = disco.plan(0, tangent(left_speed_rad_s=4.0, right_speed_rad_s=4.0, sent=sent))
    assert np.all(np.abs(rolling.wheel_speeds[0] - 4.0) <= 0.5 + 1e-5)
    disco.reset()
    blocked = disco.plan(0, tangent(sent=sent))
    assert np.all(blocked.wheel_speeds[0] <= 1.0 + 1e-5)


def test_shifting_by_fractions_continues_the_plan():
    disco = sampling_planner(gain_by_time=True)
    first = disco.plan(0, TANGENT)
    second = disco.plan(20_000_000, tangent(t_ns=20_000_000))
    later, before = (np.array([plan.at(t * PERIOD_NS) for t in range(1, 40)]) for plan in (second, first))
    assert np.abs(later - before).max() < 0.5
    again = disco.plan(20_000_000, tangent(t_ns=20_000_000))
    np.testing.assert_allclose(again.wheel_speeds, second.wheel_speeds, atol=1e-6)


@pytest.mark.parametrize(("refine", "steps"), [(True, 20), (False, 40)])
def test_the_predicted_path_starts_at_the_state_and_follows_the_mean_model(refine, steps):
    plan = planner(refine=refine).plan(0, tangent(left_speed_rad_s=3.0, right_speed_rad_s=3.0))
    assert plan.trajectory.shape == (steps + 1, 3)
    np.testing.assert_allclose(plan.trajectory[0], [0.75, 0.0, math.pi / 2])
    left, right = plan.wheel_speeds[0]
    turned = plan.trajectory[1, 2] - plan.trajectory[0, 2]
    assert turned == pytest.approx(0.061 * (right - left) / 0.415 * 0.1, rel=1e-6)


def test_a_state_from_before_is_predicted_to_the_plans_start():
    sent = (SentCommand(0, 4.0, 4.0),)
    rolling = PlannerState(0, 0.0, 0.0, 0.0, 4.0, 4.0, sent=sent)
    plan = planner().plan(70_000_000, rolling)
    assert plan.t0_ns == 70_000_000
    np.testing.assert_allclose(plan.trajectory[0], [0.061 * 4.0 * 0.07, 0.0, 0.0], atol=1e-9)


@pytest.mark.thorough
def test_commands_on_their_way_are_in_the_prediction():
    delayed = replace(MODEL, belief=None, effects=(EffectSetting("command_delay", {"delay_s": 0.25}),))
    sent = (SentCommand(-1_000_000_000, 0.0, 0.0), SentCommand(-100_000_000, 5.0, 5.0))
    plan = planner(delayed).plan(0, PlannerState(0, 0.0, 0.0, 0.0, 0.0, 0.0, sent=sent))
    x = plan.trajectory[:, 0]
    np.testing.assert_allclose(np.diff(x)[:2], [0.0, 0.061 * 5.0 * 0.05], atol=1e-9)


@pytest.mark.long
def test_delay_and_lag_in_the_model_help_a_plant_that_has_them():
    effects = (EffectSetting("motor_lag", {"tau_s": 0.1}), EffectSetting("command_delay", {"delay_s": 0.3}))
    knowing, ignorant = planner(replace(MODEL, effects=effects)), planner()
    costs = [drive(disco, 20.0, late_steps=3)[0][100:].mean() for disco in (knowing, ignorant)]
    assert costs[0] < 0.04
    assert costs[0] < costs[1]


RISK_AVERSE = [{"sampler": Sampler(risk=risk)} for risk in ("cvar", "worst")]
UNCERTAIN = [pytest.param({"uncertainty": form}, marks=pytest.mark.thorough) for form in ("joint", "point", "mc")]


@pytest.mark.parametrize("changes", [*RISK_AVERSE, *UNCERTAIN], ids=["cvar", "worst", "joint", "point", "mc"])
def test_every_risk_and_every_form_of_uncertainty_drives(changes):
    costs, _ = drive(planner(**changes), 15.0)
    assert costs[75:].mean() < 0.06


@pytest.mark.thorough
def test_own_draws_repeat_bit_for_bit():
    one, other = (planner(uncertainty="mc", common_draws=False, draws=3) for _ in range(2))
    np.testing.assert_array_equal(one.plan(0, TANGENT).wheel_speeds, other.plan(0, TANGENT).wheel_speeds)


@pytest.mark.long
def test_paper_mode_stands_still_and_chatters_as_the_published_code_does():
    costs, changes = [], []
    for seed in range(1, 5):
        disco = Disco(MODEL, CircleCost().paper(), DiscoSettings.paper(), CommandLimits(2.0 * math.pi), seed)
        costs_of_drive, commands = drive(disco, 20.0, wheel_noise=0.05)
        costs.append(costs_of_drive[100:].mean())
        changes.append(np.abs(np.diff(commands, axis=0)).mean() / (2.0 * math.pi))
    assert np.mean(costs) == pytest.approx(0.203, abs=0.02)
    assert np.mean(changes) == pytest.approx(0.62, abs=0.05)


def test_what_was_sampled_can_be_looked_at():
    disco = sampling_planner()
    plan = disco.plan(0, TANGENT)
    rollouts = disco.sampled_rollouts(30)
    assert rollouts.wheel_speeds.shape == (30, 40, 2)
    assert rollouts.trajectories.shape == (30, 41, 3)
    assert np.all(np.diff(rollouts.weights) <= 0.0)
    assert 0.5 < rollouts.weights.sum() <= 1.0 + 1e-6
    every = disco.sampled_rollouts(400)
    np.testing.assert_allclose(every.weights.sum(), 1.0, rtol=1e-5)
    np.testing.assert_allclose(np.einsum("n,ntc->tc", every.weights, every.wheel_speeds), plan.wheel_speeds, atol=1e-3)
    points = disco.point_trajectories()
    assert points.shape == (7, 41, 3)
    np.testing.assert_allclose(points[0], plan.trajectory, atol=1e-9)
    assert np.abs(points[1] - points[0])[-1].max() > 0.01


def test_a_collapse_is_tried_again_and_told():
    disco = planner(sampler=Sampler(temperature=1e-4), retries=2)
    found = disco.plan(0, TANGENT).diagnostics
    assert found.ess < 3.0
    assert (found.collapsed, found.retries, found.outcome) == (True, 2, PlanOutcome.RETRIED)


def test_a_healthy_step_is_neither_retried_nor_collapsed():
    found = planner().plan(0, TANGENT).diagnostics
    assert (found.collapsed, found.retries, found.outcome) == (False, 0, PlanOutcome.PLANNED)
    assert found.ess == pytest.approx(20.0, rel=0.02)
    assert found.valid_samples == 400
    assert found.cost_min <= found.cost_mean


@pytest.mark.parametrize("broken", [{"x_m": math.nan}, {"yaw_rad": math.inf}, {"x_m": math.inf}])
def test_without_a_valid_control_it_ramps_to_zero_then_says_so_then_recovers(broken):
    disco = planner(limits=CommandLimits(8.0, 10.0))
    sent = (SentCommand(-PERIOD_NS, 3.0, -2.0),)
    good = tangent(left_speed_rad_s=3.0, right_speed_rad_s=-2.0, sent=sent)
    disco.plan(0, good)
    bad = msgspec.structs.replace(good, **broken)
    for t in (1, 3, 5):
        plan = disco.plan(t * PERIOD_NS, bad)
        assert plan.diagnostics.outcome is PlanOutcome.STOPPING
        # Nothing of the last step that had samples is told of one that has none.
        assert (plan.diagnostics.ess, plan.diagnostics.valid_samples, plan.diagnostics.collapsed) == (0.0, 0, True)
        assert math.isnan(plan.diagnostics.cost_min)
        assert math.isnan(plan.diagnostics.cost_mean)
        assert np.isfinite(plan.wheel_speeds).all()
        assert np.abs(plan.wheel_speeds).max() <= 3.0
        assert not plan.wheel_speeds[4:].any()
    with pytest.raises(NoValidControl, match=r"no command sequence had a finite cost for 0\.5 s"):
        disco.plan(7 * PERIOD_NS, bad)
    assert disco.plan(8 * PERIOD_NS, good).diagnostics.outcome is not PlanOutcome.STOPPING


def test_a_broken_plan_is_planned_anew():
    disco = planner()
    disco.plan(0, TANGENT)
    disco.optimiser.work.nominal[:] = np.nan
    plan = disco.plan(PERIOD_NS, TANGENT)
    assert plan.diagnostics.outcome is PlanOutcome.RESTARTED
    assert np.isfinite(plan.wheel_speeds).all()


@pytest.mark.long
def test_effects_under_the_belief_become_sigma_points():
    names = (*MODEL.belief.names, "motor_lag.tau_s")
    covariance = np.zeros((4, 4))
    covariance[:3, :3] = MODEL.belief.covariance()
    covariance[3, 3] = 0.02**2
    belief = Gaussian(names, np.append(MODEL.belief.mean(), 0.15), covariance)
    model = replace(MODEL, effects=(EffectSetting("motor_lag", {"tau_s": 0.15}),), belief=belief)
    disco = planner(model)
    disco.plan(0, TANGENT)
    assert disco.point_trajectories().shape[0] == 9


def test_looking_changes_no_plan():
    watched, alone = planner(seed=4), planner(seed=4)
    for t in range(4):
        one, other = watched.plan(t * PERIOD_NS, TANGENT), alone.plan(t * PERIOD_NS, TANGENT)
        np.testing.assert_array_equal(one.wheel_speeds, other.wheel_speeds)
        watched.sampled_rollouts(20)
        watched.point_trajectories()


def test_there_is_nothing_to_look_at_without_a_plan():
    disco = planner()
    assert len(disco.sampled_rollouts().weights) == 0
    disco.plan(0, TANGENT)
    assert len(disco.sampled_rollouts(7).weights) == 7
    assert disco.plan(PERIOD_NS, tangent(x_m=math.nan)).diagnostics.outcome is PlanOutcome.STOPPING
    assert len(disco.sampled_rollouts().weights) == 0


LEARNT = Gaussian(MODEL.belief.names, MODEL.belief.mean() * [1.05, 0.97, 1.02], 0.25 * MODEL.belief.covariance())


@thinned("uncertainty", ["ut", "mc", "joint"], quick=1)
def test_a_belief_set_is_as_good_as_a_belief_begun_with(uncertainty):
    begun = planner(replace(MODEL, belief=LEARNT), uncertainty=uncertainty)
    swapped = planner(uncertainty=uncertainty)
    swapped.set_belief(LEARNT)
    one, other = begun.plan(0, TANGENT), swapped.plan(0, TANGENT)
    np.testing.assert_array_equal(one.wheel_speeds, other.wheel_speeds)
    np.testing.assert_array_equal(one.trajectory, other.trajectory)
    assert not np.array_equal(planner(uncertainty=uncertainty).plan(0, TANGENT).wheel_speeds, one.wheel_speeds)


def test_a_belief_set_between_plans_keeps_the_plan_compiles_nothing_and_repeats():
    runs = []
    for _ in range(2):
        disco = sampling_planner()
        plans = [disco.plan(0, TANGENT)]
        compiled = len(disco_step.signatures)
        disco.set_belief(LEARNT)
        plans.append(disco.plan(20_000_000, tangent(t_ns=20_000_000)))
        assert len(disco_step.signatures) == compiled
        assert plans[1].diagnostics.outcome is PlanOutcome.PLANNED
        assert np.abs(plans[1].wheel_speeds - plans[0].wheel_speeds).max() < 1.0
        runs.append(plans[1].wheel_speeds)
    np.testing.assert_array_equal(*runs)


def test_a_belief_may_name_its_parameters_in_another_order():
    turned = Gaussian(LEARNT.names[::-1], LEARNT.mean()[::-1], LEARNT.covariance()[::-1, ::-1])
    plans = []
    for belief in (LEARNT, turned):
        disco = planner(sampler=Sampler(temperature=1.0))
        disco.set_belief(belief)
        plans.append(disco.plan(0, TANGENT))
    np.testing.assert_allclose(plans[0].trajectory, plans[1].trajectory, atol=0.02)


def test_beliefs_that_the_planner_was_not_laid_out_for_are_refused_and_the_old_one_kept():
    disco, same = planner(), planner()
    faults = {
        "laid out for": Gaussian(("wheel_radius_m",), np.array([0.06]), np.array([[1e-5]])),
        "turn the robot": Gaussian(LEARNT.names, np.array([0.2, 0.12, 0.2]), LEARNT.covariance()),
    }
    for said, belief in faults.items():
        with pytest.raises(ValueError, match=said):
            disco.set_belief(belief)
    np.testing.assert_array_equal(disco.plan(0, TANGENT).wheel_speeds, same.plan(0, TANGENT).wheel_speeds)
    names = ("wheel_radius_m", "command_delay.delay_s")
    delay = EffectSetting("command_delay", {"delay_s": 0.1})
    late = replace(MODEL, effects=(delay,), belief=Gaussian(names, np.array([0.06, 0.1]), np.diag([1e-5, 1e-4])))
    disco = planner(late)
    disco.set_belief(Gaussian(names, np.array([0.06, 0.2]), np.diag([1e-5, 1e-4])))
    with pytest.raises(ValueError, match="longer than the"):
        disco.set_belief(Gaussian(names, np.array([0.06, 0.9]), np.diag([1e-5, 1e-4])))
    with pytest.raises(ValueError, match="laid out for one over None"):
        planner(replace(MODEL, belief=None)).set_belief(LEARNT)
