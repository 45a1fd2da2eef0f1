"""What the richest model of a channel is made of, and how much of it is taken."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from disco_hw.gap.data import BODY, WHEEL
from disco_hw.gap.noise.channels import BodyChannel
from disco_hw.gap.noise.wheel_noise import WheelNoise
from disco_hw.gap.search import richest_model
from disco_hw.gap.search.richest_model import (
    CANDIDATES,
    candidates_of,
    delays_of,
    driven,
    indices,
    learn_saturated_body,
    learn_saturated_wheels,
    parameters_of,
    smooth_of,
    with_delay,
)
from disco_hw.gap.settings import DEFAULT_SETTINGS, GRID_STEP_S, FitSettings
from tests.gap.synthetic import GEOMETRY, NOISE, body_channel, line_of, moved_by, vector_of, wheels_on


def test_a_ridge_takes_most_away_and_holds_columns_that_look_alike_small():
    rng = np.random.default_rng(0)
    slope = rng.standard_normal((200, 4)) * (1.0, 10.0, 0.1, 1.0)
    slope[:, 3] = slope[:, 0] + 1e-9 * rng.standard_normal(200)
    residual = rng.standard_normal(200) - slope @ (2.0, -0.3, 5.0, 0.0)
    # As so many further equations, on columns of unit length.
    lengths = np.linalg.norm(slope, axis=0)
    stacked = np.vstack([slope, np.diag(0.01**0.5 * lengths)])
    expected = np.linalg.lstsq(stacked, np.append(-residual, np.zeros(4)), rcond=None)[0]
    found = richest_model._ridge(slope, residual, FitSettings())
    assert found == pytest.approx(expected, rel=1e-6)
    assert found[0] == pytest.approx(found[3], rel=1e-3)


def test_speeds_add_up_to_angles_in_each_run_from_nothing():
    speed = np.array([[1.0, 2.0], [3.0, 0.0], [-1.0, 1.0], [5.0, 5.0], [7.0, 0.0]])
    first = np.array([True, False, False, True, False])
    angle = richest_model._integrated(speed, first)
    expected = -0.01 * np.array([[0.0, 0.0], [3.0, 0.0], [2.0, 1.0], [0.0, 0.0], [7.0, 0.0]])
    np.testing.assert_allclose(angle, expected, atol=1e-15)


def test_a_lag_takes_its_time_and_a_limit_its_steps():
    step = np.ones((200, 1))
    step[0] = 0.0
    t_s = GRID_STEP_S * np.arange(200)[:, None]
    np.testing.assert_allclose(richest_model._slow(step, 0.3), 1.0 - np.exp(-t_s / 0.3), atol=1e-12)
    asked = np.array([[0.0, 1.0], [5.0, 1.0], [5.0, -9.0], [5.0, 1.0], [-5.0, 0.95]])
    expected = [[0.0, 1.0], [0.2, 1.0], [0.4, 0.8], [0.6, 1.0], [0.4, 0.95]]
    np.testing.assert_allclose(richest_model._slewed(asked, 20.0), expected, atol=1e-12)


def shapes_of(command_rad_s, **effects):
    line = replace(line_of(np.repeat([[3.0, 5.0]], command_rad_s.shape[0], axis=0)), command_rad_s=command_rad_s)
    channel = wheels_on(line)
    return line, [*richest_model._wheel_shapes(channel, vector_of(WHEEL, **effects))]


def lagged(u, response_s):
    keep = np.exp(-GRID_STEP_S / response_s)
    out = np.zeros_like(u)
    for k in range(u.shape[0]):
        out[k] = (out[k - 1] if k else 0.0) * keep + (1.0 - keep) * u[k]
    return out


def test_wheels_may_bend_a_command_and_answer_it_quickly_slowly_and_no_faster_than_they_can():
    commands = np.repeat(np.random.default_rng(1).uniform(-6.0, 6.0, (10, 2)), 40, axis=0)
    line, shapes = shapes_of(commands, command_delay__delay_s=0.1, motor_lag__tau_s=0.2)
    asked = np.vstack([np.repeat(commands[:1], 10, axis=0), commands[:-10]])
    u = lagged(asked, 0.2)
    other, most = u[:, ::-1], np.abs(u).max()
    expected = [
        np.sign(u) * np.maximum(np.abs(u) - share * most, 0.0)
        for share in (0.02, 0.05, 0.1, 0.2, 0.35, 0.55, 0.75, 0.9)
    ]
    expected += [np.tanh(u / 0.05), u, np.abs(u), u**2, other, np.abs(other) * np.tanh(u / 0.05), np.abs(other) * u]
    expected += [u * np.sin(line.angle_rad), u * np.cos(line.angle_rad)]
    for response_s in (0.02, 0.05, 0.12, 0.3):
        behind = lagged(u, response_s) - u
        expected += [behind, behind[:, ::-1], lagged(behind, response_s)]
    for full_s in (0.1, 0.2, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0):
        now, followed = asked[0].copy(), []
        for one in asked:
            now = now + np.clip(one - now, -most / full_s * GRID_STEP_S, most / full_s * GRID_STEP_S)
            followed.append(now)
        expected.append(np.array(followed) - asked)
    assert len(shapes) == len(expected)
    for shape, right in zip(shapes, expected, strict=True):
        np.testing.assert_allclose(shape, right, atol=1e-9)


def test_wheels_without_a_lag_answer_at_once_and_without_a_command_not_at_all():
    commands = np.repeat(np.random.default_rng(1).uniform(-6.0, 6.0, (5, 2)), 20, axis=0)
    _, shapes = shapes_of(commands)
    np.testing.assert_allclose(shapes[9], commands, rtol=1e-3)
    # However small it is.
    np.testing.assert_allclose(shapes_of(0.01 * commands)[1][9], 0.01 * commands, rtol=1e-3)
    line, none = shapes_of(np.zeros((400, 2)))
    assert none == []
    channel = wheels_on(line, WheelNoise(reading_rad=1e-3))
    learnt, left, many = learn_saturated_wheels(channel, WHEEL.neutral)
    np.testing.assert_array_equal(left, channel.raw_residual(WHEEL.neutral))
    assert many == WHEEL.neutral.size
    assert learnt.noise != channel.noise


class Read:
    """Wheels that were read with errors, under a noise whose gains are `gains` times what is left."""

    drive = SimpleNamespace(
        first=np.arange(40) % 20 == 0,
        # At every second node, the last from the one before: a reading lies between two nodes.
        encoder=SimpleNamespace(node=np.append(np.arange(1, 39, 2), 38), fraction=np.append(np.zeros(19), 1.0)),
    )
    settings = DEFAULT_SETTINGS
    weight = np.linspace(0.5, 2.0, 40).reshape(20, 2)

    def __init__(self, name, gains, raw=None):
        self.name, self.gains, self.raw = name, gains, raw
        self.noise = SimpleNamespace(reading_rad=0.25, vector=lambda: name)

    def raw_residual(self, vector):
        return self.raw

    def with_noise(self, noise):
        assert noise == WheelNoise(reading_rad=0.25)
        return Read("usual", self.gains**2)


@pytest.mark.parametrize(
    ("misfits", "best"), [((4.0, 3.0, 5.0, 6.0), 1), ((4.0, 5.0, 3.0, 3.5), 2), ((4.0, 5.0, 3.0, 3.0), 3)]
)
def test_wheels_are_fitted_anew_with_each_noise_that_is_learnt_and_the_likeliest_is_kept(monkeypatch, misfits, best):
    rng = np.random.default_rng(5)
    shapes, raw = rng.standard_normal((3, 40, 2)), rng.standard_normal((20, 2))
    gains = rng.uniform(0.5, 2.0, (6, 20, 2))
    columns = np.array(
        [
            -GRID_STEP_S * np.concatenate([np.cumsum(s[:20], axis=0) - s[0], np.cumsum(s[20:], axis=0) - s[20]])
            for s in shapes
        ]
    )[:, 1::2]
    asked, taken = [], iter(misfits)

    def learn(channel, left):
        asked.append((channel.name, left))
        return Read(len(asked), gains[len(asked)])

    channel = Read("own", gains[0], raw)
    monkeypatch.setattr(richest_model, "_wheel_shapes", lambda *_: iter(shapes))
    monkeypatch.setattr(richest_model, "learn_wheel_noise", learn)
    monkeypatch.setattr(richest_model, "whiten_wheels", lambda residual, of: of * residual)
    monkeypatch.setattr(
        richest_model, "wheel_mismatch", lambda of, left: lambda noise: next(taken) if of is channel else None
    )
    learnt, left, many = learn_saturated_wheels(channel, None)
    # From its own noise twice, then from the usual one.
    assert [name for name, _ in asked] == ["own", 1, "usual", 3]
    for (_, found), of in zip(asked, (gains[0], gains[1], gains[0] ** 2, gains[3]), strict=True):
        slope = (columns * (of * Read.weight)).reshape(3, -1).T
        size = np.linalg.norm(slope, axis=0)
        target = np.append(-(raw * of * Read.weight).ravel(), np.zeros(3))
        stacked = np.vstack([slope, np.diag(DEFAULT_SETTINGS.fit.ridge**0.5 * size)])
        expected = raw + np.tensordot(np.linalg.lstsq(stacked, target, rcond=None)[0], columns, axes=1)
        np.testing.assert_allclose(found, expected, atol=1e-9)
    assert learnt.name == best + 1
    assert left is asked[best][1]
    assert many == 3 + WHEEL.neutral.size


def test_a_body_is_pushed_as_it_is_fitted_best_and_where_that_is_too_far_half_of_it():
    channel, line = body_channel()
    p = channel.neutral
    push = np.zeros((line.t_s.size, 3))
    push[2000:4000, 0] = 0.5
    pushed = moved_by(channel, 0.1 * push)
    learnt, vector, extra, many = learn_saturated_body(pushed, (), p, iter((np.zeros_like(push), push)))
    assert many == 4
    np.testing.assert_allclose(extra, 0.1 * push, atol=0.01 * 0.5)
    assert vector[:3] == pytest.approx(GEOMETRY, abs=2e-3)
    assert learnt.noise.position_m == pytest.approx(NOISE.position_m, rel=0.1)
    half = np.sum(pushed.residual(vector, extra) ** 2)
    assert half < 1.1 * np.sum(channel.residual(p) ** 2)


def test_a_push_is_tried_in_a_size_that_hardly_matters(monkeypatch):
    push = 7.0 * np.random.default_rng(3).standard_normal((50, 3))
    asked = []

    def residual(vector, extra=None):
        asked.append(extra)
        return np.ones(4) if extra is None else np.ones(4) + (push * extra).mean()

    channel = SimpleNamespace(
        layout=BODY, settings=DEFAULT_SETTINGS, free=(), drive=SimpleNamespace(t_s=np.zeros(50)), residual=residual
    )
    monkeypatch.setattr(richest_model, "learn_body_noise", lambda of, vector, extra: of)
    extra = learn_saturated_body(channel, (), BODY.neutral, (push,))[2]
    tried = asked[1]
    assert np.sqrt((tried**2).mean()) == pytest.approx(1e-3)
    np.testing.assert_allclose(tried / push, tried[0, 0] / push[0, 0])
    # As much of it as takes what is left away, but for the ridge.
    share = -1.0 / (1.0 + DEFAULT_SETTINGS.fit.ridge) / (push**2).mean()
    np.testing.assert_allclose(extra, share * push, rtol=1e-6)


class Bent:
    """A channel of one number whose derivative promises ten, where only what is below `least` fits better than none."""

    layout, settings, free = BODY, DEFAULT_SETTINGS, (0,)
    drive = SimpleNamespace(t_s=np.zeros(5))

    def __init__(self, least, beyond=-2.0):
        self.least, self.beyond = least, beyond

    def residual(self, vector, extra=None):
        moved = vector[0] - GEOMETRY[0]
        if abs(moved) < 1e-3:
            return np.array([moved / 10.0 - 1.0])
        return np.array([0.5 if moved < self.least else self.beyond])


@pytest.fixture
def wide(monkeypatch):
    """Lets entries grow as far as they like, and the noise be learnt with a mark."""
    monkeypatch.setattr(richest_model, "learn_body_noise", lambda of, vector, extra: ("learnt", vector, extra))
    monkeypatch.setattr(Bent, "layout", replace(BODY, high=np.full_like(BODY.high, 1e9)))


@pytest.mark.usefixtures("wide")
@pytest.mark.parametrize(("least", "share"), [(11.0, 1.0), (6.0, 0.5), (3.0, 0.25), (1.5, 0.125), (1.0, 0.0)])
def test_a_step_of_the_richest_model_is_halved_until_it_fits_better(least, share):
    channel = Bent(least)
    learnt, moved, extra, many = learn_saturated_body(channel, (), vector_of(), ())
    full = 10.0 / (1.0 + DEFAULT_SETTINGS.fit.ridge)
    assert moved[0] - GEOMETRY[0] == pytest.approx(share * full, rel=1e-3, abs=1e-12)
    assert (learnt is channel) is (share == 0.0)
    assert extra.shape == (5, 3)
    assert many == 1


@pytest.mark.usefixtures("wide")
def test_a_step_that_fits_as_well_as_none_is_none():
    vector, channel = vector_of(), Bent(0.0, 1.0)
    learnt, moved, _, _ = learn_saturated_body(channel, (), vector, ())
    assert learnt is channel
    assert moved is vector


def test_the_richest_model_stays_in_its_ranges(monkeypatch):
    monkeypatch.setattr(richest_model, "learn_body_noise", lambda of, vector, extra: of)
    assert learn_saturated_body(Bent(100.0), (), vector_of(), ())[1][0] == BODY.high[0]


def test_effects_see_the_commands_that_are_known_the_geometry_and_the_time_of_what_is_measured():
    commands = np.tile([2.0, 3.0], (800, 1))
    commands[100:300] = np.nan
    line = replace(line_of(np.tile([2.0, 3.0], (800, 1))), command_rad_s=commands)
    wheels = driven(wheels_on(line))
    body = driven(BodyChannel.build(line, NOISE, np.array([*GEOMETRY, *BODY.neutral[3:]])))
    for seen in (wheels, body):
        assert seen.commands.shape == (600, 2)
        assert seen.geometry == GEOMETRY[:2]
    assert (wheels.first_s, wheels.last_s) == (0.0, pytest.approx(7.99))
    assert (body.first_s, body.last_s) == (pytest.approx(0.04), pytest.approx(7.96))


def test_a_delay_at_first_sight_is_put_where_the_age_of_poses_is_within_its_range():
    channel, line = body_channel()
    place = BODY.place["pose_latency.latency_s"]
    for seen_s, put_s in ((0.2, 0.2), (-0.1, -0.1), (99.0, BODY.high[place]), (-99.0, BODY.low[place])):
        late = replace(channel, drive=replace(line, pose_delay_s=seen_s))
        vector = with_delay(late, channel.neutral)
        assert vector[place] == put_s
        assert (np.delete(vector, place) == np.delete(channel.neutral, place)).all()
        assert CANDIDATES["pose_latency"].starts(late) == ((put_s,),)


@pytest.mark.parametrize("seen_s", [0.0, -0.25, 0.1])
def test_a_delay_of_commands_begins_from_what_is_seen_at_first_sight(seen_s):
    line = replace(line_of(np.tile([2.0, 3.0], (800, 1))), commands_moved_s=seen_s)
    channel = wheels_on(line)
    place = WHEEL.place["command_delay.delay_s"]
    vector = with_delay(channel, WHEEL.neutral)
    assert vector[place] == seen_s
    assert (np.delete(vector, place) == np.delete(WHEEL.neutral, place)).all()
    begin = CANDIDATES["command_delay"].starts
    unmoved = replace(channel, drive=replace(line, commands_moved_s=0.0))
    assert begin(channel) == tuple((start + seen_s,) for (start,) in begin(unmoved))
    others = [CANDIDATES[name] for name in candidates_of(WHEEL) if name != "command_delay"]
    begun = [(other.starts(channel), other.starts(unmoved)) for other in others if other.starts is not None]
    assert begun
    assert all(one == other for one, other in begun)


def test_effects_compete_in_their_own_channel_with_all_their_parameters():
    channel, _ = body_channel()
    assert "motor_lag" in candidates_of(WHEEL)
    assert "turn_slip" in candidates_of(BODY)
    assert not set(candidates_of(WHEEL)) & set(candidates_of(BODY))
    # A change of the floor has a time that is scanned, and two that are fitted.
    assert parameters_of(("surface_change", "turn_slip")) == 4
    fitted = [BODY.columns[place] for place in indices(channel, ("surface_change", "turn_slip"))]
    assert fitted[:3] == ["wheel_radius_m", "axial_distance_m", "x_icr_m"]
    assert set(fitted[3:]) == {"surface_change.track", "surface_change.radius", "turn_slip.k_s"}
    assert {"turn_slip", "slope"} < set(smooth_of(BODY))
    assert {"motor_lag", "wheel_gain"} < set(smooth_of(WHEEL))
    assert "surface_change" not in smooth_of(BODY)
    assert (delays_of(WHEEL), delays_of(BODY)) == (("command_delay",), ("pose_latency",))
    # What begins at some time of the drive.
    assert [name for name, candidate in CANDIDATES.items() if candidate.is_alternative] == ["surface_change"]
