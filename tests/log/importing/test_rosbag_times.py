"""Stamps of a bag's topics that stand still, jump or are of another clock: each topic is judged by itself."""

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="pip install 'disco-hw[ros2]'")


from disco_hw.log.importing.rosbag_times import Stamps, timeline
from tests.log.importing.bags import BEGAN_NS, LEFT, RIGHT, read_bag, time_ns
from tests.log.refusals import refused

PERIODS_NS = {"commands": 50_000_000, "wheels": 20_000_000, "poses": 100_000_000}
LATENCY_NS = 4_000_000


def stamped(**changed):
    """Stamps of 20 s; `changed` gives for a topic another stamp of a time (ns since the beginning)."""
    topics = {}
    for name, period_ns in PERIODS_NS.items():
        true_ns = np.arange(0, 20_000_000_000, period_ns)
        stamp_ns = BEGAN_NS + np.asarray(changed.get(name, lambda t_ns: t_ns)(true_ns), dtype=np.int64)
        topics[name] = Stamps(BEGAN_NS + true_ns + LATENCY_NS, stamp_ns)
    return topics


def assert_true(times, names, within_ns=0):
    for name in names:
        true_ns = BEGAN_NS + np.arange(0, 20_000_000_000, PERIODS_NS[name])
        assert np.abs(times.t_ns[name] - true_ns).max() <= within_ns, name


def with_frozen_clock(t_ns):
    return t_ns // 3_000_000_000 * 3_000_000_000


def never_changes(t_ns):
    return np.full(t_ns.size, 5)


def of_another_epoch(t_ns):
    return t_ns + 315_964_800_000_000_000


def from_power_on(t_ns):
    return t_ns - BEGAN_NS + 7_000_000_000


def jumps(t_ns):
    return t_ns + np.where(t_ns > 8_000_000_000, 5_000_000_000, 0)


FAULTS = {
    "stands still": (with_frozen_clock, "stand still while the recording goes on"),
    "never changes": (never_changes, "stand still while the recording goes on"),
    "another epoch": (of_another_epoch, "are of another clock than those of other topics"),
    "from power on": (from_power_on, "are of another clock than those of other topics"),
    "jumps": (jumps, "jump where those of other topics do not"),
}


@pytest.mark.parametrize(("change", "description"), FAULTS.values(), ids=FAULTS)
@pytest.mark.parametrize("topic", PERIODS_NS)
def test_a_topic_whose_stamps_are_wrong_is_dated_by_the_recording_and_no_other(topic, change, description):
    times = timeline(stamped(**{topic: change}))
    assert_true(times, set(PERIODS_NS) - {topic})
    assert_true(times, [topic], within_ns=LATENCY_NS)
    assert not times.breaks_ns.size
    (note,) = times.notes
    assert note.startswith(f"warning: {topic}: its stamps {description}")


@pytest.mark.parametrize("by_ns", [-30_000_000_000, 30_000_000_000, -3_600_000_000_000])
def test_where_all_topics_jump_together_the_clock_was_set(by_ns):
    def set_clock(t_ns):
        return t_ns + np.where(t_ns > 8_000_000_000, by_ns, 0)

    times = timeline(stamped(commands=set_clock, wheels=set_clock, poses=set_clock))
    assert_true(times, PERIODS_NS, within_ns=1_000_000)
    assert times.breaks_ns.size == 1
    (note,) = times.notes
    assert "the clock of the stamps was set" in note


def test_stamps_that_repeat_once_in_a_while_are_believed():
    def repeats(t_ns):
        return np.where(np.arange(t_ns.size) % 100 == 50, t_ns - PERIODS_NS["wheels"], t_ns)

    times = timeline(stamped(wheels=repeats))
    assert times.notes == ()
    assert_true(times, ["commands", "poses"])


@pytest.mark.parametrize("is_sent_again", [True, False])
def test_a_measurement_that_is_sent_again_is_one_measurement_and_a_coarse_stamp_is_replaced(tmp_path, is_sent_again):
    def write(maker, k):
        maker.wheels(k)
        measured = k // 5 * 5
        x_m = 0.0055 * (measured if is_sent_again else k)
        maker.write("/slam/pose", maker.pose_stamped(time_ns(measured), "map", x_m, 0.0, 0.0), time_ns(k))

    drive = read_bag(tmp_path / "b", 500, write)
    assert drive.poses.t_s.size == (100 if is_sent_again else 500)
    np.testing.assert_allclose(drive.poses.x_m, 0.275 * drive.poses.t_s, atol=1e-9)
    assert any("poses: its stamps stand still" in note for note in drive.notes) != is_sent_again


def test_commands_whose_stamp_stands_still_cost_neither_wheels_nor_poses(tmp_path):
    def write(maker, k):
        maker.wheels(k)
        if k % 2 == 0:
            stamp_ns = BEGAN_NS + int(with_frozen_clock(k * 20_000_000))
            maker.write("/cmd_vel", maker.twist_stamped(stamp_ns, 0.27, 0.0), time_ns(k))
        if k % 4 == 0:
            maker.write("/slam/pose", maker.pose_stamped(time_ns(k), "map", 0.0055 * k, 0.0, 0.0), time_ns(k))

    drive = read_bag(tmp_path / "b", 500, write)
    assert (drive.wheels.t_s.size, drive.poses.t_s.size) == (500, 125)
    given = np.isfinite(drive.commands.left_rad_s)
    np.testing.assert_allclose(np.diff(drive.commands.t_s[given]), 0.04, atol=1e-6)
    assert drive.segments == 1
    assert any(note.startswith("warning: commands: its stamps stand still") for note in drive.notes)


def test_a_topic_of_which_over_half_of_the_messages_share_a_time_is_refused(tmp_path):
    def write(maker, k):
        maker.wheels(k, stamp_ns=time_ns(k // 4), log_ns=time_ns(k // 4) + k % 4)

    with refused(r"wheels: 300 of 400 messages have the time of another"):
        read_bag(tmp_path / "b", 400, write)


@pytest.mark.parametrize(("span", "start"), [(3.0, 0.0), (65.536, 0.0), (10.0, 4.0)])
def test_positions_of_one_wheel_that_wrap_are_made_continuous(tmp_path, span, start):
    def write(maker, k):
        angles = [0.2 * k, (start + 0.21 * k) % span]
        maker.write("/joint_states", maker.joints(time_ns(k), (LEFT[0], RIGHT[0]), angles, []), time_ns(k))

    drive = read_bag(tmp_path / "b", 1000, write)
    rolled = drive.wheels.right_angle_rad - drive.wheels.right_angle_rad[0]
    np.testing.assert_allclose(rolled, 0.21 * np.arange(1000), rtol=5e-3, atol=1e-6)
    np.testing.assert_allclose(drive.wheels.left_angle_rad, 0.2 * np.arange(1000))
    assert any(": right wheel wraps at " in note for note in drive.notes)
    assert drive.segments == 1
