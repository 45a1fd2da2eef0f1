"""The source that docs/add-a-pose-source.md explains gives poses from real datagrams, and robot.toml takes its name."""

import math
import re
import socket
import struct
from pathlib import Path

import pytest

import drivers.pose
from disco_hw.config import load_robot_config
from disco_hw.errors import InputError
from drivers.pose import DEFAULT, PoseSourceError, create_pose_source, pose_sources
from drivers.types import PoseSample
from tests.config.test_robot import GOOD

ROOT = Path(__file__).parents[3]
EXAMPLE = ROOT / "docs/examples/beacon.py"
CODE = EXAMPLE.read_text(encoding="utf-8")
FROM_ROBOT = (PoseSample(1, 2, 0.0, 0.0, 0.0, 0.01, 0.02),)


@pytest.fixture
def _in_the_folder(tmp_path, monkeypatch):
    """The example as if it lay in drivers/pose."""
    (tmp_path / "beacon.py").write_text(CODE, encoding="utf-8")
    monkeypatch.setattr(drivers.pose, "__path__", [*drivers.pose.__path__, str(tmp_path)])
    pose_sources.cache_clear()
    yield
    pose_sources.cache_clear()


def robot_toml(folder, section):
    file = folder / "robot.toml"
    file.write_text(GOOD + f"[pose]\n{section}\n")
    return file


@pytest.mark.usefixtures("_in_the_folder")
def test_it_gives_what_was_sent_and_leaves_out_what_is_no_pose(port):
    source = create_pose_source("beacon", beacon_port=port)
    assert source.receive(5, FROM_ROBOT) == []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as beacon:
        beacon.connect(("127.0.0.1", port))
        for x_m in (1.0, math.nan, math.inf, 2.0):
            beacon.send(struct.pack("<6d", 1.5, x_m, -2.0, 0.5, 0.01, 0.02))
        for hostile in (b"", b"x", bytes(47), bytes(90), bytes(200)):
            beacon.send(hostile)
    # Datagrams on the loopback are there when `send` has come back.
    poses = source.receive(1_600_000_000, FROM_ROBOT)
    assert poses == [PoseSample(1_500_000_000, 1_600_000_000, x_m, -2.0, 0.5, 0.01, 0.02) for x_m in (1.0, 2.0)]
    assert source.malformed == 7
    source.close()
    assert source.receive(7, ()) == []


@pytest.mark.usefixtures("_in_the_folder")
def test_a_port_that_cannot_be_had_is_one_line(port):
    source = create_pose_source("beacon", beacon_port=port)
    with pytest.raises(PoseSourceError, match=rf"^port {port}: Address already in use; choose another beacon_port$"):
        create_pose_source("beacon", beacon_port=port)
    source.close()


@pytest.mark.usefixtures("_in_the_folder")
def test_robot_toml_takes_its_name(tmp_path):
    assert load_robot_config(robot_toml(tmp_path, 'source = "beacon"')).pose.source == "beacon"


@pytest.mark.parametrize("wrong", ['"beacon"', "7", "[]"])
def test_another_name_is_refused_with_those_that_there_are(tmp_path, wrong):
    with pytest.raises(InputError, match=rf"robot\.toml: pose\.source: .*; write one of {', '.join(pose_sources())}$"):
        load_robot_config(robot_toml(tmp_path, f"source = {wrong}"))


def test_the_default_source_is_the_motor_controller():
    source = create_pose_source(DEFAULT)
    assert source.receive(5, FROM_ROBOT) == FROM_ROBOT


def test_no_other_file_names_a_pose_source():
    files = [file for top in ("disco_hw", "drivers") for file in (ROOT / top).rglob("*.py")]
    texts = {str(file.relative_to(ROOT)): file.read_text(encoding="utf-8") for file in files}
    quoted = {name: re.compile(rf"""["']{name}["']""") for name in pose_sources()}
    named = {
        name: [
            file
            for file, text in texts.items()
            if any(re.search(r"(?i)source\b.{0,20}$", text[: found.start()][-40:]) for found in pattern.finditer(text))
        ]
        for name, pattern in quoted.items()
    }
    assert named == {name: [f"drivers/pose/{name}.py"] for name in pose_sources()}
