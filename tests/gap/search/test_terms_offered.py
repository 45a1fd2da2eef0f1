"""The terms that are offered, each against its equation, and a channel with some of them."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from disco_hw.gap.data import BODY
from disco_hw.gap.search.unnamed_terms import (
    Term,
    WithTerms,
    _discs,
    body_terms,
    motion,
    places,
    places_near,
    smoothed,
    wheel_terms,
    with_known_terms,
)
from disco_hw.gap.settings import DEFAULT_SETTINGS, GRID_STEP_S, TermSettings
from disco_hw.model import EffectSetting
from tests.gap.synthetic import GEOMETRY, body_channel, line_of

RADIUS_M, AXLE_M, _ = GEOMETRY
COUNT = 600
T_S = GRID_STEP_S * np.arange(COUNT)


def by_form(terms):
    return {term.form.format(1.0): term for term in terms}


def ramps():
    """Commands that grow by 1 and -2 rad/s in a second, of wheels that turn at 3 and 5 rad/s."""
    line = line_of(np.repeat([[3.0, 5.0]], COUNT, axis=0))
    return replace(line, command_rad_s=np.column_stack([T_S, -2.0 * T_S]))


def test_terms_of_a_command_are_made_of_what_is_in_force_and_of_where_the_wheels_are():
    line = ramps()
    terms = by_form(wheel_terms(SimpleNamespace(drive=line), 0.5))
    u = np.column_stack([np.maximum(T_S - 0.5, 0.0), -2.0 * np.maximum(T_S - 0.5, 0.0)])
    np.testing.assert_allclose(terms["command += 1 u |u|"].perturbation, u * np.abs(u), atol=1e-12)
    np.testing.assert_allclose(terms["command += 1 u_other"].perturbation, u[:, ::-1], atol=1e-12)
    np.testing.assert_allclose(terms["command += 1 t/100 u"].perturbation, 0.01 * T_S[:, None] * u, atol=1e-12)
    assert terms["command += 1 u |u|"].model_name == "command += k u |u|"
    load = terms["command += 1 u mean_1s(|u| + |u_other|)"]
    assert load.model_name == "command += k u mean_1s(|u| + |u_other|)"
    # What grows by 3 rad/s in a second is followed a second later.
    np.testing.assert_allclose(load.perturbation[-1], u[-1] * 3.0 * (5.49 - (1.0 - np.exp(-5.49))), rtol=2e-3)
    later = slice(60, -5)
    # A sign fades in with the command.
    sign = u * np.abs(u) / (u * u + 0.05**2)
    expected = {
        "du/dt": (1.0, -2.0), "|du/dt| sign(u)": sign * (1.0, 2.0), "u |du/dt|": u * (1.0, 2.0),
        "u sin(wheel angle)": u * np.sin(line.angle_rad), "u cos(wheel angle)": u * np.cos(line.angle_rad),
    }  # fmt: skip
    for form, value in expected.items():
        term = terms[f"command += 1 {form}"]
        np.testing.assert_allclose(term.perturbation[later], np.broadcast_to(value, u.shape)[later], rtol=1e-9)
        assert term.model_name is None
    # No command is made with a geometry.
    assert {term.geometry for term in terms.values()} == {(1.0, 1.0)}


def swaying(seconds=6.0):
    """A drive whose wheels sway apart, slowly."""
    t_s = GRID_STEP_S * np.arange(round(seconds / GRID_STEP_S))
    return line_of(np.column_stack([2.0 + t_s + np.sin(t_s), 2.0 + t_s - np.sin(t_s)])), t_s


def test_motion_is_that_of_the_wheels():
    line, t_s = swaying()
    v, w, a = motion(line, np.array(GEOMETRY))
    np.testing.assert_allclose(v, RADIUS_M * (2.0 + t_s), atol=1e-12)
    np.testing.assert_allclose(w, -RADIUS_M / AXLE_M * 2.0 * np.sin(t_s), atol=1e-12)
    np.testing.assert_allclose(a[20:-20], RADIUS_M, rtol=1e-9)


def test_what_changes_from_one_node_to_the_next_is_smoothed_away():
    values = np.where(np.arange(400) % 2 == 0, 1.0, -1.0)
    assert np.abs(smoothed(values, TermSettings())[20:-20]).max() < 0.02
    assert smoothed(np.ones(400), TermSettings())[20:-20] == pytest.approx(1.0)
    single = smoothed(np.eye(1, 101, 50)[0], TermSettings(smooth_nodes=8))
    # Half a wave of a cosine over eight nodes either side.
    share = 0.5 * (1.0 + np.cos(np.pi * np.arange(-8, 9) / 8.0))
    np.testing.assert_allclose(single[42:59], share / share.sum(), atol=1e-12)
    assert (single[:42] == 0.0).all()


def test_terms_of_a_body_are_made_of_its_motion():
    line, t_s = swaying()
    p = np.array(GEOMETRY)
    terms = by_form(body_terms(SimpleNamespace(drive=line), p))
    v, w, a = motion(line, p)
    later = slice(20, -20)
    faster = -RADIUS_M / AXLE_M * 2.0 * np.cos(t_s)
    for axis, target in enumerate(("v_x", "v_y", "omega")):
        cubic = terms[f"{target} += 1 v^3"]
        np.testing.assert_allclose(cubic.perturbation[:, axis], v**3, atol=1e-12)
        assert cubic.model_name == f"{target} += k v^3"
        assert cubic.geometry == (RADIUS_M, AXLE_M)
        for memory in (term for form, term in terms.items() if form.startswith(f"{target} += 1 (")):
            assert (memory.model_name, memory.geometry) == (memory.form.replace("{:.4g}", "k"), (RADIUS_M, AXLE_M))
        # What grows with time along a robot is its own; aside it is a yaw that drifts.
        assert (terms[f"{target} += 1 t/100 v"].model_name is None) is (target == "v_y")
        assert (terms[f"{target} += 1 t/100 omega"].model_name is None) is (target == "v_y")
        expected = {"|v| a": v * a, "t/100 omega": 0.01 * t_s * w, "domega/dt": faster, "v domega/dt": v * faster}
        for form, value in expected.items():
            term = terms[f"{target} += 1 {form}"]
            np.testing.assert_allclose(term.perturbation[later, axis], value[later], atol=2e-4)
            assert (np.delete(term.perturbation, axis, axis=1) == 0.0).all()


def test_a_robot_moves_where_a_wheel_turns():
    line = line_of(np.repeat([[0.0, 0.0], [0.0, -0.5], [0.25, 0.0], [3.0, 3.0]], 20, axis=0))
    moving = by_form(body_terms(SimpleNamespace(drive=line), np.array(GEOMETRY)))["v_x += 1 moving"]
    # At 0.05 m/s of a rim it moves for good.
    expected = np.repeat([0.0, 0.03 / 0.05, 0.015 / 0.05, 1.0], 20)
    np.testing.assert_allclose(moving.perturbation[:, 0], expected, atol=1e-12)
    assert moving.model_name is None


def test_ground_that_varies_slowly_is_one_form_with_a_cosine_for_each_wave():
    line, t_s = swaying()
    line, p = replace(line, t_s=t_s + 7.0), np.array(GEOMETRY)
    v, w, _ = motion(line, p)
    terms = {term.form: term for term in body_terms(SimpleNamespace(drive=line), p)}
    for axis, form, speed in ((0, "v_x += {:.2g} v", v), (2, "omega += {:.2g} omega", w)):
        term = terms[f"{form} times what varies slowly with time"]
        # From half a period over the whole log on.
        waves = [speed * np.cos(np.pi * k * t_s / t_s[-1]) for k in range(1, 9)]
        np.testing.assert_allclose([feature[:, axis] for feature in term.features], waves, atol=1e-9)
        assert not any(np.delete(feature, axis, axis=1).any() for feature in term.features)
        assert term.model_name is None
        assert term.usual == 0.1


@pytest.mark.parametrize(("wave", "turn"), [("sin", np.sin), ("cos", np.cos)])
def test_a_wheel_that_is_not_round_moves_its_rim_and_turns_the_robot_over_the_axle(wave, turn):
    line, _ = swaying()
    term = by_form(body_terms(SimpleNamespace(drive=line), np.array(GEOMETRY)))[
        f"rim speed += 1 {wave}(wheel angle) of itself"
    ]
    rims = 0.5 * RADIUS_M * line.speed_rad_s * turn(line.angle_rad)
    np.testing.assert_allclose(term.perturbation[:, 0], rims.sum(axis=1), atol=1e-12)
    assert (term.perturbation[:, 1] == 0.0).all()
    # Half of each rim moves the middle: the difference of the whole rims turns it.
    np.testing.assert_allclose(term.perturbation[:, 2], 2.0 * (rims[:, 1] - rims[:, 0]) / AXLE_M, atol=1e-12)


def test_terms_of_a_given_model_are_added_up_by_channel():
    line = ramps()
    p = np.array(GEOMETRY)
    settings = [
        EffectSetting("command += k u |u|", {"k": 0.1}), EffectSetting("command += k u_other", {"k": -0.2}),
        EffectSetting("turn_slip", {"k_s": 0.3}), EffectSetting("v_y += k v omega", {"k": 0.4}),
        EffectSetting("v_y += k v", {"k": 0.5}), EffectSetting("omega += k v", {"k": 0.6}),
    ]  # fmt: skip
    known = with_known_terms(line, settings, p, 0.5)
    u, v, w = line.delayed_commands(0.5), 0.03 * 8.0, 0.15 * 2.0
    np.testing.assert_allclose(known.known_command, 0.1 * u * np.abs(u) - 0.2 * u[:, ::-1], atol=1e-12)
    expected = np.broadcast_to((0.0, 0.4 * v * w + 0.5 * v, 0.6 * v), (COUNT, 3))
    np.testing.assert_allclose(known.known_motion, expected, atol=1e-12)
    timed = with_known_terms(line, [EffectSetting("command += k t/100 u", {"k": 1.0})], p, 0.5)
    np.testing.assert_allclose(timed.known_command, 0.01 * T_S[:, None] * u, atol=1e-12)
    assert timed.known_motion is None
    assert with_known_terms(line, settings[2:3], p, 0.5).known_command is None
    short = [
        EffectSetting("command += k u |u|", {"k": 0.1, "reach": 2.0}),
        EffectSetting("v_y += k v omega", {"k": 0.4, "reach": 0.01}),
    ]
    near = with_known_terms(line, short, p, 0.5)
    assert np.abs(u * np.abs(u)).max() > 2.0
    np.testing.assert_allclose(near.known_command, 0.1 * np.clip(u * np.abs(u), -2.0, 2.0), atol=1e-12)
    assert abs(v * w) > 0.01
    np.testing.assert_allclose(near.known_motion[:, 1], 0.4 * 0.01, atol=1e-12)
    offered = by_form(wheel_terms(SimpleNamespace(drive=line), 0.5))
    load = with_known_terms(line, [EffectSetting("command += k u mean_1s(|u| + |u_other|)", {"k": 0.2})], p, 0.5)
    expected = 0.2 * offered["command += 1 u mean_1s(|u| + |u_other|)"].perturbation
    np.testing.assert_allclose(load.known_command, expected, atol=1e-12)
    before = [
        EffectSetting("command += k u mean_30s(u^2)", {"k": -0.1}),
        EffectSetting("omega += k (omega - mean_1s(omega))", {"k": -0.5}),
    ]
    remembered = with_known_terms(line, before, p, 0.5)
    expected = -0.1 * offered["command += 1 u mean_30s(u^2)"].perturbation
    np.testing.assert_allclose(remembered.known_command, expected, atol=1e-12)
    np.testing.assert_allclose(remembered.known_motion[:, 2], -0.5 * w * np.exp(-T_S - 0.005), rtol=1e-4)


def lawn(seconds=100.0, width_m=4.0, height_m=2.0, corner_m=(0.0, 0.0), **settings):
    """A body channel's drive all over a floor, along rows, turning evenly."""
    count = round(seconds / GRID_STEP_S)
    line = line_of(np.repeat([[1.0, 3.0]], count, axis=0))
    share = line.t_s / seconds
    x, y = corner_m[0] + width_m * np.abs(np.mod(10.0 * share, 2.0) - 1.0), corner_m[1] + height_m * share
    measured = np.column_stack([x, y, np.zeros(count)])[line.pose.node]
    chosen = replace(DEFAULT_SETTINGS, terms=TermSettings(**settings))
    return SimpleNamespace(drive=line, settings=chosen, samples=line.pose, measured=measured), x, y


