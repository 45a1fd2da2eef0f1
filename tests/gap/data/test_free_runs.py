"""The channels' free runs against the model's own free run from commands."""

import numpy as np
import pytest

from disco_hw.gap.data import BODY, WHEEL
from disco_hw.gap.data.free_runs import pose_residual, run_body, run_wheels
from disco_hw.gap.settings import GRID_STEP_S
from disco_hw.model import Model
from disco_hw.model.step import FreeRun
from tests.gap.synthetic import vector_of
from tests.tables import thinned
from tools.every_effect import model_with_every_effect

N = 800
BASE = (0.06, 0.4, 0.1)
OF_WHEELS = {
    "motor_lag": {"tau_s": 0.1},
    "deadband": {"width_rad_s": 0.3},
    "speed_limit": {"limit_rad_s": 5.0},
    "command_delay": {"delay_s": 0.05},
}
OF_BODY = {
    "turn_slip": {"k_s": 0.1},
    "side_slip": {"k_s": 0.1},
    "wheel_radius_asymmetry": {"ratio": 0.02},
    "lateral_icr": {"offset_m": 0.03},
}


@thinned("effects", [OF_WHEELS, OF_BODY, {}], ids=["wheels", "body", "none"], quick=1)
def test_two_channels_in_a_row_are_the_model(effects):
    model = model_with_every_effect(effects, BASE) if effects else Model(*BASE)
    t = np.arange(N) * GRID_STEP_S
    commands = np.column_stack([4 * np.sin(0.8 * t), 6 * np.sin(0.5 * t) + 1])
    p = {"wheels": WHEEL.neutral.copy(), "body": BODY.neutral.copy()}
    for name, value in zip(model.parameter_names, model.point(), strict=True):
        # What does nothing is left out here, as a search leaves it out: that is compiled already.
        if "." in name and name.partition(".")[0] not in effects:
            continue
        for layout, key in ((WHEEL, "wheels"), (BODY, "body")):
            if name in layout.place:
                p[key][layout.place[name]] = value
    first = t == 0.0
    angle = run_wheels(p["wheels"], model.point()[:3], commands, np.zeros((N, 2)), first, t, np.zeros((N, 2)))
    speed = np.gradient(angle, GRID_STEP_S, axis=0)
    track = run_body(p["body"], angle, speed, np.zeros((N, 3)), first, t)
    run = FreeRun(model, model.point()[None, :], GRID_STEP_S)
    history = np.repeat(commands[:1], run.past_rows, axis=0)
    states = run.states(np.zeros(5), np.concatenate([history, commands[:-1]]), run.past_rows)
    np.testing.assert_allclose(track, states[:, :3], atol=2e-3)


def turned(commands, first=None, moved_s=0.0, measured_rad_s=None, **effects):
    """Angles (M, 2) of wheels that answer commands by these first parameters of effects."""
    count, still = len(commands), np.zeros(commands.shape)
    return run_wheels(
        vector_of(WHEEL, **effects), np.array(BASE), commands, still, np.arange(count) == 0 if first is None else first,
        np.arange(count) * GRID_STEP_S, still if measured_rad_s is None else measured_rad_s, moved_s,
    )  # fmt: skip


def test_a_command_that_is_not_known_stops_the_prediction():
    commands = np.full((100, 2), 2.0)
    commands[40:60] = np.nan
    angle = turned(commands)
    assert np.all(np.isfinite(angle))
    assert angle[60, 0] == angle[41, 0]
    assert angle[99, 0] > angle[60, 0] + 0.5


@pytest.mark.parametrize("late_s", [-0.4, -0.03, 0.03, 0.4])
def test_commands_that_are_moved_do_not_look_into_another_run(late_s):
    # Two runs, the first at 2 rad/s, the second at -3: whichever way they are moved, each keeps its own commands.
    first = np.isin(np.arange(100), (0, 50))
    commands = np.repeat([[2.0, 2.0], [-3.0, -3.0]], 50, axis=0)
    angle = turned(commands, first, measured_rad_s=commands, command_delay=late_s)
    along = np.arange(50) * GRID_STEP_S
    np.testing.assert_allclose(angle[:, 0], np.concatenate([2.0 * along, -3.0 * along]), atol=1e-9)


