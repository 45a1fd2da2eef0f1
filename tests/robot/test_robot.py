"""`pytest --robot=ROBOT.toml`: the conformance suite of the protocol against whatever answers on that link."""

from pathlib import Path

import pytest

from disco_hw.errors import InputError
from disco_hw.robot_setup import link_key, load_setup
from drivers.transport import open_transport
from tests.firmware_protocol.conformance import FirmwareConformance
from tests.firmware_protocol.other_end import LinkEnd


class TestRobot(FirmwareConformance):
    @classmethod
    def make_end(cls, config):
        try:
            setup = load_setup(Path(config.getoption("--robot")))
            cls.key = link_key(setup)
        except InputError as error:
            pytest.exit(str(error), returncode=2)
        link = setup.config.link
        return LinkEnd(
            open_transport(
                link.kind,
                interface=link.interface,
                channel=link.channel,
                bitrate=link.bitrate,
                port=link.port,
                baud=link.baud,
            )
        )