def sought_on(channel):
    return next(places(channel, np.array(GEOMETRY)), None) is not None


def test_patches_cover_the_floor_where_a_good_part_of_the_turning_was_done_inside_and_outside():
    channel, x, y = lawn()
    found = {term.disc: term for term in places(channel, np.array(GEOMETRY))}
    # From 2 to 98 % of either way, every 0.4 m.
    across, along = np.arange(0.08, 3.92, 0.4), np.arange(0.04, 1.96, 0.4)
    centres = {(round(cx, 2), round(cy, 2)) for cx, cy, _ in found}
    assert centres <= {(round(a, 2), round(b, 2)) for a in across for b in along}
    for radius in (0.5, 0.75, 1.0, 1.3):
        inside = {(a, b): np.mean((x - a) ** 2 + (y - b) ** 2 < radius**2) for a in across for b in along}
        clear = [place for place, share in inside.items() if 0.04 < share < 0.79]
        assert len([disc for disc in found if disc[2] == radius]) >= len(clear) > 5
    disc, term = next((disc, term) for disc, term in found.items() if disc[2] == 0.75)
    here = (x - disc[0]) ** 2 + (y - disc[1]) ** 2 < 0.75**2
    turning = 0.15 * 2.0
    agreeing = np.isclose(term.perturbation[:, 2], np.where(here, turning, 0.0))
    assert agreeing.mean() > 0.999
    assert (term.perturbation[:, :2] == 0.0).all()
    assert term.form.format(0.1) == f"omega += 0.1 omega within 0.75 m of ({disc[0]:.2f}, {disc[1]:.2f}) m"


