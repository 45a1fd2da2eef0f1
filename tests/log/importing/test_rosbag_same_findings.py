"""A simulated drive as a bag of ROS 2 and back: `infer` and `gap` find in it what they find in our own log of it."""

import json

import pytest

from disco_hw.config import SHIPPED_ROBOT
from disco_hw.drive.coverage import Coverage
from disco_hw.drive.hand_pilot import HandPilot
from disco_hw.drive.script import ScriptSource, Unattended
from disco_hw.drive.scripts import create_script
from disco_hw.experiments.simulated_time import SimulatedRun, virtual_robot
from disco_hw.experiments.virtual import true_parameters
from disco_hw.runtime.pipeline import NoPlanner
from disco_hw.runtime.robot_setup import load_setup
from sim.body_dynamics import BodyPose
from tests.log.importing.commands import call

pytestmark = [pytest.mark.long, pytest.mark.timeout(1500)]


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Our own log of a minute's drive of a robot with a deadband, and the one that came through a bag."""
    folder = tmp_path_factory.mktemp("drive")
    setup = load_setup(SHIPPED_ROBOT)
    config = setup.config
    script = create_script("separate", config.robot, config.task, config.drive.speed_share)
    pilot = HandPilot(ScriptSource(script, Unattended()), Coverage(1.0))
    robot = virtual_robot(
        setup, true_parameters(setup, 3), BodyPose(*config.task.course().start), effects={"deadband": (0.8,)}, seed=1
    )
    run = SimulatedRun(setup, robot, NoPlanner(), pilot)
    run.drive(script.duration_s + 10.0)
    run.write_log(folder / "own.mcap")
    call("log", "export", folder / "own.mcap", "-o", folder / "bag", "--rosbag2")
    call("import", folder / "bag", "--robot", SHIPPED_ROBOT, "-o", folder / "imported.mcap")
    return folder / "own.mcap", folder / "imported.mcap"


def test_the_posteriors_lie_within_one_anothers_intervals(logs, tmp_path):
    original, imported = (
        json.loads(call("infer", log, "--robot", SHIPPED_ROBOT, "-o", tmp_path / f"{i}.toml", "--json"))["posterior"]
        for i, log in enumerate(logs)
    )
    assert set(original) == set(imported)
    for name, found in original.items():
        for one, other in ((found, imported[name]), (imported[name], found)):
            low, high = other["ci90"]
            assert low <= one["mean"] <= high, name


def test_the_same_effect_is_named_with_the_same_value(logs, tmp_path):
    reports = []
    for i, log in enumerate(logs):
        call("gap", log, "--robot", SHIPPED_ROBOT, "-o", tmp_path / str(i))
        reports.append(json.loads((tmp_path / str(i) / "report.json").read_text(encoding="utf-8")))
    original, imported = ({effect["name"]: effect["parameters"] for effect in one["effects"]} for one in reports)
    assert set(original) == set(imported)
    assert "deadband" in original
    for name, parameters in original.items():
        for parameter, found in parameters.items():
            other = imported[name][parameter]
            assert other["ci95"][0] <= found["value"] <= other["ci95"][1], f"{name} {parameter}"
            assert found["ci95"][0] <= other["value"] <= found["ci95"][1], f"{name} {parameter}"
