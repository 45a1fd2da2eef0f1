"""The pure core: when faults begin and end, and what becomes of frames."""

import math

import pytest

from firmware_protocol.firmware_core import FirmwareInputs
from sim.can_protocol import CanFrame
from sim.fault_player import FaultTimeline
from sim.fault_schedule import parse_schedule
from sim.injected_faults import FrameFaults, RobotFaults
from sim.sensors import PoseMeasurement


def fault(kind, **values):
    fields = "".join(f'{k} = "{v}"\n' if isinstance(v, str) else f"{k} = {v}\n" for k, v in values.items())
    lasts = "" if kind == "encoder_jump" else "for_s = 1\n"
    return parse_schedule(f'[[fault]]\nkind = "{kind}"\nat_s = 0\n{lasts}{fields}').faults[0]


def inputs(left, right=1000, speed=3.0):
    return FirmwareInputs(
        left_ticks=left, right_ticks=right, left_speed_rad_s=speed, right_speed_rad_s=speed, left_current_a=1.0
    )


def seen(faults, left, setpoints=(3.0, 3.0)):
    return faults.inputs(inputs(left), setpoints, True)


def pose(us, x=1.0):
    return PoseMeasurement(us, us, x, 2.0, 0.5, 0.01, 0.01)


def under(kind, **values):
    """Return the faults of a robot under one fault."""
    faults = RobotFaults()
    faults.set_active([fault(kind, **values)])
    return faults


def test_without_faults_nothing_is_touched():
    faults, given = RobotFaults(), inputs(500)
    assert faults.inputs(given, (3.0, 3.0), True) is given
    poses = [pose(0)]
    assert faults.poses(0, poses) is poses
    assert faults.setpoints(1.0, 2.0, is_driven=True) == (1.0, 2.0)


def test_a_stuck_encoder_loses_what_it_did_not_count():
    faults = under("encoder_stuck", wheel="left")
    assert [seen(faults, ticks).left_ticks for ticks in (100, 200, 300)] == [100, 100, 100]
    assert seen(faults, 300).left_speed_rad_s == 0.0
    assert seen(faults, 300).right_speed_rad_s == 3.0
    faults.set_active([])
    assert [seen(faults, ticks).left_ticks for ticks in (300, 350)] == [100, 150]
    assert seen(faults, 350).left_speed_rad_s == 3.0


def test_a_reversed_encoder_counts_down_without_a_jump_and_up_again():
    faults = under("encoder_reversed", wheel="left")
    assert [seen(faults, ticks).left_ticks for ticks in (100, 110, 130)] == [100, 90, 70]
    assert seen(faults, 130).left_speed_rad_s == -3.0
    faults.set_active([])
    assert [seen(faults, ticks).left_ticks for ticks in (130, 140)] == [70, 80]


def test_a_jump_stays():
    faults = RobotFaults()
    faults.set_active([], [fault("encoder_jump", wheel="right", ticks=5000)])
    for _ in range(2):
        assert (seen(faults, 0).left_ticks, seen(faults, 0).right_ticks) == (0, 6000)


def test_a_short_counter_wraps():
    faults = under("encoder_wrap", wheel="left", bits=8)
    assert [seen(faults, ticks).left_ticks for ticks in (250, 255, 256, 600)] == [250, 255, 0, 88]


def test_a_stalled_motor_does_not_turn_and_draws_current_while_it_is_asked_to():
    faults = under("motor_stall", wheel="left")
    assert faults.setpoints(3.0, 3.0, is_driven=True) == (0.0, 3.0)
    assert seen(faults, 0, (-3.0, 3.0)).left_current_a == -18.0
    assert seen(faults, 0, (0.0, 3.0)).left_current_a == 1.0
    assert faults.inputs(inputs(0), (3.0, 3.0), False).left_current_a == 1.0


def test_a_motor_that_runs_away_stops_when_its_controller_drives_it_no_longer():
    faults = under("motor_runaway", wheel="right", speed_rad_s=12.0)
    assert faults.setpoints(3.0, 3.0, is_driven=True) == (3.0, 12.0)
    assert faults.setpoints(0.0, 0.0, is_driven=False) == (0.0, 0.0)


def test_a_disconnected_encoder_trembles_where_it_stood():
    faults = under("encoder_disconnected", wheel="left")
    counts = [seen(faults, ticks).left_ticks for ticks in range(100, 200)]
    assert max(counts) - min(counts) <= 6 < len(counts)
    assert len(set(counts)) > 1
    assert seen(faults, 200).left_speed_rad_s == 0.0


def test_a_sagging_battery_stops_at_nothing():
    faults = under("battery_sag", drop_v=6.0)
    assert seen(faults, 0).voltage_v == 18.0
    faults.set_active([fault("battery_sag", drop_v=60.0)])
    assert seen(faults, 0).voltage_v == 0.0


@pytest.mark.parametrize(
    ("kind", "values", "expected"),
    [
        ("pose_jump", {"dx_m": 2.0, "dy_m": -1.0, "dyaw_rad": 3.0}, (3.0, 1.0, 3.5 - 2 * math.pi)),
        ("pose_swapped", {}, (2.0, 1.0, 0.5)),
        ("pose_nan", {}, (math.nan, 2.0, math.nan)),
    ],
)
def test_poses_that_are_wrong(kind, values, expected):
    faults = under(kind, **values)
    (found,) = faults.poses(0, [pose(0)])
    assert (found.x_m, found.y_m, found.yaw_rad) == pytest.approx(expected, nan_ok=True)
    assert found.sample_us == 0