@pytest.mark.parametrize(
    ("seconds", "width_m", "height_m", "sought"),
    [(100.0, 10.0, 6.0, True), (100.0, 10.0, 6.9, False), (320.0, 4.0, 2.0, True)],
)
def test_on_large_floors_no_patch_is_sought(seconds, width_m, height_m, sought):
    # 96 % of 10 m and of 6.5 m are 60 square metres, wherever they lie.
    for corner_m in ((0.0, 0.0), (50.0, -30.0)):
        channel, _, _ = lawn(seconds, width_m, height_m, corner_m)
        assert sought_on(channel) is sought


def test_a_floor_as_large_as_may_be_is_still_looked_at():
    channel, _, _ = lawn()
    x, y = (np.interp(channel.drive.t_s, channel.samples.t_s, channel.measured[:, axis]) for axis in (0, 1))
    area_m2 = np.prod([np.diff(np.quantile(of, (0.02, 0.98)))[0] for of in (x, y)])
    assert sought_on(lawn(largest_floor_m2=area_m2)[0])


def in_spots(x_m, y_m, **settings):
    """A body channel's drive that turns evenly, for a second in each of some spots."""
    line = line_of(np.repeat([[1.0, 3.0]], 100 * len(x_m), axis=0))
    measured = np.repeat(np.column_stack([x_m, y_m, y_m]), 100, axis=0)
    chosen = replace(DEFAULT_SETTINGS, terms=TermSettings(**settings))
    return SimpleNamespace(drive=line, samples=SimpleNamespace(t_s=line.t_s), measured=measured, settings=chosen)


