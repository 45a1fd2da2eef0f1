"""The conformance suite of the protocol, with motion and restarts, over the serial line of an emulated Cortex-M."""

import pytest

from tests.firmware_protocol.conformance import FirmwareConformance
from tests.firmware_protocol.emulated.board_end import EMULATED, BoardEnd

pytestmark = [*EMULATED, pytest.mark.timeout(300)]


class EmulatedConformance(FirmwareConformance):
    processor = "m3"
    is_slcan = False

    @classmethod
    def create_end(cls, config):
        return BoardEnd(cls.processor, key=cls.key, slcan=cls.is_slcan)


class TestM3(EmulatedConformance):
    pass


class TestM4F(EmulatedConformance):
    processor = "m4f"


class TestAuthenticatedM3(TestM3):
    key = bytes(range(16))


class TestAuthenticatedM4F(TestM4F):
    key = bytes(range(16))


class TestSlcanM4F(TestM4F):
    is_slcan = True
