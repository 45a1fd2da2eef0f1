"""The channels' free runs against the model's own free run from commands."""

import numpy as np
import pytest

from disco_hw.gap.data.free_runs import run_body, run_wheels
from disco_hw.gap.data.gridded_drive import CELL_S
from disco_hw.gap.data.layout import BODY, WHEEL
from disco_hw.model import EffectSetting, Model
from disco_hw.model.free_run import FreeRun

N = 800
EFFECTS = (
    EffectSetting("motor_lag", {"tau_s": 0.1}),
    EffectSetting("deadband", {"width_rad_s": 0.3}),
    EffectSetting("speed_limit", {"limit_rad_s": 5.0}),
    EffectSetting("command_delay", {"delay_s": 0.05}),
    EffectSetting("turn_slip", {"k_s": 0.1}),
    EffectSetting("side_slip", {"k_s": 0.1}),
    EffectSetting("wheel_radius_asymmetry", {"ratio": 0.02}),
    EffectSetting("lateral_icr", {"offset_m": 0.03}),
)


@pytest.mark.parametrize("effect", [*EFFECTS, None])
def test_two_channels_in_a_row_are_the_model(effect):
    model = Model(0.06, 0.4, 0.1, (effect,) if effect else ())
    t = np.arange(N) * CELL_S
    commands = np.column_stack([4 * np.sin(0.8 * t), 6 * np.sin(0.5 * t) + 1])
    p = {"wheels": WHEEL.neutral.copy(), "body": BODY.neutral.copy()}
    for name, value in zip(model.parameter_names, model.point(), strict=True):
        for layout, key in ((WHEEL, "wheels"), (BODY, "body")):
            if name in layout.place:
                p[key][layout.place[name]] = value
    first = t == 0.0
    angle = run_wheels(p["wheels"], model.point()[:3], commands, np.zeros((N, 2)), first, t, np.zeros((N, 2)))
    speed = np.gradient(angle, CELL_S, axis=0)
    track = run_body(p["body"], angle, speed, np.zeros((N, 3)), first, t)
    run = FreeRun(model, model.point()[None, :], CELL_S)
    history = np.repeat(commands[:1], run.past_rows, axis=0)
    states = run.states(np.zeros(5), np.concatenate([history, commands[:-1]]), run.past_rows)
    np.testing.assert_allclose(track, states[:, :3], atol=2e-3)


def test_a_command_that_is_not_known_stops_the_prediction():
    commands = np.full((100, 2), 2.0)
    commands[40:60] = np.nan
    first = np.arange(100) == 0
    angle = run_wheels(
        WHEEL.neutral, np.array([0.06, 0.4, 0.0]), commands, np.zeros((100, 2)), first, np.arange(100) * CELL_S,
        np.zeros((100, 2)),
    )  # fmt: skip
    assert np.all(np.isfinite(angle))
    assert angle[60, 0] == angle[41, 0]
    assert angle[99, 0] > angle[60, 0] + 0.5


def test_however_fast_it_turns_the_path_is_that_of_every_cells_mean_heading():
    rng = np.random.default_rng(3)
    count = 4000
    # From slow turns to 300 rad/s, far beyond what short series are for.
    speed = rng.uniform(-1.0, 1.0, (count, 2)) * rng.choice([1.0, 30.0, 1000.0], (count, 1))
    angle = np.cumsum(speed, axis=0) * CELL_S
    first = np.isin(np.arange(count), (0, 2500))
    p = BODY.neutral.copy()
    p[:3] = radius, axial, x_icr = 0.06, 0.4, 0.1
    track = run_body(p, angle, speed, np.zeros((count, 3)), first, np.arange(count) * CELL_S)
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