@pytest.mark.parametrize(
    ("least", "most", "told"), [(0.2, 0.8, [0.0, 3.0]), (0.25, 0.8, [0.0]), (0.2, 0.75, [3.0]), (0.1, 0.2, [])]
)
def test_a_patch_holds_more_than_the_least_and_less_than_the_most_of_all_turning(least, most, told):
    # Three quarters of it in one spot and the rest in another, at 1 rad/s.
    channel = in_spots([0.0, 0.0, 0.0, 3.0], [0.0] * 4, least_inside=least, most_inside=most)
    discs = _discs(channel, np.array([0.5, 1.0]), ((spot_m, 0.0, 1.0) for spot_m in (0.0, 3.0)))
    assert [term.disc[0] for term in discs] == told


def test_a_patch_ends_at_its_radius():
    channel = in_spots([0.0, 3.0, 3.1, 9.0], [0.0, -4.0, -4.0, 0.0])
    for radius_m, inside in ((5.0, 100), (5.01, 200), (5.1, 300)):
        (term,) = _discs(channel, np.array(GEOMETRY), [(0.0, 0.0, radius_m)])
        assert np.count_nonzero(term.perturbation[:, 2]) == inside
        np.testing.assert_allclose(term.perturbation[:inside, 2], 0.15 * 2.0)


def test_turning_counts_and_neither_time_nor_too_little_nor_nearly_all_of_it():
    channel, x, _ = lawn()
    still = np.where((x < 2.0)[:, None], channel.drive.speed_rad_s, 2.0)
    channel.drive = replace(channel.drive, speed_rad_s=still)
    discs = [term.disc for term in places(channel, np.array(GEOMETRY))]
    assert discs
    assert all(cx - radius < 2.0 for cx, _, radius in discs)
    # None of it is turning at all: no patch, and no division by nothing.
    channel.drive = replace(channel.drive, speed_rad_s=np.full_like(still, 2.0))
    assert [*places(channel, np.array(GEOMETRY))] == []


