"""The conformance suite of the protocol against the C core, in simulated time, with a key and without."""

from dataclasses import replace

import pytest

from tests.drivers.motor.reference_robot import CONFIG, ReferenceRobot
from tests.firmware_protocol.conformance import FirmwareConformance
from tests.firmware_protocol.other_end import SimulatedEnd
from tests.firmware_protocol.protocol_host import ProtocolHost


@pytest.mark.parametrize("skew", [0.001, -0.001])
def test_a_clock_that_runs_away_does_not_conform(skew):
    host = ProtocolHost(SimulatedEnd(ReferenceRobot(skew=skew)))
    host.settle()
    with pytest.raises(AssertionError, match="it needs a crystal"):
        FirmwareConformance().test_the_clock_answers_and_keeps_time(host)


def restarted(config, entropy=None):
    """What a restart makes of a robot: another entropy each time, unless it is given."""
    return lambda now_ns: ReferenceRobot(config, boot_ns=now_ns, entropy=entropy)


def test_a_controller_whose_entropy_repeats_does_not_conform():
    suite = FirmwareConformance()
    for test, expected_message in (
        (suite.test_a_restarted_controller_has_no_session_and_other_challenges, "asked for the same"),
        (suite.test_a_session_recorded_after_one_restart_does_not_arm_after_the_next, "has armed it"),
    ):
        host = ProtocolHost(SimulatedEnd(ReferenceRobot(), restarted(CONFIG, entropy=7)))
        host.settle()
        with pytest.raises(AssertionError, match=f"{expected_message}.*: its entropy repeats"):
            test(host)


def test_a_restart_that_was_none_is_told():
    end = SimulatedEnd(ReferenceRobot())
    end.restart = lambda: None
    host = ProtocolHost(end)
    host.settle()
    host.to_ready()
    with pytest.raises(AssertionError, match=r"was it restarted\?"):
        host.restart()


class TestCore(FirmwareConformance):
    core = CONFIG

    @classmethod
    def create_end(cls, config):
        core = replace(cls.core, key=cls.key or b"")
        return SimulatedEnd(ReferenceRobot(core), restarted(core))


class TestAuthenticatedCore(TestCore):
    key = bytes(range(16))


SLOW = replace(CONFIG, max_wheel_speed_rad_s=1.0, max_wheel_acceleration_rad_s2=0.5)
"""A robot that can go at less than the suite's 1.5 rad/s, and takes its time to."""


@pytest.mark.thorough
class TestSlowCore(TestAuthenticatedCore):
    core = SLOW


def test_a_slow_robot_conforms():
    suite = FirmwareConformance()

    def new_host():
        host = ProtocolHost(SimulatedEnd(ReferenceRobot(SLOW)))
        host.settle()
        return host

    suite.test_armed_it_stands_until_told_and_then_follows(new_host())
    host = new_host()
    suite.test_the_host_can_end_it(host, host.end.slack_s, {"request": "STANDBY"}, "REQUESTED")
