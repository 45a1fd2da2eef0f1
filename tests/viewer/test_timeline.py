import numpy as np

from disco_hw.log import records
from disco_hw.viewer.timeline import Items, Series, Timeline
from tools.viewer_run import PERIOD_NS, START_NS, plan_at


def test_series_keeps_rows_in_order_beyond_its_first_size():
    series = Series(("a", "b"))
    for k in range(1000):
        series.append(10 * k, (k, -k))
    times, rows = series.rows(0, 100_000)
    assert len(series) == 1000
    assert times.tolist() == [10 * k for k in range(1000)]
    assert rows[:, 0].tolist() == list(range(1000))
    assert rows[:, 1].tolist() == [-k for k in range(1000)]


def test_series_cuts_with_both_ends_and_finds_the_newest():
    series = Series(("a",))
    for t_ns in (10, 20, 20, 30):
        series.append(t_ns, (len(series),))
    assert series.rows(20, 30)[1].ravel().tolist() == [1.0, 2.0, 3.0]
    assert series.rows(11, 19)[1].size == 0
    assert series.last(9) is None
    assert series.last(20)[1].tolist() == [2.0]
    assert series.last(29)[0] == 20


def test_series_forgets_the_old_and_goes_on():
    series = Series(("a",))
    for k in range(600):
        series.append(k, (k,))
    series.drop_before(100)
    assert len(series) == 600, "not worth the copy yet"
    series.drop_before(590)
    assert series.rows(0, 10_000)[0].tolist() == list(range(590, 600))
    for k in range(600, 2000):
        series.append(k, (k,))
    assert series.rows(0, 10_000)[1].ravel().tolist() == list(range(590, 2000))
    series.drop_before(10_000)
    assert len(series) == 0
    series.append(3000, (1.0,))
    assert series.last(3000)[1].tolist() == [1.0]


def test_items_find_the_newest_and_never_forget_it():
    items = Items()
    assert items.last(5) is None
    items.drop_before(5)
    for t_ns in (10, 20, 30):
        items.append(t_ns, f"at {t_ns}")
    assert items.last(9) is None
    assert items.last(29) == "at 20"
    assert items.latest(29, 5) == [(10, "at 10"), (20, "at 20")]
    assert items.latest(100, 1) == [(30, "at 30")]
    items.drop_before(1000)
    assert list(items) == [(30, "at 30")]


def test_a_whole_run_ends_up_in_its_series(timeline):
    assert (timeline.first_ns, timeline.last_ns) == (START_NS, START_NS + 199 * PERIOD_NS)
    assert [len(series) for series in (timeline.estimate, timeline.wheels, timeline.command, timeline.loop)] == [
        200
    ] * 4
    assert len(timeline.pose) == len(timeline.innovation) == 100
    assert len(timeline.planner) == len(timeline.plans) == 200
    assert [source for _, source in timeline.source] == ["plan"], "kept when it changes"
    assert len(timeline.events) == len(timeline.state) == 1
    assert np.allclose(timeline.estimate.rows(0, START_NS)[1][0, -9:].reshape(3, 3).diagonal(), (1e-4, 4e-4, 1e-3))


def test_plans_are_left_out_where_they_can_be_read_again():
    line = Timeline()
    line.add(7, records.PlanFigures(7, 40.0, 0.3, 1.0, 2.0))
    assert len(line.plans) == 0
    assert line.planner.last(7)[1].tolist() == [40.0, 0.3]
    line.add(8, plan_at(0))
    assert len(line.plans) == 1
    assert len(line.planner) == 2


def test_forgetting_bounds_everything(timeline):
    timeline.drop_before(timeline.last_ns)
    assert len(timeline.estimate) == len(timeline.plans) == 1
    assert isinstance(timeline.plans.last(timeline.last_ns), records.Plan)
