"""The campaign of fence drives: what is written is not driven again, and the table counts what was driven."""

from __future__ import annotations

import math

import numpy as np
import pytest

from disco_hw.experiments import fence
from disco_hw.experiments.fence import ALONE, CONTENDERS, CORRIDOR, DRIVES, Campaign, FenceOptions, gather_corridors
from disco_hw.experiments.fence_drives import FOOTPRINT, FencedDrive, along_drive, corridor_setup, tight_room
from disco_hw.fence import Circle, Fence
from disco_hw.fence.clearance import Boundaries

FENCE = Fence(keep_in=Circle((0.0, 0.0), 3.0))


class Driver:
    """Replacement of a drive: each ends with a clearance from its generator, and is counted."""

    def __init__(self, lowest_m: float = 0.1) -> None:
        self.driven, self.lowest_m = 0, lowest_m

    def __call__(self, rng: np.random.Generator) -> FencedDrive:
        self.driven += 1
        poses = np.zeros((20, 3))
        return FencedDrive(FENCE, poses, self.lowest_m + float(rng.uniform()), (0.04, 0.06), 2, 1.5)


def campaign(out, **changes) -> Campaign:
    return Campaign(out, FenceOptions(**changes), lambda message: None)


def test_a_campaign_that_was_broken_off_goes_on_and_ends_as_if_it_had_not_been(tmp_path):
    uninterrupted, first, second = Driver(), Driver(), Driver()
    reference = campaign(tmp_path / "once")
    reference.gather("by hand", 5, uninterrupted, 0)
    campaign(tmp_path / "twice").gather("by hand", 2, first, 0)
    with (tmp_path / "twice" / DRIVES).open("ab") as file:
        file.write(b'{"kind": "by hand", "numb')
        file.write(b"\n")
    resumed = campaign(tmp_path / "twice")
    resumed.gather("by hand", 5, second, 0)
    assert (uninterrupted.driven, first.driven, second.driven) == (5, 2, 3)
    assert resumed.result.rows() == reference.result.rows()


@pytest.mark.parametrize("changes", [{"seed": 2}, {"off": 0.1}, {"seconds": 5.0}])
def test_drives_with_other_options_are_driven_anew(tmp_path, changes):
    campaign(tmp_path).gather("by hand", 2, Driver(), 0)
    again = Driver()
    other = campaign(tmp_path, **changes)
    other.gather("by hand", 2, again, 0)
    assert again.driven == 2
    assert other.result.rows()[0]["count"] == 2


def test_the_table_counts_breaches_stops_and_ways(tmp_path, monkeypatch):
    driven = campaign(tmp_path)
    driven.gather("by hand", 3, Driver(), 0)
    driven.gather(f"{ALONE}point model", 4, Driver(-2.0), 1)
    by_hand, alone = driven.result.rows()
    assert (by_hand["count"], by_hand["breaches"], by_hand["stops"]) == (3, 0, 6)
    assert by_hand["left_at_stop_median_m"] == pytest.approx(0.05)
    assert alone["breaches"] == 4
    assert alone["way_median_m"] == 1.5
    assert "guard off: point model" in driven.result.table()
    driven.gather(f"{ALONE}{CORRIDOR}point model", 2, Driver(), 2)
    figures = []
    monkeypatch.setattr(fence, "write_pictures", lambda figure, _path: figures.append(figure))
    driven.result.write_pictures(tmp_path / "fence.png")
    ways = [[line.get_xdata() for line in axis.lines] for axis in figures[0].axes]
    # A room with a way, then the drives of each group and the fence itself.
    assert [len(lines) for lines in ways] == [2, 2, 2, 2]
    np.testing.assert_allclose(
        ways[2][0], np.sort([one.least_m for one in driven.result.drives[f"{ALONE}point model"]])
    )
    assert [len(lines[0]) for lines in ways[1:]] == [3, 4, 2]


@pytest.mark.thorough
def test_its_pictures_are_written(tmp_path):
    driven = campaign(tmp_path)
    driven.gather("by hand", 3, Driver(), 0)
    driven.result.write_pictures(tmp_path / "fence.png")
    assert (tmp_path / "fence.png").stat().st_size > 10_000


def test_from_the_start_of_a_corridor_there_is_more_way_than_its_brakes_need():
    for seed in range(5):
        setup = corridor_setup(np.random.default_rng(seed))
        robot, task, bounds = setup.config.robot, setup.config.task, Boundaries(FOOTPRINT, setup.config.fence)
        braking_m = 0.5 * task.speed_m_s**2 / (robot.wheel_radius_m * robot.max_wheel_acceleration_rad_s2)
        x = np.linspace(0.0, 2.6, 2601)
        clearance = bounds.clearance_m(np.column_stack([x, 0.0 * x, 0.0 * x]))
        end_m = float(x[clearance <= 0.0].min())
        assert 1.5 <= end_m <= 2.502
        assert 0.6 < braking_m < 0.7
        assert task.course().outline_m()[-1, 0] > end_m + 2.0
        assert bounds.clearance_m(np.zeros((1, 3)))[0] == pytest.approx(0.3, abs=0.01)


def test_all_planners_drive_the_same_corridors(tmp_path, monkeypatch):
    seen = []

    def drive(rng, *, contender, setup_of, **more):
        seen.append((contender, setup_of(rng).config.fence, more["learning_s"]))
        return Driver()(rng)

    monkeypatch.setattr(fence, "alone_drive", drive)
    driven = campaign(tmp_path, alone=2)
    gather_corridors(driven, FenceOptions(alone=2))
    assert [one for one, *_ in seen] == [each for each in CONTENDERS.values() for _ in range(2)]
    assert [room for _, room, _ in seen[:2]] * len(CONTENDERS) == [room for _, room, _ in seen]
    assert seen[0][1] != seen[1][1]
    assert {learning_s for *_, learning_s in seen} == {0.0}
    names = [row["drives"] for row in driven.result.rows()]
    assert names[0] == "guard off: corridor, point model"
    assert names[-1] == "guard off: corridor, sigma points, adapting"


def test_in_a_tight_room_the_robot_on_its_line_comes_as_near_as_is_said():
    for seed in range(5):
        fence, task = tight_room(np.random.default_rng(seed), 0.08)
        angles = np.linspace(0.0, 2.0 * np.pi, 4001)
        on_line = np.column_stack(
            [task.radius_m * np.cos(angles), task.radius_m * np.sin(angles), angles + 0.5 * np.pi]
        )
        least = Boundaries(FOOTPRINT, fence).clearance_m(on_line).min()
        assert least == pytest.approx(0.08, abs=1e-4)
        assert math.isfinite(task.speed_m_s)


def test_a_robot_on_a_line_0_15_m_inside_the_fence_is_not_stopped():
    drive = along_drive(np.random.default_rng([21, 2, 0]), 0.15, 5.0)
    assert Boundaries(FOOTPRINT, drive.fence).clearance_m(drive.poses[:1])[0] == pytest.approx(0.15, abs=1e-3)
    assert drive.stops == 0
    assert drive.way_m > 0.8
