"""The pure core: when faults begin and end, and what becomes of frames."""

import pytest

from sim.can_frame import CanFrame
from sim.fault_schedule import parse_schedule
from sim.faults import FaultTimeline, FrameFaults

MS = 1_000_000
FRAME = CanFrame(0x100, bytes(range(8)))


def schedule(*faults):
    return parse_schedule("".join(f"[[fault]]\n{fault}\n" for fault in faults))


def names(faults):
    return [fault.kind.name for fault in faults]


def test_the_timeline_tells_each_beginning_and_end_once():
    timeline = FaultTimeline(
        schedule('kind="drop"\nat_s=0.01\nfor_s=0.02', 'kind="brown_out"\nat_s=0.015', 'kind="unplug"\nat_s=1\nfor_s=1')
    )
    told = []
    for ms in range(0, 50):
        begun, ended = timeline.step(ms * MS)
        told += [(ms, "+", name) for name in names(begun)] + [(ms, "-", name) for name in names(ended)]
        assert names(timeline.active) == (["drop"] if 10 <= ms < 30 else [])
    assert told == [(10, "+", "drop"), (15, "+", "brown_out"), (15, "-", "brown_out"), (30, "-", "drop")]
    assert not timeline.done
    begun, ended = timeline.step(5000 * MS)
    assert (names(begun), names(ended)) == (["unplug"], ["unplug"])
    assert timeline.done


def fates(text, count=400, sender="host", frame=FRAME, seed=1):
    faults = FrameFaults(seed)
    faults.set_active(schedule(text).faults)
    return faults, [faults.fate(k, sender, frame) for k in range(count)]


@pytest.mark.parametrize(
    ("kind", "touched"),
    [
        ("drop", lambda fate: fate.lost_at == ("robot",)),
        ("duplicate", lambda fate: fate.copies == 2),
        ("delay", lambda fate: fate.delay_ns == 50 * MS),
        ("reorder", lambda fate: 0 < fate.delay_ns <= 30 * MS),
        ("flip_before_crc", lambda fate: fate.wire_error_bit is not None),
        ("flip_after_crc", lambda fate: fate.data is not None and one_bit_differs(fate.data)),
        (
            "wrong_length",
            lambda fate: fate.data is not None and len(fate.data) != 8 and FRAME.data.startswith(fate.data),
        ),
    ],
)
def test_each_kind_touches_its_share_of_the_frames(kind, touched):
    faults, found = fates(f'kind="{kind}"\nat_s=0\nfor_s=1\nprobability=0.3')
    count = sum(map(touched, found))
    assert 80 < count < 160
    assert faults.struck == {1: count}
    others = [fate for fate in found if not touched(fate)]
    assert set(others) == {type(found[0])()}


def one_bit_differs(data):
    return sum((a ^ b).bit_count() for a, b in zip(data, FRAME.data, strict=True)) == 1


def test_the_same_seed_strikes_the_same_frames_and_another_others():
    text = 'kind="drop"\nat_s=0\nfor_s=1'
    assert fates(text, seed=1)[1] == fates(text, seed=1)[1]
    assert fates(text, seed=1)[1] != fates(text, seed=2)[1]


@pytest.mark.parametrize(
    ("text", "sender", "struck"),
    [
        ('to="robot"', "host", True),
        ('to="robot"', "client3", True),
        ('to="robot"', "robot", False),
        ('to="host"', "robot", True),
        ('to="host"', "host", False),
        ('to="both"', "robot", True),
        ("id=0x100", "host", True),
        ("id=0x101", "host", False),
    ],
)
def test_direction_and_identifier_choose(text, sender, struck):
    faults, _ = fates(f'kind="drop"\nat_s=0\nfor_s=1\nprobability=1.0\n{text}', count=1, sender=sender)
    assert bool(faults.struck) == struck


def test_one_way_takes_all_of_one_direction():
    _, found = fates('kind="one_way"\nat_s=0\nfor_s=1\nto="host"', sender="robot", count=20)
    assert all(fate.lost for fate in found)
    _, found = fates('kind="one_way"\nat_s=0\nfor_s=1\nto="host"', sender="host", count=20)
    assert not any(fate.lost or fate.lost_at for fate in found)


def test_a_longer_frame_than_its_data_is_padded_to_a_wrong_length():
    _, found = fates('kind="wrong_length"\nat_s=0\nfor_s=1\nprobability=1.0', frame=CanFrame(0x80, b"\x01"))
    assert {len(fate.data) for fate in found} == {0, 2, 3, 4, 5, 6, 7, 8}


def test_an_empty_frame_has_no_bit_to_flip():
    _, found = fates('kind="flip_after_crc"\nat_s=0\nfor_s=1\nprobability=1.0', frame=CanFrame(0x80, b""), count=5)
    assert all(fate.data is None for fate in found)


def test_the_line_breaks_within_the_next_frame_and_only_there():
    faults = FrameFaults(0)
    faults.break_next = True
    first, second = (faults.fate(k, "robot", FRAME) for k in range(2))
    assert first.cut
    assert first.wire_error_bit is not None
    assert faults.broken
    assert second.wire_error_bit is None


def test_a_growing_delay_grows_from_the_first_frame_on():
    faults = FrameFaults(1)
    faults.set_active(schedule('kind="delay"\nat_s=0\nfor_s=9\nprobability=1\ndelay_s=0.05\ngrowth=0.2').faults)
    begin_ns = 70_000 * MS
    found = [faults.fate(begin_ns + ms * MS, "host", FRAME).delay_ns for ms in (0, 100, 1000)]
    assert found == [50 * MS, 70 * MS, 250 * MS]
