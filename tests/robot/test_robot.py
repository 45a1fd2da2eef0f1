"""`pytest --robot=ROBOT.toml`: the conformance suite of the protocol against whatever answers on that link."""

import shlex
import subprocess
from pathlib import Path

import pytest

from disco_hw.daemon.check import refuse_while_daemon_runs
from disco_hw.errors import InputError, WorkError
from disco_hw.runtime.assembly import create_link
from disco_hw.runtime.robot_setup import link_key, load_setup
from drivers.motor import DEFAULT
from tests.firmware_protocol.conformance import FirmwareConformance
from tests.firmware_protocol.other_end import LinkEnd


class TestRobot(FirmwareConformance):
    @classmethod
    def create_end(cls, config):
        try:
            setup = load_setup(Path(config.getoption("--robot")))
            if setup.config.link.driver not in (None, DEFAULT):
                pytest.skip("another controller answers: tests/robot/test_vendor_robot.py")
            cls.key, transport = link_key(setup), create_link(setup)
            refuse_while_daemon_runs(setup.config)
        except InputError as error:
            pytest.exit(str(error), returncode=2)
        except WorkError as error:
            pytest.exit(str(error), returncode=1)
        transport.open()
        return LinkEnd(transport, lambda: restart(config))


def restart(config):
    """Have the robot's controller restarted: by the command that was given, or by whoever sits at the terminal."""
    command = config.getoption("--allow-restart")
    if command:
        done = subprocess.run(shlex.split(command), capture_output=True, text=True, timeout=60, check=False)
        assert done.returncode == 0, f"--allow-restart: {command}: {done.stderr.strip() or done.stdout.strip()}"
        return
    capture = config.pluginmanager.getplugin("capturemanager")
    capture.suspend_global_capture(in_=True)
    try:
        input("\nSwitch the robot's controller off and on, then press Enter: ")
    except EOFError:
        pytest.fail("there is no terminal to ask at; give --allow-restart=COMMAND, or run pytest at one")
    finally:
        capture.resume_global_capture()
