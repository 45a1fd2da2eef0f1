"""Adaptation in the daemon's tick: learnt, recorded, replayed bit for bit, refused, taken back when asked."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from msgspec import structs

from disco_hw.adaptation import NoAdaptation
from disco_hw.adaptation.fast import FastAdaptation
from disco_hw.adaptation.guard import Geometry, believed_geometry
from disco_hw.experiments.simulated_time import SimulatedRun, virtual_robot
from disco_hw.log.records import Adaptation, BeliefChange, Event
from disco_hw.runtime.assembly import create_planner
from disco_hw.runtime.replay import replay
from disco_hw.runtime.robot_setup import load_setup
from sim.body_dynamics import BodyPose
from sim.plant_parameters import PlantParameters
from tests.runtime.simulated import write_run
from tools.foreign_plant import NOMINAL, ForeignPlant, robots

ROBOT = Path(__file__).parents[2] / "disco_hw" / "robots" / "wombot.toml"


# Of the ground: m/s, and which way (rad).
DRIFT = (0.03, 1.2)


def short_sighted(directory):
    """The shipped robot, which looks a short way ahead: plans are most of a log."""
    text = ROBOT.read_text().replace("rate_hz = 50.0", "rate_hz = 50.0\nhorizon = 25")
    (directory / "robot.toml").write_text(text)
    (directory / "wombot_model.toml").write_text(ROBOT.with_name("wombot_model.toml").read_text())
    return load_setup(directory / "robot.toml")


def driven(directory, seconds):
    setup = short_sighted(directory)
    x_icr, radius, axial = believed_geometry(setup.model).mean.tolist()
    plant = replace(
        PlantParameters(ticks_per_rev=2048), x_icr_m=x_icr, wheel_radius_m=0.88 * radius, axial_distance_m=1.12 * axial
    )
    robot = virtual_robot(setup, plant, BodyPose(0.75, 0.0, 1.57), effects={"slope": DRIFT}, seed=1)
    run = SimulatedRun(setup, robot, create_planner(setup.config, setup.model))
    run.start()
    run.run(seconds)
    return run, (x_icr, 0.88 * radius, 1.12 * axial)


def changes(run):
    return [record for _, tick in run.recorder.ticks for record in tick if isinstance(record, BeliefChange)]


def test_the_geometry_is_learnt_logged_and_taken_back_when_asked(tmp_path):
    run, truth = driven(tmp_path, 6.0)
    adaptation = run.core.adaptation
    assert adaptation.status()["belief"] == "adapted"
    assert len(changes(run)) > 3
    np.testing.assert_allclose(changes(run)[-1].mean, truth, rtol=0.05)
    drift = DRIFT[0] * np.exp(1j * DRIFT[1])
    assert changes(run)[-1].drift_x_m_s == pytest.approx(drift.real, abs=0.01)
    assert changes(run)[-1].drift_y_m_s == pytest.approx(drift.imag, abs=0.01)
    assert adaptation.status()["drift_m_s"] == pytest.approx([drift.real, drift.imag], abs=0.01)
    told = [event.text for _, tick in run.recorder.ticks for event in tick if isinstance(event, Event)]
    assert any("the ground carries the robot by 0.0" in text for text in told)

    assert adaptation.handle_request("revert")[0]
    run.run(1.2)
    assert adaptation.status()["belief"] == "model"
    assert changes(run)[-1].source == "model"
    assert changes(run)[-1].drift_x_m_s == 0.0
    assert adaptation.handle_request("adapt")[0]
    run.run(1.6)
    assert adaptation.status()["belief"] == "adapted"

    report = replay(write_run(run, tmp_path / "drive.mcap"))
    assert report.ok, report.as_text()
    assert report.ticks == len(run.recorder.ticks)

    # The drift is planned and estimated with: without it the replay is another drive.
    still = [
        (now, [structs.replace(one, drift_y_m_s=0.0) if isinstance(one, BeliefChange) else one for one in tick])
        for now, tick in run.recorder.ticks
    ]
    run.recorder.ticks[:] = still
    difference = replay(write_run(run, tmp_path / "still.mcap")).difference
    assert difference is not None
    assert difference.field.startswith("Estimate.")


MEAN = np.array(NOMINAL)[[2, 0, 1]]
MODEL = Geometry(MEAN, np.diag((0.05 * MEAN) ** 2))


def learning(apply_geometry, spoil=lambda adaptation: None):
    """Drive a robot unlike MODEL for 4 s; returns the adaptation and the records that it wrote."""
    adaptation = FastAdaptation(MODEL, 0.5 * MEAN, 1.6 * MEAN, apply_geometry)
    plant, written = ForeignPlant(robots(8001, 1)[0], (0.0, 0.0, 0.3), 1), []
    for _ in range(200):
        adaptation.feed(plant.now_ns, plant.readings())
        spoil(adaptation)
        written += adaptation.step(plant.now_ns).records
        plant.advance(2.6, 4.6, 20)
    return adaptation, written


def test_while_poses_and_wheels_disagree_what_was_learnt_before_is_in_force():
    in_force, told, written = [], [], []
    adaptation = FastAdaptation(MODEL, 0.5 * MEAN, 1.6 * MEAN, in_force.append)
    robot = robots(8001, 1)[0]
    plant = ForeignPlant(robot, (0.0, 0.0, 0.3), 1)
    truth = np.array([robot.x_icr_m, robot.radius_m, robot.axle_m])

    def drive_on(seconds, stamped_late_ns):
        told.clear()
        for _ in range(round(seconds / 0.02)):
            readings = plant.readings()
            poses = tuple(structs.replace(pose, t_ns=pose.t_ns + stamped_late_ns) for pose in readings.poses)
            adaptation.feed(plant.now_ns, structs.replace(readings, poses=poses))
            update = adaptation.step(plant.now_ns)
            told.extend(update.events)
            written.extend(update.records)
            plant.advance(*((2.6, 4.6) if plant.now_ms // 2000 % 2 else (4.6, 2.6)), 20)

    drive_on(14.0, 0)
    assert in_force[-1].mean == pytest.approx(truth, rel=0.05)
    drive_on(10.0, 300_000_000)
    assert sum("poses and wheels differ by" in event for event in told) == 1
    (refused,) = (one for one in written if isinstance(one, Adaptation))
    assert refused.outcome == "refused"
    assert "check the pose source's delay" in refused.text
    last = [one for one in written if isinstance(one, BeliefChange)][-1]
    assert last.mean == pytest.approx(truth, rel=0.05)
    assert in_force[-1].mean.tolist() == list(last.mean)
    assert in_force[-1].drift_m_s == (0.0, 0.0)
    assert adaptation.status()["mean"]["wheel_radius_m"] == last.mean[1]
    assert adaptation.status()["misfit"] > 3.0
    drive_on(25.0, 0)
    assert "adapt: poses and wheels agree again" in told
    assert in_force[-1].mean == pytest.approx(truth, rel=0.05)


def test_a_belief_that_the_planner_refuses_is_counted_and_not_in_force():
    def refuse(geometry):
        raise ValueError("too fast a turn")

    adaptation, written = learning(refuse)
    status = adaptation.status()
    assert status["belief"] == "model"
    assert list(status["mean"].values()) == MEAN.tolist()
    assert adaptation.counts()["refused"] == len(written) > 0
    assert {(type(one), one.outcome) for one in written} == {(Adaptation, "refused")}
    assert "too fast a turn" in written[0].text


def test_an_estimate_of_absurd_variance_never_reaches_the_planner():
    applied = []

    def spoil(adaptation):
        adaptation._filter._bank.covariance[0, 3:6, 3:6] = np.diag([1e300] * 3)

    adaptation, written = learning(applied.append, spoil)
    assert applied == []
    assert adaptation.status()["belief"] == "model"
    assert adaptation.counts()["refused"] == len(written) > 0
    assert all("no covariance" in one.text for one in written)


def test_without_adaptation_a_request_is_refused_with_what_starts_it():
    accepted, text = NoAdaptation().handle_request("adapt")
    assert not accepted
    assert "--adapt" in text
    assert NoAdaptation().status() is None
