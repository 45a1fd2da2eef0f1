"""The pieces of the alignment of stamps with the wheels, each against what is computed by hand."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from disco_hw.gap.data import stamp_clock, timing
from disco_hw.gap.data.stamp_clock import StampClock, by_stretch, clock_of, jump_instant
from disco_hw.gap.data.timing import PoseAlignment, pose_clock, pose_delay_s
from disco_hw.gap.settings import GridSettings
from disco_hw.log.drive import Commands, Poses, Wheels
from tests.gap.synthetic import of_regression

SETTINGS = GridSettings()


def poses_at(t_s, segment=0):
    """Poses that tell themselves by their place."""
    t_s = np.asarray(t_s, dtype=float)
    place = np.arange(t_s.size, dtype=float)
    return Poses(t_s, place, 10.0 + place, 0.01 * place, np.full(t_s.size, segment))


def test_a_clock_that_drifts_is_off_by_its_drift_over_the_span_and_by_nothing_in_the_middle():
    clock = StampClock(0.3, middle_s=50.0, span_s=80.0, drift_s=0.16)
    np.testing.assert_allclose(clock.off_s(np.array([10.0, 50.0, 70.0, 90.0])), [-0.08, 0.0, 0.04, 0.08])
    poses = poses_at([10.0, 50.0, 90.0])
    np.testing.assert_allclose(clock.corrected(poses).t_s, [10.08, 50.0, 89.92])
    assert clock.notes("poses'") == (
        "the poses' clock drifts against the wheels' by +2.00 ms every second, +160 ms over the log: "
        "their stamps are corrected; synchronise the clocks",
    )


def test_a_clock_that_jumps_is_off_by_half_of_it_on_either_side_and_poses_that_come_before_others_are_left_out():
    clock = StampClock(0.3, jump_s=0.25, jump_at_s=20.0)
    np.testing.assert_allclose(clock.off_s(np.array([0.0, 19.9, 20.0, 40.0])), [-0.125, -0.125, 0.125, 0.125])
    even = clock.corrected(poses_at([19.7, 19.9, 20.0, 20.1, 20.2, 20.3]))
    # 19.825 and 20.025, then 19.875, 19.975, 20.075 and 20.175.
    np.testing.assert_allclose(even.t_s, [19.825, 20.025, 20.075, 20.175])
    assert even.x_m.tolist() == [0.0, 1.0, 4.0, 5.0]
    assert even.y_m.tolist() == [10.0, 11.0, 14.0, 15.0]
    np.testing.assert_allclose(even.yaw_rad, [0.0, 0.01, 0.04, 0.05])
    assert even.segment.tolist() == [0] * 4
    assert clock.notes("poses'") == (
        "the poses' clock jumps against the wheels' by +250 ms at 20 s: their stamps are corrected; synchronise the "
        "clocks",
    )


def test_an_even_clock_changes_nothing():
    clock = StampClock(0.3)
    poses = poses_at([1.0, 2.0])
    assert (clock.off_s(poses.t_s) == 0.0).all()
    assert (clock.corrected(poses).t_s == poses.t_s).all()
    assert clock.notes("poses'") == ()
    # Two that are stamped alike are one.
    assert clock.corrected(poses_at([1.0, 1.0, 2.0])).x_m.tolist() == [0.0, 2.0]


@dataclass
class Stamped:
    """Samples whose stretches have these delays; the whole log fits better by `gained` nats with any other clock."""

    delays: tuple[float | None, ...]
    gained: float = 1.0
    span: float = 120.0
    middles: tuple[float, ...] | None = None
    misfit_with: Callable[[StampClock], float] | None = None
    stretch_s: float = 12.0
    wrong: Callable[[float, float, float], float] = lambda low_s, high_s, delay_s: 0.0
    asked: list[tuple[float, float]] = field(default_factory=list)

    @property
    def span_s(self):
        return 100.0, 100.0 + self.span

    def fitted(self, clock):
        if clock.even:
            return 0.2, 5.0
        return 0.21, 5.0 - self.gained if self.misfit_with is None else self.misfit_with(clock)

    def part_delay_s(self, low_s, high_s):
        self.asked.append((low_s, high_s))
        return self.delays[len(self.asked) - 1]

    def part_mismatch(self, low_s, high_s, delay_s):
        return self.wrong(low_s, high_s, delay_s)


@pytest.fixture
def seen(monkeypatch):
    """The clock that these delays of stretches show, where the whole log fits better by `gained` nats."""

    def instant(align, sides, about_s):
        made.asked.append((sides, about_s))
        return about_s

    def made(delays, gained=1.0, span_s=120.0, middles=None, misfit_with=None, least_s=0.03, least_nats=0.02, **grid):
        delays = np.array(delays)
        middles = 100.0 + span_s * (np.arange(delays.size) + 0.5) / delays.size if middles is None else middles
        monkeypatch.setattr(stamp_clock, "by_stretch", lambda align: (middles, delays))
        monkeypatch.setattr(stamp_clock, "jump_instant", instant)
        settings = replace(SETTINGS, **({"clock_outlier_s": np.inf} | grid))
        return clock_of(Stamped((), gained, span_s, misfit_with=misfit_with), settings, least_s, least_nats)

    made.asked = []
    return made


def test_delays_on_a_line_are_a_drift_over_the_whole_log(seen):
    assert seen([0.1, 0.2, 0.3, 0.4]) == StampClock(0.21, 160.0, 120.0, drift_s=pytest.approx(0.4))
    assert seen([0.4, 0.3, 0.2, 0.1]).drift_s == pytest.approx(-0.4)


def test_delays_of_two_sizes_are_a_jump_between_two_stretches(seen):
    clock = seen([0.1, 0.1, 0.1, 0.35, 0.3, 0.35])
    assert (clock.delay_s, clock.jump_s, clock.jump_at_s) == (0.21, pytest.approx(0.25), pytest.approx(160.0))
    assert seen.asked == [(pytest.approx((0.1, 0.35)), pytest.approx(160.0))]
    assert clock.drift_s == 0.0
    assert seen([0.3, 0.3, 0.3, 0.1, 0.1, 0.1]).jump_s == pytest.approx(-0.2)
    # Of the early ones there are two at least, and of the late ones.
    assert seen([0.3, 0.3, 0.1, 0.1, 0.1, 0.1]).jump_at_s == pytest.approx(140.0)
    assert seen([0.3, 0.3, 0.3, 0.3, 0.1, 0.1]).jump_at_s == pytest.approx(180.0)
    # One stretch alone is no side of a jump.
    assert seen([0.6, 0.1, 0.1, 0.1, 0.1, 0.1]) == seen([0.3, 0.3, 0.3, 0.3, 0.3, 0.1]) == StampClock(0.2)


@pytest.mark.parametrize(
    ("delays", "after"),
    [([0.26, 0.26, 0.26, 0.36, 0.42, 0.4, 0.42], 3), ([0.26, 0.34, 0.32, 0.26, 0.42, 0.4, 0.36], 4)],
)
def test_a_jump_is_where_it_leaves_the_least_squares_on_both_sides(seen, delays, after):
    assert seen(delays).jump_at_s == pytest.approx(100.0 + 120.0 * after / 7.0)
    assert seen(delays[::-1]).jump_at_s == pytest.approx(100.0 + 120.0 * (7 - after) / 7.0)


def test_a_clock_is_believed_from_four_stretches_on_that_agree_and_where_it_matters(seen):
    plain = StampClock(0.2)
    assert seen([0.1, 0.2, 0.3]) == plain
    assert seen([0.1, 0.2, 0.3, 0.4], gained=0.019) == plain
    assert seen([0.1, 0.2, 0.3, 0.4], gained=0.021) != plain
    # Over the log it drifts by 4/3 of what lies between the first and the last middle: 29 and 31 ms.
    assert seen(0.1 + 0.02175 * np.arange(4) / 3.0) == plain
    assert seen(0.1 + 0.02325 * np.arange(4) / 3.0) != plain
    assert seen([0.1, 0.1, 0.1, 0.129, 0.129, 0.129]) == plain
    assert seen([0.1, 0.1, 0.1, 0.131, 0.131, 0.131]) != plain


@pytest.mark.parametrize(("with_drift", "with_jump"), [(4.0, 4.5), (4.5, 4.0)])
def test_of_a_drift_and_a_jump_the_one_with_which_the_whole_log_fits_better_is_believed(seen, with_drift, with_jump):
    # One stretch that is off makes the others look as if they jumped.
    delays = 1e-3 * np.array([-85.0, -77.0, -59.0, -53.0, -46.0, -38.0, -26.0, -115.0, -24.0, 0.0, 12.0, 23.0, 31.0])
    assert seen(delays).jump_s == pytest.approx(0.0705)

    clock = seen(delays, misfit_with=lambda tried: with_drift if tried.drift_s else with_jump)
    assert (clock.drift_s != 0.0) is (with_drift < with_jump)
    assert (clock.jump_s != 0.0) is (with_jump < with_drift)


@pytest.mark.parametrize("bound", [{"clock_times_better": 5.0}, {"least_s": 0.5}])
def test_a_jump_that_explains_too_little_or_is_too_small_is_none_however_well_the_log_fits_with_it(seen, bound):
    # On a line a step leaves a quarter of the squares, and is half as large.
    delays = 0.05 * np.arange(13)

    def misfit_with(clock):
        return 4.5 if clock.drift_s else 4.0

    assert seen(delays, misfit_with=misfit_with).jump_s > 0.3
    assert seen(delays, misfit_with=misfit_with, **bound).drift_s == pytest.approx(0.65)


def test_stretches_that_lie_in_a_part_of_the_log_alone_say_nothing_of_all_of_it(seen):
    delays = [0.1, 0.2, 0.3, 0.4]
    assert seen(delays, middles=np.array([105.0, 120.0, 135.0, 164.0])) == StampClock(0.2)
    assert seen(delays, middles=np.array([105.0, 120.0, 135.0, 165.0])) != StampClock(0.2)


@pytest.mark.parametrize(("scatter", "believed"), [(0.9, False), (1.1, True)])
def test_it_explains_as_much_again_of_the_scatter_as_it_leaves(seen, scatter, believed):
    centred = np.arange(12) - 5.5
    # Neither a line nor a step, and of as large squares as the line where it counts 1.
    other = np.tile([1.0, -1.0], 6)
    other -= centred * (centred @ other) / (centred @ centred)
    line = 0.05 * centred
    other *= np.linalg.norm(line) / np.linalg.norm(other) / scatter
    clock = seen(0.3 + line + other)
    assert (clock.drift_s != 0.0) is believed


def test_at_its_bounds_a_clock_is_believed_by_its_size_and_its_agreement_and_not_by_its_nats(seen):
    jump = [0.25, 0.25, 0.5, 0.5]
    assert seen(jump, least_s=0.25).jump_s == 0.25
    assert seen(jump, gained=0.5, least_nats=0.5) == StampClock(0.2)
    # Squares of 8 about their mean, and of 4 about those of both sides.
    assert seen([2.0, 0.0, 4.0, 2.0], clock_times_better=2.0).jump_s == 2.0
    assert seen([2.0, 0.0, 4.0, 2.0], clock_times_better=2.1) == StampClock(0.2)


def test_of_no_poses_nothing_is_said():
    wheels = Wheels(*(np.arange(100.0),) * 5, np.zeros(100, dtype=int), True, True)
    assert pose_clock(wheels, poses_at([]), SETTINGS) == StampClock(0.0)
    assert PoseAlignment(wheels, poses_at([]), SETTINGS).span_s == (0.0, 0.0)


@pytest.mark.parametrize("off_s", [-0.4, 0.0, 3.0])
def test_a_stretch_that_is_far_off_counts_no_more_than_one_that_is_less_so(seen, off_s):
    """Wheels that begin a circle slowly look late by more than a clock that jumps afterwards."""
    jumped = seen([off_s, 0.01, 0.0, 0.21, 0.2], clock_outlier_s=0.1)
    assert jumped.jump_s == pytest.approx(0.2, abs=0.01)
    assert jumped.jump_at_s == pytest.approx(172.0)
    assert seen([off_s, 0.01, 0.0, 0.01, -0.02], clock_outlier_s=0.1) == StampClock(0.2)
    drifted = seen([off_s, 0.01, 0.06, 0.11, 0.16, 0.21], clock_outlier_s=0.1)
    assert drifted.drift_s == pytest.approx(0.3, abs=0.1 if off_s == 0.0 else 1e-6)


def test_stretches_of_even_length_are_looked_at_one_by_one():
    stamped = Stamped((0.1, None, 0.3, 0.4), span=49.5)
    middles, delays = by_stretch(stamped)
    # 49.5 s are four stretches of 12 s and a bit, which follow each other up to the last sample.
    assert [low for low, _ in stamped.asked] == pytest.approx(100.0 + 49.5 * np.arange(4) / 4, abs=1e-5)
    assert [low for low, _ in stamped.asked[1:]] == [high for _, high in stamped.asked[:-1]]
    assert stamped.asked[-1][1] > 149.5
    # What shows no delay says nothing.
    assert middles == pytest.approx(100.0 + 49.5 * np.array([0.125, 0.625, 0.875]), abs=1e-5)
    assert delays == pytest.approx([0.1, 0.3, 0.4])
    assert len(by_stretch(Stamped((0.1,), span=5.0))[1]) == 1


@pytest.mark.parametrize(("minutes", "stretches"), [(29, 145), (30, 150), (180, 150)])
def test_stretches_of_a_log_of_hours_are_longer_as_their_cube_is_what_a_line_takes(minutes, stretches):
    stamped = Stamped(900 * (0.1,), span=60.0 * minutes)
    middles, _ = by_stretch(stamped)
    assert len(middles) == len(stamped.asked) == stretches
    # They still reach from the first sample to the last.
    assert (stamped.asked[0][0], stamped.asked[-1][1]) == pytest.approx(stamped.span_s, abs=1e-5)


def test_a_jump_in_a_log_of_hours_is_sought_as_far_as_its_stretches_reach_in_as_many_steps():
    asked = []

    def wrong(low_s, high_s, delay_s):
        asked.append(delay_s)
        return abs(high_s - 5070.0) if low_s == -np.inf else 0.0

    # Stretches of 72 s, which are six times as long.
    assert jump_instant(Stamped((), span=10800.0, wrong=wrong), (0.1, 0.4), 5007.0) == pytest.approx(5070.0, abs=3.0)
    assert asked == 24 * [0.1, 0.4]


def test_poses_of_a_stretch_are_those_stamped_in_it(monkeypatch):
    parts = []
    monkeypatch.setattr(timing, "pose_delay_s", lambda wheels, part, settings: parts.append(part) or 0.1 * len(parts))
    align = PoseAlignment(None, poses_at(np.arange(0.0, 50.0, 0.5)), SETTINGS)
    assert (align.span_s, align.stretch_s) == ((0.0, 49.5), 12.0)
    assert by_stretch(align)[1] == pytest.approx([0.1, 0.2, 0.3, 0.4])
    assert [x for part in parts for x in part.x_m] == align.poses.x_m.tolist()
    monkeypatch.setattr(timing, "pose_delay_s", lambda *_: 0.0)
    assert align.part_delay_s(0.0, 10.0) is None


def test_a_jump_is_where_both_sides_fit_best():
    times = np.arange(0.0, 60.0, 0.25)

    def wrong(low_s, high_s, delay_s):
        # Samples that have another delay than they should, before and after 33 s.
        inside = times[(times >= low_s) & (times < high_s)]
        return float(np.sum(np.where(inside < 33.0, 0.1, 0.4) != delay_s))

    stamped = Stamped((), wrong=wrong)
    assert jump_instant(stamped, (0.1, 0.4), 30.0) == pytest.approx(33.0, abs=0.26)
    assert jump_instant(stamped, (0.1, 0.4), 44.9) == pytest.approx(33.0, abs=0.26)
    # No further than a stretch away.
    assert jump_instant(stamped, (0.1, 0.4), 47.0) == 35.0
    assert jump_instant(stamped, (0.1, 0.4), 19.0) == 30.0
    # Of all before it, from the first on.
    before = Stamped((), wrong=lambda low_s, high_s, delay_s: abs(high_s - 33.0) if low_s == -np.inf else 0.0)
    assert jump_instant(before, (0.1, 0.4), 30.0) == 33.0


@pytest.mark.parametrize("about_s", [0.11, 0.1234, 0.14])
def test_the_least_of_a_misfit_is_found_wherever_the_steps_of_a_scan_lie(about_s):
    def misfits(delays):
        return np.where(delays > 0.15, np.inf, np.abs(delays - 0.1234) + 10.0 * (delays - 0.1234) ** 2 - 3.0)

    delay_s, misfit = timing.lowest(misfits, about_s, 0.02)
    assert delay_s == pytest.approx(0.1234, abs=2e-4)
    assert misfit == pytest.approx(-3.0, abs=1e-3)


def test_commands_and_poses_are_picked_with_all_their_columns():
    chosen = np.array([True, False, True])
    commands = Commands(np.arange(3.0), np.arange(3.0) + 10.0, np.arange(3.0) + 20.0, np.array([0, 0, 1]))
    kept = stamp_clock.picked(commands, chosen)
    assert (kept.t_s.tolist(), kept.left_rad_s.tolist(), kept.right_rad_s.tolist()) == ([0, 2], [10, 12], [20, 22])
    assert kept.segment.tolist() == [0, 1]
    assert StampClock(0.1, jump_s=0.2, jump_at_s=1.5).notes("commands'")[0].startswith("the commands' clock jumps")


@pytest.mark.parametrize(("depth", "found_s"), [(0.051, 0.1234), (0.049, 0.0)])
def test_a_delay_is_told_where_it_stands_out_and_between_those_that_are_tried(monkeypatch, depth, found_s):
    tried = []

    def misfits(wheels, poses, delays, settings):
        tried.append(delays)
        # The least value that the scan tries is at 0.12.
        out = np.minimum(((delays - 0.1234) / 0.02) ** 2 - 0.17**2, 4.0) * 0.25 * depth
        return np.where(delays > 0.95, np.inf, out)

    monkeypatch.setattr(timing, "_mismatches", misfits)
    assert pose_delay_s(None, None, SETTINGS) == pytest.approx(found_s, abs=2e-4)
    assert tried[0] == pytest.approx(np.arange(-50, 51) * 0.02)
    monkeypatch.setattr(timing, "_mismatches", lambda wheels, poses, delays, settings: np.full(delays.size, np.inf))
    assert pose_delay_s(None, None, SETTINGS) == 0.0
    assert timing._mismatch_at(None, None, 0.1, SETTINGS) == 0.0
    # By just enough.
    settings = replace(SETTINGS, least_delay_nats=0.5)
    monkeypatch.setattr(
        timing, "_mismatches", lambda wheels, poses, delays, settings: -0.5 * (np.abs(delays - 0.2) < 0.01)
    )
    assert pose_delay_s(None, None, settings) == pytest.approx(0.2, abs=0.01)


def test_wheels_are_known_from_their_first_to_their_last_sample_of_a_segment():
    t_s = np.array([0.0, 1.0, 2.0, 5.0, 6.0, 9.0])
    wheels = Wheels(t_s, *(np.zeros(6),) * 4, np.array([0, 0, 0, 2, 2, 2]), True, True)
    begin, end = timing._bounds(wheels, np.array([2, 0, 1, 2]))
    assert begin.tolist() == [5.0, 0.0, np.inf, 5.0]
    assert end.tolist() == [9.0, 2.0, -np.inf, 9.0]


def by_hand(wheels, poses, delay_s):
    """Minus the log likelihood per pose of turns and ways, each fitted robustly by those of both wheels."""
    rows, turns, ways = [], [], []
    for k in range(poses.t_s.size):
        later = [j for j in range(k, poses.t_s.size) if poses.t_s[j] > poses.t_s[k] + 0.4 - 1e-6]
        if not later or poses.segment[later[0]] != poses.segment[k] or poses.t_s[later[0]] - poses.t_s[k] > 0.64:
            continue
        own = wheels.t_s[wheels.segment == poses.segment[k]]
        begin_s, end_s = poses.t_s[k] - delay_s, poses.t_s[later[0]] - delay_s
        if not own.size or begin_s < own[0] or end_s > own[-1]:
            continue
        turned = [
            np.interp(end_s, wheels.t_s, angle) - np.interp(begin_s, wheels.t_s, angle)
            for angle in (wheels.left_angle_rad, wheels.right_angle_rad)
        ]
        turn = np.angle(np.exp(1j * (poses.yaw_rad[later[0]] - poses.yaw_rad[k])))
        towards = poses.yaw_rad[k] + 0.5 * turn
        ahead = (poses.x_m[later[0]] - poses.x_m[k], poses.y_m[later[0]] - poses.y_m[k])
        rows.append((turned[1] - turned[0], turned[1] + turned[0]))
        turns.append(turn)
        ways.append(ahead[0] * np.cos(towards) + ahead[1] * np.sin(towards))
    return len(rows), sum(of_regression(np.array(rows), np.array(measured)) for measured in (turns, ways))


def winding(seed=3):
    """A drive in three segments of wheels at 20 Hz and poses at 10 Hz, seen with noise, a silence in between."""
    rng = np.random.default_rng(seed)
    t_s = np.arange(0.0, 40.0, 0.05)
    angle = np.cumsum(rng.normal((3.5, 4.5), 3.0, (t_s.size, 2)), axis=0) * 0.05
    cut = np.searchsorted([13.0, 27.0], t_s, side="right")
    wheels = Wheels(t_s, angle[:, 0], angle[:, 1], *(np.zeros(t_s.size),) * 2, cut, True, True)
    seen = np.arange(0, t_s.size, 2)
    seen = seen[(t_s[seen] < 20.0) | (t_s[seen] > 21.1)]
    yaw = 0.3 * (angle[seen, 1] - angle[seen, 0]) + rng.normal(0.0, 0.02, seen.size)
    way = np.cumsum(rng.normal(0.02, 0.01, (seen.size, 2)), axis=0)
    poses = Poses(t_s[seen], way[:, 0], way[:, 1], np.remainder(yaw + np.pi, 2.0 * np.pi) - np.pi, cut[seen])
    return wheels, poses


@pytest.mark.parametrize("delay_s", [-0.33, 0.0, 0.12])
def test_turns_and_ways_of_poses_are_fitted_by_those_of_the_wheels_at_a_delay(delay_s):
    wheels, poses = winding()
    count, misfit = by_hand(wheels, poses, delay_s)
    assert count > 250
    # Headings go past half a turn.
    assert np.abs(np.diff(poses.yaw_rad)).max() > 6.0
    assert timing._mismatch_at(wheels, poses, delay_s, SETTINGS) == pytest.approx(misfit, rel=1e-9)
    many = timing._mismatches(wheels, poses, np.array([-90.0, delay_s, 90.0]), SETTINGS)
    assert many == pytest.approx([np.inf, misfit, np.inf], rel=1e-9)


@pytest.mark.parametrize(("fewest", "known"), [(0, True), (1, False)])
def test_too_few_pairs_are_not_fitted(fewest, known):
    wheels, poses = winding()
    count, _ = by_hand(wheels, poses, 0.12)
    settings = replace(SETTINGS, fewest_samples=count + fewest)
    assert np.isfinite(timing._mismatches(wheels, poses, np.array([0.12]), settings))[0] == known
    pairs = timing.apart(poses.t_s, poses.segment, 0.4)[0].size
    for more, wanted in ((0, True), (1, False)):
        settings = replace(SETTINGS, fewest_samples=pairs + more)
        unlimited = replace(wheels, t_s=wheels.t_s.copy(), segment=wheels.segment)
        assert np.isfinite(timing._mismatches(unlimited, poses, np.array([0.0]), settings))[0] == wanted
    for few in (0, 1):
        hardly = replace(wheels, **{name: getattr(wheels, name)[:few] for name in wheels.__slots__[:6]})
        assert timing._mismatches(hardly, poses, np.array([0.0]), SETTINGS)[0] == np.inf
        assert timing._mismatches(hardly, poses_at([]), np.array([0.0]), SETTINGS)[0] == np.inf


def test_two_columns_are_solved_as_normal_equations_and_like_columns_as_one():
    rng = np.random.default_rng(4)
    a, b, y = rng.standard_normal((3, 50))
    a *= 2.0
    expected = np.linalg.lstsq(np.column_stack([a, b]), y, rcond=None)[0]
    assert timing.projected(a @ a, a @ b, b @ b, a @ y, b @ y) == pytest.approx(tuple(expected))
    b = 0.5 * a
    assert timing.projected(a @ a, a @ b, b @ b, a @ y, b @ y) == pytest.approx((a @ y / (a @ a), 0.0))
    assert timing.projected(0.0, 0.0, 0.0, 0.0, 0.0) == (0.0, 0.0)
    assert timing.projected(0.5, 0.0, 0.25, 1.0, 0.5) == (2.0, 2.0)
