"""The reference driver under whatever may come over the wire, and whatever its user asks of it."""

from hypothesis import strategies as st

from drivers.types import DriverState, Frame, ReceivedFrame, Request, WheelCommand
from firmware_protocol import protection
from firmware_protocol.codec import PROTOCOL
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


@examples(quick=80, every=300, actions=st.lists(ACTION, max_size=60))
def test_whatever_comes_nothing_is_raised_and_nothing_moves_unless_armed(actions):
    driver = create_driver()
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
