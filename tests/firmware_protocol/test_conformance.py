"""The conformance suite of the protocol against the C core, in simulated time, with a key and without."""

from dataclasses import replace

from tests.drivers.reference_robot import CONFIG, ReferenceRobot
from tests.firmware_protocol.conformance import FirmwareConformance
from tests.firmware_protocol.other_end import SimulatedEnd


class TestCore(FirmwareConformance):
    @classmethod
    def make_end(cls, config):
        return SimulatedEnd(ReferenceRobot())


class TestAuthenticatedCore(FirmwareConformance):
    key = bytes(range(16))

    @classmethod
    def make_end(cls, config):
        return SimulatedEnd(ReferenceRobot(replace(CONFIG, key=cls.key)))
