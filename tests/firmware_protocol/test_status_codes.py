import pytest

from firmware_protocol import status_codes
from firmware_protocol.codec import PROTOCOL


def table(message, signal):
    (layout,) = [layout for layout in PROTOCOL.messages if layout.name == message]
    (found,) = [found for found in layout.signals if found.name == signal]
    return [name for name in found.choices.values() if name != "NONE"]


@pytest.mark.parametrize(
    ("message", "signal", "describe"),
    [
        ("SYSTEM_STATE", "fault", status_codes.fault),
        ("SYSTEM_STATE", "stop_cause", status_codes.stop_cause),
        ("SYSTEM_STATE", "reject_reason", status_codes.reject_reason),
        ("SYSTEM_STATE", "estop_source", status_codes.estop),
        ("SESSION_STATE", "blockers", status_codes.blocker),
    ],
)
def test_every_code_of_the_dbc_has_a_sentence(message, signal, describe):
    names = table(message, signal)
    assert names
    assert len({describe(name) for name in names}) >= len(names) - 2
    for name in names:
        assert describe(name) not in (name, describe("NO_SUCH_CODE")), name


def test_a_code_of_a_newer_firmware_is_shown_as_it_is():
    assert status_codes.fault("UNKNOWN(12345)") == "UNKNOWN(12345)"
    assert status_codes.stop_cause("UNKNOWN(15)") == "UNKNOWN(15)"
    assert status_codes.reject_reason("NONE") is None
    assert "reset" in status_codes.estop("UNKNOWN(9)")
