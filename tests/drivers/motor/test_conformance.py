"""The conformance suite for the reference driver, against the real C firmware core."""

from dataclasses import replace

from tests.drivers.motor.conformance import DriverConformance
from tests.drivers.motor.reference_robot import CONFIG, ReferenceRobot, create_driver


class TestReferenceDriver(DriverConformance):
    frame_ids = range(0x100, 0x162)

    def create_driver(self):
        return create_driver()

    def create_robot(self, first_ticks=(0, 0)):
        return ReferenceRobot(first_ticks=first_ticks)

    def near_the_wrap(self):
        return (2**24 - 300, 300)


class TestAuthenticatedReferenceDriver(TestReferenceDriver):
    """The same with a key on both ends."""

    key = bytes(range(16))

    def create_driver(self):
        return create_driver(self.key)

    def create_robot(self, first_ticks=(0, 0)):
        return ReferenceRobot(replace(CONFIG, key=self.key), first_ticks=first_ticks)
