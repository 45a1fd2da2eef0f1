"""The conformance suite of the protocol against the C core, in simulated time, with a key and without."""

from dataclasses import replace

import pytest

from tests.drivers.reference_robot import CONFIG, ReferenceRobot
from tests.firmware_protocol.conformance import FirmwareConformance
from tests.firmware_protocol.other_end import SimulatedEnd
from tests.firmware_protocol.protocol_host import ProtocolHost


@pytest.mark.parametrize("skew", [0.001, -0.001])
def test_a_clock_that_runs_away_does_not_conform(skew):
    host = ProtocolHost(SimulatedEnd(ReferenceRobot(skew=skew)))
    host.settle()
    with pytest.raises(AssertionError, match="it needs a crystal"):
        FirmwareConformance().test_the_clock_answers_and_keeps_time(host)


class TestCore(FirmwareConformance):
    @classmethod
    def make_end(cls, config):
        return SimulatedEnd(ReferenceRobot())


class TestAuthenticatedCore(FirmwareConformance):
    key = bytes(range(16))

    @classmethod
    def make_end(cls, config):
        return SimulatedEnd(ReferenceRobot(replace(CONFIG, key=cls.key)))


class TestSlowCore(FirmwareConformance):
    """A robot that can go at less than the suite's 1.5 rad/s, and takes its time to."""

    key = bytes(range(16))

    @classmethod
    def make_end(cls, config):
        slow = replace(CONFIG, key=cls.key, max_wheel_speed_rad_s=1.0, max_wheel_acceleration_rad_s2=0.5)
        return SimulatedEnd(ReferenceRobot(slow))
