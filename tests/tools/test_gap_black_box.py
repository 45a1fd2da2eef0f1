"""A black box learnt from commands and poses: it learns, and is scored on the drive that it has not seen."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from torch import nn

from disco_hw.gap.data import BODY
from disco_hw.gap.noise.channels import BodyChannel
from disco_hw.gap.search.cross_validation import displacement_error, find_starts, smoothed_poses
from disco_hw.gap.settings import GRID_STEP_S
from disco_hw.model import Model
from tests.gap.synthetic import GEOMETRY, NOISE, answered, line_of, poses_of, vector_of
from tools.gap import halves
from tools.gap.black_box import STEP, BlackBox, Training, recent_speeds, train
from tools.gap.logs import simulated_drive
from tools.joystick import joystick

QUICK = Training(networks=2, hidden=8, iterations=(30, 30))
NOMINAL = Model(0.0625, 0.405, 0.25)
TURNS = ((4, 4), (-3, 3), (0, 0), (6, 2), (-4, -4), (2, 5))


class Exact(nn.Module):
    """Body velocities of a robot whose wheels are where they are commanded to be, from the mean over a step."""

    def forward(self, inputs):
        left, right = inputs[:, 0], inputs[:, 1]
        radius_m, axle_m, x_icr_m = GEOMETRY
        turn = radius_m / axle_m * (right - left)
        return torch.stack([0.5 * radius_m * (left + right), -x_icr_m * turn, turn], dim=1)


def exact_drive(turns):
    """A drive on the grid with exact poses, its body channel, and a black box that has its exact velocities."""
    line = line_of(np.repeat(np.array(turns, dtype=float), 300, axis=0))
    vector = BODY.neutral.copy()
    vector[:3] = GEOMETRY
    track = BodyChannel.build(line, NOISE, vector).track(vector)
    line = replace(line, pose_values=track[line.pose.node])
    # The step in whose middle a node is.
    step_s = (-(STEP - STEP // 2) * GRID_STEP_S, STEP // 2 * GRID_STEP_S)
    return line, BlackBox((Exact(),), np.ones(2), Training(edges_s=step_s))


@cache
def simulated_halves():
    """40 s of a robot with slow motors, driven by joystick, and 40 s of another drive of it, on the grid."""
    return [slow_drive(seed) for seed in (3, 4)]


def slow_drive(seed):
    # 40 commands a second, 100 cells.
    command = np.ascontiguousarray(np.repeat(joystick(seed, 40.0), 5, axis=0)[::2])
    line = answered(command, motor_lag=0.15)
    return replace(line, pose_values=poses_of(line, vector_of(), seed=seed))


@cache
def quick_box():
    return trained(simulated_halves()[0])


def trained(drive):
    body, _, chain = halves.channels(drive, NOMINAL)
    poses = smoothed_poses(body, chain.body)
    return train(drive, find_starts(body, poses, 2.0), poses[1], 2.0, QUICK)


def unseen(drive, box):
    return halves.unseen_errors(drive, {"timed": NOMINAL}, box=box)[halves.BLACK_BOX]


def test_exact_velocities_have_no_error_on_their_own_drive_and_the_score_is_of_that_drive():
    line, box = exact_drive(TURNS)
    errors = halves.unseen_errors(line, {"timed": Model(*GEOMETRY)}, box=box)
    own = errors[halves.BLACK_BOX]
    assert own.position_m < 5e-4
    assert own.yaw_rad < 1e-4
    # The same starts and blocks as those of a model.
    assert own.by_regime_m.keys() == errors["timed"].by_regime_m.keys()
    assert own.by_stretch.shape == errors["timed"].by_stretch.shape
    wrong = BlackBox(box.networks, np.array([1.0, 1.1]), box.training)
    assert unseen(line, wrong).position_m > 20.0 * own.position_m


def test_a_trained_box_predicts_another_half_better_than_rest_and_than_a_constant_velocity():
    _, other = simulated_halves()
    found = unseen(other, quick_box())
    body, _, chain = halves.channels(other, NOMINAL)
    poses = smoothed_poses(body, chain.body)
    starts = find_starts(body, poses, 2.0)
    before = poses[0][starts.node - 50]
    dx, dy, turned = np.moveaxis(starts.pose - before, 1, 0)
    cosine, sine = np.cos(starts.pose[:, 2]), np.sin(starts.pose[:, 2])
    constant = 4.0 * np.column_stack([cosine * dx + sine * dy, cosine * dy - sine * dx, turned])
    known = np.isfinite(constant[:, 0])
    for moved in (np.zeros(constant.shape), constant):
        error = displacement_error(starts, moved)[known]
        assert found.position_m < 0.3 * np.sqrt((error[:, :2] ** 2).sum(axis=1).mean())
        assert found.yaw_rad < 0.3 * np.sqrt((error[:, 2] ** 2).mean())


def test_a_box_of_a_half_has_not_seen_the_other_one():
    first, other = simulated_halves()
    # If the robot drives the other way from then on, what was learnt before is wrong by twice the way.
    turned = replace(other, command_rad_s=-other.command_rad_s)
    box = quick_box()
    assert unseen(turned, box).position_m > 10.0 * unseen(other, box).position_m
    assert unseen(first, box).position_m < 2.0 * unseen(other, box).position_m


def test_two_trainings_give_the_same_box_whatever_numbers_were_drawn_before():
    drive, node = simulated_halves()[0], np.array([300, 900])
    one = quick_box().displacement(drive, node, 2.0)
    torch.manual_seed(1)
    np.testing.assert_array_equal(trained(drive).displacement(drive, node, 2.0), one)


def test_without_commands_measured_wheel_speeds_stand_in():
    line, _ = exact_drive(TURNS)
    silent = replace(line, command_rad_s=np.full_like(line.command_rad_s, np.nan))
    node = np.array([100, 450, 1000])
    np.testing.assert_array_equal(
        recent_speeds(silent, node, (0.0, 0.1, 0.5)), recent_speeds(line, node, (0.0, 0.1, 0.5))
    )


def test_recent_speeds_stay_within_their_run_and_undo_what_the_grid_moved():
    line = line_of(np.repeat([[1.0, 2.0], [3.0, 4.0]], 100, axis=0))
    line = replace(line, first=np.isin(np.arange(200), (0, 100)))
    # 0.1 s back from 0.05 s after its run's begin, and 0.2 s ahead of it.
    np.testing.assert_allclose(recent_speeds(line, np.array([105, 95]), (-0.2, 0.0, 0.1))[:, 2:], [[3, 4], [1, 2]])
    np.testing.assert_allclose(recent_speeds(line, np.array([95]), (-0.2, 0.0))[0], [1, 2])
    whole = replace(line, first=np.arange(200) == 0)
    assert recent_speeds(whole, np.array([104]), (0.0, 0.1))[0, 0] == pytest.approx(1.0 + 2.0 * 0.4)
    late = replace(whole, poses_moved_s=0.03, commands_moved_s=0.02)
    assert recent_speeds(late, np.array([104]), (0.0, 0.1))[0, 0] == pytest.approx(1.0 + 2.0 * 0.9)


def half(name, timed, box):
    errors = {
        stage: halves.PredictionErrors(position_m, (0.0, 0.0), yaw_rad, (0.0, 0.0), 0.0, {})
        for stage, (position_m, yaw_rad) in (("timed", timed), (halves.BLACK_BOX, box))
    }
    return halves.Half(name, "timed", (), errors, {}, 0.0)


def test_the_last_line_counts_both_and_names_what_the_box_knows_better():
    found = [
        half("a", (2.0, 2.0), (1.0, 1.0)),
        half("b", (1.0, 1.0), (2.0, 2.0)),
        half("c", (1.0, 1.0), (0.79, 2.0)),
        half("d", (1.0, 1.0), (0.81, 0.9)),
    ]
    line = halves.against_black_box(found)
    assert "heading: 2 of 4, better in both: 1;" in line
    assert line.endswith("better by 20 % in one of them: 2 (a, c)")


@pytest.mark.thorough
def test_a_black_box_of_a_part_is_trained_on_that_part_and_scored_on_the_other(monkeypatch):
    monkeypatch.setattr(halves, "train", lambda *of: train(*of, QUICK))
    log = simulated_drive({"motor_lag": 0.15}, seed=3)
    first, other = (halves.between(log, *span_s) for span_s in ((60.0, 100.0), (100.0, 140.0)))
    part = halves.Part.search("first", first, NOMINAL)
    # Driven the other way, the other part shows which of both was learnt from.
    commands = replace(other.commands, left_rad_s=-other.commands.left_rad_s, right_rad_s=-other.commands.right_rad_s)
    turned = replace(part, name="second", log=replace(other, commands=commands))
    found, back, again = (
        next(halves.taught(part, [whom], NOMINAL, boxed=True)) for whom in (replace(part, log=other), turned, part)
    )
    assert found.unseen.keys() == {*halves.STAGES, halves.BLACK_BOX}
    errors = [each.unseen[halves.BLACK_BOX].position_m for each in (found, back, again)]
    assert errors[1] > 10.0 * errors[0]
    assert errors[2] < 2.0 * errors[0]
    plain = next(halves.taught(part, [turned], NOMINAL))
    assert plain.unseen == {stage: back.unseen[stage] for stage in halves.STAGES}
