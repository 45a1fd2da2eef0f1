import time

import pytest

from disco_hw.viewer.desk import Desk
from disco_hw.viewer.feed import ViewerFeed, feed_path
from disco_hw.viewer.live import KEEP_S, LivePage, _Due
from disco_hw.viewer.server import serving
from disco_hw.viewer.stage import stage_of_robot
from tests.viewer.run import ROBOT_FILE, pose_at, tick_records


@pytest.fixture
def page(tmp_path):
    socket = tmp_path / "control.sock"
    with serving("test", port=0) as served:
        desk = Desk(socket, ROBOT_FILE)
        made = LivePage(served.server, stage_of_robot(ROBOT_FILE), socket, desk)
        yield made, socket
        made.close()
        desk.close()


def ticks(first, last):
    made = [tick_records(number) for number in range(first, last)]
    return [(now_ns, record) for now_ns, got in made for record in got]


def test_the_newest_instant_is_drawn(page):
    live, _ = page
    live.take(ticks(0, 51))
    live.draw(everything=True)
    assert tuple(live.scene._robot.position[:2]) == pytest.approx(pose_at(50)[:2])
    assert live.scene._lines["plan"].visible
    assert live.scene._trail.points.shape == (50, 2, 3)
    assert "24.5 V" in live._details.content
    assert "armed on request" in live._events.content


def test_before_anything_is_known_it_says_so(page):
    live, _ = page
    live.draw(everything=True)
    assert "no daemon" in live._head.content
    assert "not asked yet" in live._head.content
    assert not live.scene._robot.visible


def test_records_come_over_the_feed(page):
    live, socket = page
    feed = ViewerFeed(feed_path(socket))
    deadline, tick = time.monotonic() + 10.0, 0
    while live.timeline.last_ns is None:
        assert time.monotonic() < deadline
        feed.put(*tick_records(tick))
        tick += 1
        live.take(live._subscriber.receive(0.01))
    feed.close()


def test_a_page_that_stays_open_does_not_grow(page):
    live, _ = page
    count = round(KEEP_S * 50)
    for number in range(0, 3 * count, 500):
        live.take([entry for entry in ticks(number, number + 500) if type(entry[1]).__name__ == "Estimate"])
    assert count <= len(live.timeline.estimate) <= 2 * count + 500


def test_what_is_due_is_due_once_a_period():
    due = _Due(0.5)
    assert [due(t) for t in (10.0, 10.2, 10.5, 10.6, 12.0, 12.1)] == [True, False, True, False, True, False]
