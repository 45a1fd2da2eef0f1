"""The reference driver under whatever may come over the wire, and whatever its user asks of it."""

import random
import tracemalloc

import pytest
from hypothesis import strategies as st

from drivers.types import DriverState, Frame, ReceivedFrame, Request, WheelCommand
from firmware_protocol import protection
from firmware_protocol.codec import PROTOCOL
from firmware_protocol.serial_framing import FrameDecoder, encode_frame
from tests.drivers.motor.bench import MS, START_NS
from tests.drivers.motor.reference_robot import CODEC, create_driver
from tests.tables import examples


def protected(can_id, payload):
    """A frame with a right checksum and any content."""
    (layout,) = [layout for layout in PROTOCOL.messages if layout.can_id == can_id]
    if layout.data_id is None:
        return Frame(can_id, payload[:1])
    body = payload[1:]
    return Frame(can_id, bytes((protection.crc8(body, layout.data_id),)) + body)


CAN_IDS = [layout.can_id for layout in PROTOCOL.messages]
ANY_FRAME = st.builds(Frame, st.integers(0, 0x7FF), st.binary(max_size=64))
PROTECTED_FRAME = st.builds(protected, st.sampled_from(CAN_IDS), st.binary(min_size=8, max_size=8))
ACTION = st.one_of(
    st.tuples(st.just("receive"), st.lists(st.one_of(ANY_FRAME, PROTECTED_FRAME), max_size=10)),
    st.tuples(st.just("request"), st.sampled_from(Request)),
    st.tuples(st.just("transmit"), st.sampled_from([None, WheelCommand(1.0, -1.0, 0.1)])),
    st.tuples(st.just("link"), st.booleans()),
    st.tuples(st.just("wait"), st.integers(0, 5_000 * MS)),
)


KEY = bytes(range(16))


@examples(quick=80, every=300, actions=st.lists(ACTION, max_size=60), key=st.sampled_from([None, KEY]))
def test_whatever_comes_nothing_is_raised_and_nothing_moves_unless_armed(actions, key):
    driver = create_driver(key)
    now_ns = START_NS
    driver.link_up(now_ns)
    for action, value in actions:
        match action:
            case "receive":
                driver.receive(now_ns, [ReceivedFrame(now_ns, frame) for frame in value])
            case "request":
                driver.request(value)
            case "transmit":
                moving = driver.state is DriverState.ARMED
                for outgoing in driver.transmit(now_ns, value):
                    decoded = CODEC.decode(outgoing.frame.can_id, outgoing.frame.data)
                    if decoded.name == "WHEEL_COMMAND" and decoded.values["left_speed"]:
                        assert moving
            case "link":
                (driver.link_up if value else driver.link_down)(now_ns)
            case "wait":
                now_ns += value
        assert driver.detail
        assert driver.state in DriverState
        assert driver.stats.frames_accepted >= 0


def feed_hostile_frames(driver, decoder, generator, count):
    """Feed frames, two in three protected, as a line delivers them: some damaged, some beside noise."""
    for number in range(count):
        can_id, data = generator.choice(CAN_IDS), generator.randbytes(8)
        frame = protected(can_id, data) if generator.random() < 0.67 else Frame(can_id, data)
        line = bytearray(encode_frame(frame.can_id, frame.data)) + generator.randbytes(generator.choice((0, 0, 0, 30)))
        if generator.random() < 0.3:
            line[generator.randrange(len(line))] ^= 1 << generator.randrange(8)
        now_ns = START_NS + number * 10 * MS
        driver.receive(now_ns, [ReceivedFrame(now_ns, Frame(*one)) for one in decoder.feed(bytes(line))])
        driver.transmit(now_ns, WheelCommand(1.0, 1.0, 0.1))


@pytest.mark.parametrize("key", [None, pytest.param(KEY, marks=pytest.mark.thorough, id="with a key")])
def test_hostile_frames_are_not_kept(key):
    driver, decoder, generator = create_driver(key), FrameDecoder(), random.Random(1)
    driver.link_up(START_NS)
    feed_hostile_frames(driver, decoder, generator, 500)
    tracemalloc.start()
    try:
        feed_hostile_frames(driver, decoder, generator, 200)
        settled_bytes = tracemalloc.get_traced_memory()[0]
        feed_hostile_frames(driver, decoder, generator, 1000)
        assert tracemalloc.get_traced_memory()[0] - settled_bytes < 32_000
    finally:
        tracemalloc.stop()
