"""`pytest --robot=ROBOT.toml`: the conformance suite of the protocol against whatever answers on that link."""

from pathlib import Path

import pytest

from disco_hw.daemon.check import refuse_beside_a_daemon
from disco_hw.daemon.link import make_link
from disco_hw.errors import InputError, WorkError
from disco_hw.runtime.robot_setup import link_key, load_setup
from tests.firmware_protocol.conformance import FirmwareConformance
from tests.firmware_protocol.other_end import LinkEnd


class TestRobot(FirmwareConformance):
    @classmethod
    def make_end(cls, config):
        try:
            setup = load_setup(Path(config.getoption("--robot")))
            cls.key, transport = link_key(setup), make_link(setup)
            refuse_beside_a_daemon(setup.config)
        except InputError as error:
            pytest.exit(str(error), returncode=2)
        except WorkError as error:
            pytest.exit(str(error), returncode=1)
        transport.open()
        return LinkEnd(transport)
