"""The cyclic frames of the reference protocol."""

from drivers.motor.reference_protocol import cyclic_frames
from drivers.types import CyclicFrame, NoSettings


def test_the_protocols_cyclic_frames_are_those_of_the_dbc():
    by_name = {frame.name: frame for frame in cyclic_frames(NoSettings(), 50.0, False)}
    assert by_name["WHEEL_SPEED"] == CyclicFrame("WHEEL_SPEED", "ROBOT", 8, 100.0)
    assert by_name["LIMITS"].rate_hz == 2.0
    assert by_name["WHEEL_COMMAND"] == CyclicFrame("WHEEL_COMMAND", "HOST", 8, 50.0)
    assert {frame.name: frame for frame in cyclic_frames(NoSettings(), 100.0, False)}["WHEEL_COMMAND"].rate_hz == 100.0
    assert "ESTOP" not in by_name
