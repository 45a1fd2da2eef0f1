"""`disco-hw init`: what is heard on a link that is only listened to, and a robot.toml that the other verbs take."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from disco_hw.config import load_robot_config
from disco_hw.errors import InputError
from disco_hw.experiments.live_stack import disco_hw_process, write_robot_file
from disco_hw.first_use.init import InitOptions, recognised, run_init
from disco_hw.runtime.robot_setup import load_setup
from drivers.motor import motor_drivers
from drivers.types import Frame
from sim.plant_parameters import PlantParameters
from tests.first_use.miswired import MiswiredRobot, Miswiring, robot_file

SIMULATED = {"reference": {}, "odrive": {"nodes": [3, 5]}, "vesc": {"nodes": [23, 51]}, "agilex": {}}


def quiet(_text):
    pass


@pytest.mark.parametrize("driver", SIMULATED)
def test_a_controller_is_known_by_what_it_sends_unasked(tmp_path, driver):
    robot = MiswiredRobot(load_setup(robot_file(tmp_path, driver)), PlantParameters(), Miswiring())
    robot.advance(2_000_000)
    frames = [received.frame for received in robot.host.receive()]
    robot.close()
    assert [(one.driver, one.fields) for one in recognised(frames)] == [(driver, SIMULATED[driver])]


def test_foreign_frames_are_nobodys():
    assert recognised([Frame(can_id, bytes(8)) for can_id in range(0x800)]) == ()


@pytest.mark.parametrize("driver", motor_drivers())
def test_what_is_written_for_any_driver_is_accepted(tmp_path, driver):
    out = run_init(InitOptions(tmp_path / "robot.toml", driver=driver), None, quiet)
    assert load_robot_config(out).link.driver == driver
    assert "disco-hw commission" in out.read_text(encoding="utf-8")


def test_what_a_person_answers_stands_in_the_file(tmp_path):
    answers = iter(["0.1", "", "nonsense", "4096", ""])
    out = run_init(InitOptions(tmp_path / "robot.toml", driver="reference"), lambda _question: next(answers), quiet)
    robot = load_robot_config(out).robot
    assert (robot.wheel_radius_m, robot.axial_distance_m, robot.ticks_per_rev) == (0.1, 0.31, 4096)


def test_a_file_that_is_there_stays_unless_told_otherwise(tmp_path):
    out = tmp_path / "robot.toml"
    out.write_text("mine")
    with pytest.raises(InputError, match="is there already"):
        run_init(InitOptions(out, driver="reference"), None, quiet)
    assert out.read_text() == "mine"
    run_init(InitOptions(out, driver="reference", overwrite=True), None, quiet)
    assert "[robot]" in out.read_text(encoding="utf-8")


UNFIT = {
    "a directory": (lambda path: path, "is a directory"),
    "under a file": (lambda path: Path(__file__) / "robot.toml", "is no directory"),
    "a name that is too long": (lambda path: path / ("x" * 300), r"cannot be written \(File name too long\)"),
    "a file system of the kernel": (lambda path: Path("/proc/self/robot.toml"), "cannot be written"),
}


@pytest.mark.parametrize(("place", "words"), UNFIT.values(), ids=UNFIT)
@pytest.mark.parametrize("overwrite", [False, True])
def test_what_cannot_be_written_is_refused_in_one_line_and_nothing_is_left(tmp_path, place, words, overwrite):
    out = place(tmp_path)
    with pytest.raises(InputError, match=words) as refused:
        run_init(InitOptions(out, driver="reference", overwrite=overwrite), None, quiet)
    assert str(refused.value).startswith(f"{out}: ")
    assert "\n" not in str(refused.value)
    assert not list(tmp_path.iterdir())


def test_without_a_controller_it_says_what_to_name(tmp_path):
    with pytest.raises(InputError, match=r"--driver with one of .*odrive"):
        run_init(InitOptions(tmp_path / "robot.toml"), None, quiet)


def test_what_no_robot_is_like_is_refused_and_nothing_is_left(tmp_path):
    with pytest.raises(InputError, match=r"robot.wheel_radius_m"):
        run_init(
            InitOptions(tmp_path / "robot.toml", driver="odrive", measures=(("wheel_radius_m", 9.0),)), None, quiet
        )
    assert not list(tmp_path.iterdir())


@pytest.mark.hil
def test_from_the_bus_of_a_virtual_robot_to_a_file_that_check_accepts(tmp_path):
    robot = write_robot_file(tmp_path, device="odrive")
    bus, out = tmp_path / "bus", tmp_path / "mine.toml"
    with disco_hw_process("virtual robot", ["sim", str(robot)], tmp_path / "sim.txt"):
        command = [sys.executable, "-m", "disco_hw"]
        for _ in range(100):
            options = [
                "init",
                "-o",
                str(out),
                "--link",
                f"can:unixcan:{bus}",
                "--yes",
                "--overwrite",
                "--listen-s",
                "1",
            ]
            done = subprocess.run([*command, *options], capture_output=True, text=True, timeout=60, check=False)
            if done.returncode == 0:
                break
        assert done.returncode == 0, done.stderr
        config = load_robot_config(out)
        assert (config.link.driver, config.link.settings().nodes) == ("odrive", (3, 5))
        checked = subprocess.run([*command, "check", str(out)], capture_output=True, text=True, timeout=60, check=False)
    assert "FAIL  link" not in checked.stdout
    assert "FAIL  firmware" not in checked.stdout, checked.stdout
