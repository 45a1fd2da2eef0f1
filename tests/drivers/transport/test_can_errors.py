import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.transport.can_errors import decode_error_frame


@pytest.mark.parametrize(
    ("error_class", "data", "words"),
    [
        (0x0A8, "0000001900000000", "no acknowledgement"),
        (0x08C, "0002090800000000", "protocol violation"),
        (0x204, "0004000000006064", "receive errors at warning"),
        (0x204, "0010000000008087", "receive errors at passive"),
        (0x040, "0000000000000000", "bus-off"),
        (0x001, "", "transmit timeout"),
    ],
)
def test_frames_as_the_kernel_makes_them(error_class, data, words):
    error = decode_error_frame(error_class, bytes.fromhex(data))
    assert words in error.text
    assert error.harmful
    assert error.bus_off == (error_class == 0x040)


def test_error_counters():
    error = decode_error_frame(0x204, bytes.fromhex("0004000000006064"))
    assert (error.tx_error_count, error.rx_error_count) == (0x60, 0x64)
    assert decode_error_frame(0x04, bytes(8)).tx_error_count is None


def test_recovery_is_no_error():
    restarted = decode_error_frame(0x100, bytes(8))
    assert not restarted.harmful
    assert "restarted" in restarted.text
    active = decode_error_frame(0x204, bytes.fromhex("0040000000000000"))
    assert not active.harmful


def test_overflow_in_the_controller_means_lost_frames():
    assert decode_error_frame(0x04, b"\x00\x01").receive_overflow
    assert not decode_error_frame(0x04, b"\x00\x02").receive_overflow


@given(st.integers(0, 0x1FFFFFFF), st.binary(max_size=64))
def test_anything_is_understood_somehow(error_class, data):
    assert decode_error_frame(error_class, data).text
