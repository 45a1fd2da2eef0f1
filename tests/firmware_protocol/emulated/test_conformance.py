"""The conformance suite of the protocol, with motion and restarts, over the serial line of an emulated Cortex-M."""

import pytest

from tests.firmware_protocol.conformance import FirmwareConformance
from tests.firmware_protocol.emulated.board_end import BoardEnd
from tools.check.emulated_board import missing

pytestmark = [
    pytest.mark.long,
    pytest.mark.hil,
    pytest.mark.timeout(300),
    pytest.mark.skipif(bool(missing()), reason=missing() or "all there"),
]


class TestM3(FirmwareConformance):
    @classmethod
    def create_end(cls, config):
        return BoardEnd("m3")


class TestM4F(FirmwareConformance):
    @classmethod
    def create_end(cls, config):
        return BoardEnd("m4f")


class TestAuthenticatedM3(FirmwareConformance):
    key = bytes(range(16))

    @classmethod
    def create_end(cls, config):
        return BoardEnd("m3", key=cls.key)


class TestAuthenticatedM4F(FirmwareConformance):
    key = bytes(range(16))

    @classmethod
    def create_end(cls, config):
        return BoardEnd("m4f", key=cls.key)


class TestSlcanM4F(FirmwareConformance):
    @classmethod
    def create_end(cls, config):
        return BoardEnd("m4f", slcan=True)