def test_a_frozen_sensor_repeats_the_last_pose_under_new_stamps():
    faults = RobotFaults()
    faults.poses(0, [pose(0, 1.0)])
    faults.set_active([fault("pose_frozen")])
    (found,) = faults.poses(40, [pose(40, 1.5)])
    assert (found.x_m, found.sample_us) == (1.0, 40)


def test_late_poses_keep_their_stamps_and_their_order_and_none_is_lost():
    faults = under("pose_late", delay_s=0.1)
    assert faults.poses(0, [pose(0)]) == []
    assert faults.poses(99_999, [pose(40_000)]) == []
    assert [p.sample_us for p in faults.poses(100_000, [])] == [0]
    faults.set_active([])
    assert [p.sample_us for p in faults.poses(200_000, [pose(200_000)])] == [40_000, 200_000]


def test_a_silent_sensor_says_nothing():
    assert under("pose_silent").poses(0, [pose(0)]) == []


MS = 1_000_000
FRAME = CanFrame(0x100, bytes(range(8)))


def schedule(*faults):
    return parse_schedule("".join(f"[[fault]]\n{fault}\n" for fault in faults))


def names(faults):
    return [fault.kind.name for fault in faults]


def test_the_timeline_reports_each_beginning_and_end_once():
    timeline = FaultTimeline(
        schedule('kind="drop"\nat_s=0.01\nfor_s=0.02', 'kind="brown_out"\nat_s=0.015', 'kind="unplug"\nat_s=1\nfor_s=1')
    )
    reported = []
    for ms in range(0, 50):
        begun, ended = timeline.step(ms * MS)
        reported += [(ms, "+", name) for name in names(begun)] + [(ms, "-", name) for name in names(ended)]
        assert names(timeline.active) == (["drop"] if 10 <= ms < 30 else [])
    assert reported == [(10, "+", "drop"), (15, "+", "brown_out"), (15, "-", "brown_out"), (30, "-", "drop")]
    begun, ended = timeline.step(5000 * MS)
    assert (names(begun), names(ended)) == (["unplug"], ["unplug"])


def outcomes_of(kind, *fields, count=400, sender="host", frame=FRAME, seed=1):
    faults = FrameFaults(seed)
    faults.set_active(schedule("\n".join((f'kind="{kind}"\nat_s=0\nfor_s=1', *fields))).faults)
    return faults, [faults.outcome(k, sender, frame) for k in range(count)]


@pytest.mark.parametrize(
    ("kind", "touched"),
    [
        ("drop", lambda outcome: outcome.lost_at == ("robot",)),
        ("duplicate", lambda outcome: outcome.copies == 2),
        ("delay", lambda outcome: outcome.delay_ns == 50 * MS),
        ("reorder", lambda outcome: 0 < outcome.delay_ns <= 30 * MS),
        ("flip_before_crc", lambda outcome: outcome.wire_error_bit is not None),
        ("flip_after_crc", lambda outcome: outcome.data is not None and one_bit_differs(outcome.data)),
        (
            "wrong_length",
            lambda outcome: outcome.data is not None and len(outcome.data) != 8 and FRAME.data.startswith(outcome.data),
        ),
    ],
)
def test_each_kind_touches_its_share_of_the_frames(kind, touched):
    faults, found = outcomes_of(kind, "probability=0.3")
    count = sum(map(touched, found))
    assert 80 < count < 160
    assert faults.struck == {1: count}
    others = [outcome for outcome in found if not touched(outcome)]
    assert set(others) == {type(found[0])()}


def one_bit_differs(data):
    return sum((a ^ b).bit_count() for a, b in zip(data, FRAME.data, strict=True)) == 1


def test_the_same_seed_strikes_the_same_frames_and_another_others():
    first, again, other = (outcomes_of("drop", seed=seed)[1] for seed in (1, 1, 2))
    assert first == again != other


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
    faults, _ = outcomes_of("drop", "probability=1.0", text, count=1, sender=sender)
    assert bool(faults.struck) == struck


def test_one_way_takes_all_of_one_direction():
    to_host, to_robot = (outcomes_of("one_way", 'to="host"', sender=name, count=20)[1] for name in ("robot", "host"))
    assert all(outcome.lost for outcome in to_host)
    assert not any(outcome.lost or outcome.lost_at for outcome in to_robot)


def test_a_longer_frame_than_its_data_is_padded_to_a_wrong_length():
    _, found = outcomes_of("wrong_length", "probability=1.0", frame=CanFrame(0x80, b"\x01"))
    assert {len(outcome.data) for outcome in found} == {0, 2, 3, 4, 5, 6, 7, 8}


def test_an_empty_frame_has_no_bit_to_flip():
    _, found = outcomes_of("flip_after_crc", "probability=1.0", frame=CanFrame(0x80, b""), count=5)
    assert all(outcome.data is None for outcome in found)


def test_the_line_breaks_within_the_next_frame_and_only_there():
    faults = FrameFaults(0)
    faults.break_next = True
    first, second = (faults.outcome(k, "robot", FRAME) for k in range(2))
    assert first.cut
    assert first.wire_error_bit is not None
    assert faults.broken
    assert second.wire_error_bit is None


def test_a_growing_delay_grows_from_the_first_frame_on():
    faults = FrameFaults(1)
    faults.set_active(schedule('kind="delay"\nat_s=0\nfor_s=9\nprobability=1\ndelay_s=0.05\ngrowth=0.2').faults)
    begin_ns = 70_000 * MS
    found = [faults.outcome(begin_ns + ms * MS, "host", FRAME).delay_ns for ms in (0, 100, 1000)]
    assert found == [50 * MS, 70 * MS, 250 * MS]
