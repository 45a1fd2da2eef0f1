from drivers.frame_pairs import LONGEST_APART_NS, FramePairs
from firmware_protocol.codec import Decoded


def frame(name, counter):
    return Decoded(name, 0, counter, {})


A1, B1, A2, B2 = frame("A", 1), frame("B", 1), frame("A", 2), frame("B", 2)


def test_pairs_by_counter_in_either_order():
    pairs = FramePairs("A")
    assert pairs.add(A1, 0) is None
    assert pairs.add(B1, 1) == (A1, B1)
    assert pairs.add(B2, 2) is None
    assert pairs.add(A2, 3) == (A2, B2)


def test_a_lost_half_costs_its_own_sample_only():
    pairs = FramePairs("A")
    assert pairs.add(A1, 0) is None
    assert pairs.add(A2, 1) is None
    assert pairs.add(B2, 2) == (A2, B2)
    assert pairs.add(B1, 3) is None
    assert pairs.add(A2, 4) is None
    assert pairs.add(B2, 5) == (A2, B2)


def test_the_same_counter_a_lap_later_is_another_sample():
    pairs = FramePairs("A")
    pairs.add(A1, 10**15)
    assert pairs.add(B1, 10**15 + LONGEST_APART_NS + 1) is None
    assert pairs.add(A1, 10**15 + 2 * LONGEST_APART_NS + 1) == (A1, B1)
