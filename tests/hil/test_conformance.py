"""`pytest --robot=ROBOT.toml` as the writer of a board would run it, here against the virtual robot."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from disco_hw.experiments import DEVICES
from tests.hil.stack import virtual_robot
from tools.stack import write_robot_file

pytestmark = [pytest.mark.hil, pytest.mark.long, pytest.mark.timeout(300)]
ROOT = Path(__file__).resolve().parents[2]
KEY = "000102030405060708090a0b0c0d0e0f\n"


def with_key(robot_file, key):
    """The robot file, with a key in a file beside it unless `key` is None."""
    if key is not None:
        path = robot_file.with_name("key")
        path.write_text(key)
        path.chmod(0o600)
        robot_file.write_text(robot_file.read_text().replace("[link]\n", '[link]\nkey_file = "key"\n'))
    return robot_file


def conform(robot_file, *arguments, at_terminal=""):
    command = [sys.executable, "-m", "pytest", f"--robot={robot_file}", "-p", "no:cacheprovider", *arguments]
    result = subprocess.run(
        command, cwd=ROOT, input=at_terminal, capture_output=True, text=True, timeout=250, check=False
    )
    found = {
        outcome: int(count) for count, outcome in re.findall(r"(\d+) (passed|failed|skipped|error)", result.stdout)
    }
    return result.returncode, found, result.stdout + result.stderr


@pytest.mark.parametrize(
    ("link", "key", "chosen", "least"),
    [
        ("can", KEY, "introduces or heard or another_key or length_0 or 0] or follows or silence_stops", 7),
        ("serial", None, "introduces or telemetry or damaged or opens or follows", 6),
    ],
)
def test_the_virtual_robot_conforms(tmp_path, link, key, chosen, least):
    robot_file = with_key(write_robot_file(tmp_path, link), key)
    with virtual_robot(robot_file):
        code, found, output = conform(robot_file, "--allow-motion", "-k", chosen)
        assert code == 0, output
        assert found["passed"] >= least, output
        if key is None:
            code, found, output = conform(robot_file, "-k", "follows or introduces")
            assert (code, found) == (0, {"passed": 1, "skipped": 1}), output


@pytest.mark.parametrize(
    "device",
    [
        *(device for device in DEVICES if device != "ros2_base"),
        "vesc over a serial line",
        pytest.param("ros2_base", marks=pytest.mark.long),
    ],
)
def test_each_vendors_simulated_controller_conforms(tmp_path, device):
    robot_file = write_robot_file(tmp_path, device=device.split()[0])
    if "serial" in device:
        text = robot_file.read_text().replace('kind = "can"', 'kind = "serial"').replace("921600", "115200")
        robot_file.write_text(text.replace('driver = "vesc"', 'driver = "vesc"\nuart_node = 23'))
    with virtual_robot(robot_file):
        code, found, output = conform(robot_file, "--allow-motion", "-k", "vendor or introduces")
        assert (code, found) == (0, {"passed": 12, "skipped": 1}), output
        code, found, output = conform(robot_file, "-k", "before_it_is_armed or stands_and_stays or zeros")
        assert (code, found) == (0, {"passed": 1, "skipped": 1}), output


@pytest.mark.parametrize("key", [None, KEY])
def test_the_virtual_robot_draws_anew_at_each_restart(tmp_path, key):
    robot_file = with_key(write_robot_file(tmp_path), key)
    socket = tmp_path / "inject"
    restart = f"{sys.executable} -m sim.process {socket} reboot"
    with virtual_robot(robot_file, "--inject", str(socket)):
        code, found, output = conform(robot_file, "--allow-motion", f"--allow-restart={restart}", "-k", "restart")
        assert (code, found) == (0, {"passed": 2}), output
        code, found, output = conform(robot_file, "-k", "restart")
        assert (code, found) == (0, {"skipped": 2}), output
        code, found, output = conform(robot_file, "--allow-restart", "-k", "no_session")
        assert code == 1
        assert "there is no terminal to ask at" in output
        code, found, output = conform(robot_file, "--allow-restart", "-k", "no_session", at_terminal="\n")
        assert code == 1
        assert "was it restarted?" in output
        code, found, output = conform(robot_file, "--allow-restart=false", "-k", "no_session")
        assert code == 1
        assert "--allow-restart: false:" in output
