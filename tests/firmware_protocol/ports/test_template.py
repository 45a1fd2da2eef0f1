"""The template passes what docs/port.md has it pass before its wheels are measured: steps 4 and 5."""

import pytest

from drivers.transport import serial
from tests.firmware_protocol.conformance import FirmwareConformance
from tests.firmware_protocol.other_end import LinkEnd
from tests.firmware_protocol.ports.posix_board import TEMPLATE, build_board, running_board

pytestmark = [pytest.mark.thorough, pytest.mark.hil]


class TestTemplate(FirmwareConformance):
    """All tests without motion and restarts on a board with clock, link and entropy alone."""

    port = ""

    @pytest.fixture(scope="class", autouse=True)
    @classmethod
    def board(cls, tmp_path_factory):
        with running_board(build_board(tmp_path_factory.mktemp("board"), *TEMPLATE)) as board:
            cls.port = board.link
            yield

    @pytest.fixture(autouse=True)
    @staticmethod
    def skip_later_steps(request):
        if any(map(request.node.get_closest_marker, ("motion", "restart"))):
            pytest.skip("a later step")

    @classmethod
    def create_end(cls, config):
        transport = serial.create_transport(port=cls.port)
        transport.open()
        return LinkEnd(transport)