def test_however_fast_it_turns_the_path_is_that_of_every_cells_mean_heading():
    rng = np.random.default_rng(3)
    count = 4000
    # From slow turns to 300 rad/s, far beyond what short series are for.
    speed = rng.uniform(-1.0, 1.0, (count, 2)) * rng.choice([1.0, 30.0, 1000.0], (count, 1))
    angle = np.cumsum(speed, axis=0) * GRID_STEP_S
    first = np.isin(np.arange(count), (0, 2500))
    p = BODY.neutral.copy()
    p[:3] = radius, axial, x_icr = 0.06, 0.4, 0.1
    track = run_body(p, angle, speed, np.zeros((count, 3)), first, np.arange(count) * GRID_STEP_S)
    step = np.where(first[:, None], 0.0, np.diff(angle, axis=0, prepend=0.0)) * radius
    along, turn = step.mean(axis=1), (step[:, 1] - step[:, 0]) / axial
    assert np.abs(turn).max() > 2.0
    for begin, end in ((0, 2500), (2500, count)):
        part = slice(begin, end)
        yaw = np.cumsum(turn[part])
        middle = yaw - 0.5 * turn[part]
        across = -x_icr * turn[part]
        x = np.cumsum(np.cos(middle) * along[part] - np.sin(middle) * across)
        y = np.cumsum(np.sin(middle) * along[part] + np.cos(middle) * across)
        np.testing.assert_allclose(track[part], np.column_stack([x, y, yaw]), atol=1e-9)


@pytest.mark.parametrize("late_s", [0.2, -0.2, 0.035])
def test_poses_that_are_older_than_their_stamps_have_a_latency_above_zero(late_s):
    t_s = np.arange(3000) * GRID_STEP_S
    yaw = 0.6 * np.sin(0.7 * t_s)
    track = np.column_stack(
        [np.cumsum(np.cos(yaw)) * 0.4 * GRID_STEP_S, np.cumsum(np.sin(yaw)) * 0.4 * GRID_STEP_S, yaw]
    )
    moving_s = np.minimum(t_s, 15.0) + 0.5 * np.maximum(t_s - 15.0, 0.0)
    node = np.arange(100, 2900, 4)
    drift = (0.05, -0.03)
    then = t_s[node] - late_s
    # What the sensor reports at a stamp is where the robot was that long before.
    measured = np.column_stack([np.interp(then, t_s, track[:, axis]) for axis in range(3)])
    ground = moving_s[:, None] * drift
    measured[:, :2] += np.interp(then, t_s, moving_s)[:, None] * drift

    def residual(latency_s, laid=node, moved_s=0.0):
        return pose_residual(
            vector_of(pose_latency=latency_s), track, ground, laid, np.zeros(node.size), np.arange(node.size) // 100,
            np.zeros(node.size, dtype=np.int64), np.full(node.size, 2999), np.ones(node.size, dtype=bool), measured,
            moved_s,
        )  # fmt: skip

    np.testing.assert_allclose(residual(late_s), 0.0, atol=1e-9)
    assert np.abs(residual(0.0)).max() > 0.1 * abs(late_s)
    assert np.linalg.norm(residual(-late_s)) > 1.5 * np.linalg.norm(residual(0.0))
    # The same where they are laid 0.15 s earlier than they are stamped.
    np.testing.assert_allclose(residual(late_s, node - 15, 0.15), 0.0, atol=1e-9)
    assert np.abs(residual(late_s, node - 15)).max() > 0.02


@pytest.mark.parametrize("limit", ["turning_buildup", "yaw_acceleration_limit"])
def test_a_limit_that_nothing_comes_near_runs_as_one_that_is_not_there(limit):
    t_s = np.arange(N) * GRID_STEP_S
    commands = np.column_stack([4 * np.sin(0.8 * t_s), 6 * np.sign(np.sin(0.5 * t_s)) + 1])
    absent, far, near = (turned(commands, motor_lag=0.1, **limits) for limits in ({}, {limit: 1e5}, {limit: 1.0}))
    np.testing.assert_allclose(far, absent, atol=1e-7)
    assert np.abs(near - absent).max() > 0.1


@pytest.mark.parametrize("moved_s", [-0.3, 0.12])
def test_commands_that_lie_later_than_they_are_stamped_are_as_much_less_late(moved_s):
    t_s = np.arange(N) * GRID_STEP_S
    commands = np.column_stack([4 * np.sin(0.8 * t_s), 6 * np.sign(np.sin(0.5 * t_s)) + 1])
    laid = np.roll(commands, round(moved_s / GRID_STEP_S), axis=0)
    stamped, moved = turned(commands, command_delay=0.2), turned(laid, moved_s=moved_s, command_delay=0.2)
    inside = slice(100, -100)
    np.testing.assert_allclose(np.diff(moved, axis=0)[inside], np.diff(stamped, axis=0)[inside], atol=1e-9)
    np.testing.assert_array_equal(moved, turned(laid, command_delay=0.2 - moved_s))
