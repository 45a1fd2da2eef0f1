import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from disco_hw.runtime.preflight import can_load, serial_load, worst_case_bits
from drivers.motor.reference_protocol import cyclic_frames
from drivers.types import CyclicFrame, NoSettings
from firmware_protocol.serial_framing import encode_frame
from sim.can_protocol import CanFrame, frame_bits

FRAMES = cyclic_frames(NoSettings(), 50.0, False)


def exact_bits(can_id, data):
    return frame_bits(CanFrame(can_id=can_id, data=data))


@given(
    st.integers(0, 0x7FF), st.binary(max_size=8) | st.sampled_from([bytes(8), b"\xff" * 8, b"\x0f" * 8, b"\x3c" * 8])
)
def test_no_frame_takes_more_than_the_worst_case(can_id, data):
    assert exact_bits(can_id, data) <= worst_case_bits(len(data))


def test_the_worst_case_is_the_published_one_and_nearly_reached():
    assert [worst_case_bits(length) for length in range(9)] == [55 + 10 * length for length in range(9)]
    generator = random.Random(1)
    patterns = [bytes(generator.choice((0x78, 0x87, 0xC3, 0x3C, 0x1E, 0xE1)) for _ in range(8)) for _ in range(2000)]
    assert max(exact_bits(0x0F8, data) for data in patterns) >= 120


def test_can_load_is_bits_over_bit_rate():
    frames = [CyclicFrame("A", "HOST", 8, 100.0), CyclicFrame("B", "ROBOT", 0, 10.0)]
    assert can_load(frames, 500_000) == pytest.approx((135 * 100 + 55 * 10) / 500_000)
    assert can_load(FRAMES, 250_000) == pytest.approx(2 * can_load(FRAMES, 500_000))


def test_serial_load_is_that_of_the_busier_direction():
    host, robot = CyclicFrame("A", "HOST", 8, 50.0), CyclicFrame("B", "ROBOT", 8, 300.0)
    assert serial_load([host, robot], 115_200) == pytest.approx(300 * 15 * 10 / 115_200)
    assert serial_load([], 115_200) == 0.0


@given(st.integers(0, 0x7FF), st.binary(max_size=8))
def test_a_frame_takes_as_many_bytes_on_the_serial_line_as_counted(can_id, data):
    load = serial_load([CyclicFrame("A", "HOST", len(data), 1.0)], 1)
    assert len(encode_frame(can_id, data)) * 10 == load