def test_closer_around_a_patch_are_its_neighbours_and_other_sizes():
    channel, _, _ = lawn()
    near = {tuple(np.round(term.disc, 2)) for term in places_near(channel, np.array(GEOMETRY), (2.0, 1.0, 0.75))}
    steps = (-0.2, -0.1, 0.0, 0.1, 0.2)
    assert near == {
        (round(2.0 + dx, 2), round(1.0 + dy, 2), round(0.75 + dr, 2))
        for dx in steps for dy in steps for dr in (-0.15, -0.05, 0.0, 0.05, 0.15)
    }  # fmt: skip
    small = {round(term.disc[2], 2) for term in places_near(channel, np.array(GEOMETRY), (2.0, 1.0, 0.5))}
    assert small == {0.35, 0.45, 0.5, 0.55, 0.65}
    # Larger ones alone, around a centre of which the next ones lie further away.
    channel, _, _ = lawn(disc_spacing_m=0.8, disc_size_steps_m=(-1.0, 0.1))
    beside = {tuple(np.round(term.disc, 2)) for term in places_near(channel, np.array(GEOMETRY), (2.0, 1.0, 0.75))}
    steps = (-0.4, -0.2, 0.0, 0.2, 0.4)
    assert beside == {(round(2.0 + dx, 2), round(1.0 + dy, 2), 0.85) for dx in steps for dy in steps}


def test_patches_are_sought_up_to_both_ends_of_the_floor():
    channel, _, _ = lawn(disc_spacing_m=0.5, disc_radii_m=(0.4,))
    x = np.where(np.arange(channel.samples.t_s.size) % 4 < 2, 1.0, 3.0)
    channel.measured = np.column_stack([x, np.full(x.size, 2.0), x])
    discs = {term.disc for term in places(channel, np.array(GEOMETRY))}
    assert discs == {(x, 2.0, 0.4) for x in (1.0, 1.5, 2.0, 2.5, 3.0)}


def extended():
    channel, _ = body_channel()
    rng = np.random.default_rng(0)
    terms = tuple(Term(str(k), (k + 1.0) * rng.standard_normal((channel.drive.t_s.size, 3))) for k in range(2))
    return channel, terms, WithTerms.of(channel, terms)


def test_a_channel_with_terms_has_their_numbers_behind_its_own():
    channel, terms, more = extended()
    width = len(BODY.columns)
    assert more.layout.columns == (*BODY.columns, "term0", "term1")
    assert more.layout.place["term1"] == width + 1
    assert more.layout.place["x_icr_m"] == 2
    assert more.free == (0, 1, 2, width, width + 1)
    np.testing.assert_array_equal(more.neutral, [*channel.neutral, 0.0, 0.0])
    np.testing.assert_array_equal(more.layout.neutral, [*BODY.neutral, 0.0, 0.0])
    assert more.layout.low[-2:].tolist() == [-np.inf] * 2
    assert more.layout.high[-2:].tolist() == [np.inf] * 2
    assert more.layout.precision[-2:].tolist() == [0.0, 0.0]
    # A step changes the velocities by a thousandth of their unit, on the whole.
    changes = [
        step * np.sqrt((term.perturbation**2).mean()) for step, term in zip(more.layout.step[-2:], terms, strict=True)
    ]
    assert changes == pytest.approx([1e-3, 1e-3])
    assert (more.layout.step[:-2] == BODY.step).all()
    assert (more.settings, more.count, more.trusted_blocks) == (channel.settings, channel.count, channel.trusted_blocks)
    assert more.inner is channel
    np.testing.assert_array_equal(more.block, channel.block)


def test_its_residual_is_that_of_the_channel_with_what_the_terms_add():
    channel, terms, more = extended()
    p = channel.neutral
    for numbers in ((0.01, -0.02), (0.01, 0.0), (0.0, 0.0), (0.01, -0.02)):
        added = numbers[0] * terms[0].perturbation + numbers[1] * terms[1].perturbation
        core, split = more.split(np.append(p, numbers))
        np.testing.assert_array_equal(core, p)
        np.testing.assert_allclose(split, added, atol=1e-15)
        np.testing.assert_allclose(more.residual(np.append(p, numbers)), channel.residual(p, added), atol=1e-9)
        assert len(more.kept) == 1
