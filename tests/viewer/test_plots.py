from dataclasses import replace

import numpy as np
import pytest

from disco_hw.tasks.circle import CircleTask
from disco_hw.viewer.curves import Curves, Plots, _columns
from disco_hw.viewer.server import serving
from disco_hw.viewer.timeline import Timeline


@pytest.fixture
def plots(recording):
    with serving("test", port=0) as page:
        yield Plots(page.server.gui, recording.stage)


def test_rows_in_which_a_value_is_missing_are_left_out():
    t_s, first, second = _columns(
        Curves(np.arange(4.0), {"a": np.array((np.nan, 1.0, 2.0, 3.0)), "b": np.array((0.0, 1.0, np.inf, 3.0))})
    )
    assert t_s.tolist() == first.tolist() == second.tolist() == [1.0, 3.0]


def test_all_curves_are_drawn_up_to_the_instant(plots, timeline):
    plots.show(timeline, timeline.last_ns, CircleTask(), None)
    assert len(plots._plots) == 7
    for handle, _ in plots._plots:
        assert handle.data[0][-1] >= 3.9, handle.title
        assert len({len(column) for column in handle.data}) == 1


def test_the_reference_of_a_robot_that_drives_backwards_is_as_negative_as_its_speed(recording, timeline):
    stage = replace(recording.stage, drives_backwards=True)
    with serving("test", port=0) as page:
        plots = Plots(page.server.gui, stage)
        plots.show(timeline, timeline.last_ns, CircleTask(speed_m_s=0.3), None)
        references = [handle.data[2] for handle, _ in plots._plots if handle.title == "Speed (m/s)"]
    assert [set(reference.tolist()) for reference in references] == [{-0.3}]


def test_nothing_known_leaves_the_plots_as_they_are(plots):
    before = [handle.data for handle, _ in plots._plots]
    plots.show(Timeline(), 10, CircleTask(), None)
    assert all(np.array_equal(a, b) for a, b in zip(before, (handle.data for handle, _ in plots._plots), strict=True))


def test_noise_below_a_centimetre_does_not_fill_a_plot_about_zero(plots):
    ranges = {handle.title: (handle.scales or {}).get("y", {}).get("range") for handle, _ in plots._plots}
    about_zero = {"Distance to the circle (m)", "x (m)", "y (m)", "yaw (rad)"}
    assert {title for title, found in ranges.items() if found} == about_zero
    for title in about_zero:
        assert ranges[title]["min"] == {"pad": 0.1, "soft": -0.01, "mode": 1}
        assert ranges[title]["max"] == {"pad": 0.1, "soft": 0.01, "mode": 1}
