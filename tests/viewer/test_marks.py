import math

from disco_hw.log import records
from disco_hw.viewer.timeline import ADAPTED, EVENT, FAULT, GATED, OVERRUN, REJECTED_FRAMES, Timeline, marks_of
from tools.viewer_run import FAULT_TICK, GATED_TICK, OVERRUN_TICK, PERIOD_NS, REJECTED_TICK, START_NS


def test_every_kind_is_found_at_its_tick(timeline):
    found = {(mark.kind, (mark.t_ns - START_NS) // PERIOD_NS) for mark in marks_of(timeline)}
    assert found == {
        (EVENT, 10),
        (FAULT, FAULT_TICK),
        (GATED, GATED_TICK),
        (OVERRUN, OVERRUN_TICK),
        (REJECTED_FRAMES, REJECTED_TICK),
    }


def test_marks_are_in_order_and_say_what_happened(timeline):
    marks = marks_of(timeline)
    assert [mark.t_ns for mark in marks] == sorted(mark.t_ns for mark in marks)
    texts = {mark.kind: mark.text for mark in marks}
    assert "OVERCURRENT" in texts[FAULT]
    assert "3.0 times the gate" in texts[GATED]
    assert texts[REJECTED_FRAMES].startswith("3 frames")


def test_what_goes_on_and_on_is_marked_once_in_half_a_second():
    line = Timeline()
    for tick in range(100):
        t_ns = tick * PERIOD_NS
        line.add(t_ns, records.Innovation(t_ns, (9.0,) * 3, (1.0,) * 3, 50.0, False))
    assert [mark.t_ns for mark in marks_of(line)] == [0, 520_000_000, 1_040_000_000, 1_560_000_000]


def test_a_pose_that_is_left_out_because_there_are_many_is_not_marked():
    line = Timeline()
    for t_ns, reason in ((0, "overflow"), (10**9, "too_old")):
        line.add(t_ns, records.Innovation(t_ns, (math.nan,) * 3, (math.nan,) * 3, math.nan, False, reason))
    assert [(mark.t_ns, mark.text) for mark in marks_of(line)] == [(10**9, "a measured pose not used")]


def test_what_adaptation_did_is_marked():
    line = Timeline()
    line.add(10, records.BeliefChange(10, "adapted", reason="the wheels are worn"))
    for t_ns, outcome in ((20, "confirming"), (30, "refused"), (40, "agrees"), (900_000_000, "reverted")):
        line.add(t_ns, records.Adaptation(t_ns, outcome, f"it {outcome}"))
    reported = [(mark.t_ns, mark.kind, mark.text) for mark in marks_of(line)]
    assert reported == [
        (10, ADAPTED, "belief adapted: the wheels are worn"),
        (30, ADAPTED, "it refused"),
        (900_000_000, ADAPTED, "it reverted"),
    ]


def test_an_empty_run_has_none():
    assert marks_of(Timeline()) == ()
