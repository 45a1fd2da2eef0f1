import itertools
import json
from contextlib import closing
from types import SimpleNamespace

import numpy as np
import pytest
from msgspec.structs import replace

from disco_hw.adaptation.guard import NAMES
from disco_hw.daemon.page_feed import ViewerFeed, feed_path
from disco_hw.drive.coverage import Coverage
from disco_hw.log import records
from disco_hw.runtime.robot_setup import requested_task
from disco_hw.tasks.circle import CircleTask
from disco_hw.viewer.operator_controls import Desk
from disco_hw.viewer.pages import KEEP_S, LivePage, _Due
from disco_hw.viewer.panel import live_summary
from disco_hw.viewer.recording import stage_of_robot
from disco_hw.viewer.scene import DARK
from disco_hw.viewer.server import serving
from tests.drivers.waiting import wait_until
from tests.runtime.path_robot import path_robot
from tools.viewer_run import PERIOD_NS, ROBOT_FILE, START_NS, pose_at, tick_records


@pytest.fixture
def live(tmp_path):
    socket = tmp_path / "control.sock"
    with (
        serving("test", port=0) as served,
        closing(Desk(socket, ROBOT_FILE)) as desk,
        closing(LivePage(served.server, stage_of_robot(ROBOT_FILE), socket, desk)) as page,
    ):
        yield page


def ticks(first, last):
    made = [tick_records(number) for number in range(first, last)]
    return [(now_ns, record) for now_ns, got in made for record in got]


def test_the_newest_instant_is_drawn(live):
    live.ingest(ticks(0, 51))
    live.draw(everything=True)
    assert tuple(live.scene._robot.position[:2]) == pytest.approx(pose_at(50)[:2])
    assert live.scene._lines["plan"].visible
    assert live.scene._lines["trail"].points[0, 0, :2] == pytest.approx(pose_at(0)[:2])
    assert live.scene._lines["trail"].points[-1, 1, :2] == pytest.approx(pose_at(50)[:2])
    assert "24.5 V" in live._column.state.content
    assert "armed on request" in live._column.events.content


def test_before_anything_is_known_it_says_so(live):
    live.draw(everything=True)
    assert "| page is behind | — ms" in live._column.details.content
    assert not live.scene._robot.visible


def test_a_drive_by_hand_shows_what_is_excited_and_what_is_missing(live):
    live.draw(everything=True)
    assert not live._column.motions.visible
    coverage = Coverage(6.4)
    for tick in range(251):
        coverage.add(tick * PERIOD_NS, 2.0, 2.0)
    live._desk = SimpleNamespace(draft=None, status={"ok": False, "drive": {"coverage": coverage.as_dict()}})
    live.draw(everything=True)
    assert live._column.motions.visible
    assert live._column.coverage.content.startswith("**16 of 17 still missing**")
    assert "○ reverse fast | 0 of 2 s" in live._column.coverage.content
    assert "✔ straight slow | 3 of 3 s" in live._column.coverage.content


def test_records_come_over_the_feed(live, tmp_path):
    numbers = itertools.count()
    with closing(ViewerFeed(feed_path(tmp_path / "control.sock"))) as feed:

        def has_arrived():
            feed.put(*tick_records(next(numbers)))
            live.ingest(live._subscriber.receive(0.01))
            return live.timeline.last_ns is not None

        wait_until(has_arrived, 60.0)


def test_a_page_that_stays_open_does_not_grow(live):
    count = round(KEEP_S * 50)
    estimate = next(record for _, record in ticks(0, 1) if isinstance(record, records.Estimate))
    for number in range(0, 3 * count, 500):
        live.ingest([(START_NS + tick * PERIOD_NS, estimate) for tick in range(number, number + 500)])
    assert count <= len(live.timeline.estimate) <= 2 * count + 500


def status_with(**task):
    requested = {"kind": "circle", "center_x_m": 0.0, "center_y_m": 0.0, "radius_m": 0.75, "speed_m_s": 0.2} | task
    return {"ok": False} if task == {"none": True} else {"ok": True, "task": {"asked": requested}}


def test_a_task_that_was_changed_before_the_page_was_opened_is_taken_over(live):
    live.ingest(ticks(0, 51))
    live._learn_task(status_with(none=True))
    live._learn_task(status_with())
    assert not len(live.timeline.tasks)
    live._learn_task(status_with(radius_m=0.5))
    assert live._stage.task_at(live._snapshot().task) == CircleTask(radius_m=0.5)


def adapted(now_ns, radius_m=0.061):
    covariance = tuple(value for row in np.diag([1e-6, 1e-8, 1e-6]) for value in row)
    return records.BeliefChange(now_ns, "adapted", NAMES, (0.24, radius_m, 0.41), covariance)


def status_of(change):
    mean = dict(zip(NAMES, change.mean, strict=True))
    adaptation = {"belief": "adapted", "mean": mean, "covariance": change.covariance}
    return json.loads(json.dumps({"ok": True, "adaptation": adaptation}))


def test_a_belief_from_before_the_page_was_opened_is_taken_over(live):
    live.ingest(ticks(0, 51))
    change = adapted(START_NS)
    live._learn_belief(status_of(change))
    in_force = live._snapshot().belief
    assert (in_force.names, in_force.mean, in_force.covariance) == (change.names, change.mean, change.covariance)
    live.ingest(ticks(51, 200))
    live._learn_belief(status_of(change))
    assert len(live.timeline.beliefs) == 1
    live._learn_belief(status_of(adapted(START_NS, 0.062)))
    assert live._snapshot().belief.mean[1] == 0.062


def test_a_belief_of_a_daemon_that_has_gone_is_not_the_next_ones(live):
    live.ingest(ticks(0, 2))
    change, outcome = adapted(START_NS), records.Adaptation(START_NS, "a", "")
    live.ingest([(live.timeline.last_ns, record) for record in (change, outcome)])
    live._learn_belief({"ok": True, "adaptation": None})
    # So soon after it the status may be the older one.
    assert live._snapshot().belief.source == "adapted"
    live.ingest(ticks(2, 200))
    live._learn_belief({"ok": True, "adaptation": None})
    assert live._snapshot().belief.source == "model"
    assert live._snapshot().adaptation is None


def test_a_status_that_says_nothing_of_adaptation_leaves_the_models_belief(live):
    live.ingest(ticks(0, 51))
    live._learn_belief({"ok": True})
    assert live._snapshot().belief is None or live._snapshot().belief.source == "model"
    assert live._snapshot().adaptation is None


def test_a_task_on_the_feed_is_newer_than_a_status_from_before_it(live):
    live.ingest(ticks(0, 51))
    now_ns, settings = live.timeline.last_ns, {"center_x_m": 1.0, "center_y_m": 0.0, "radius_m": 0.5, "speed_m_s": 0.1}
    live.ingest([(now_ns, records.Task(now_ns, "circle", settings))])
    live._learn_task(status_with(radius_m=0.75))
    assert live._snapshot().task.settings["radius_m"] == 0.5
    live.ingest(ticks(51, 200))
    live._learn_task(status_with(radius_m=0.75))
    assert live._snapshot().task.settings["radius_m"] == 0.75


def test_what_is_due_is_due_once_a_period():
    due = _Due(0.5)
    assert [due(t) for t in (10.0, 10.2, 10.5, 10.6, 12.0, 12.1)] == [True, False, True, False, True, False]


def test_a_path_that_is_not_the_daemons_is_not_drawn_and_told(tmp_path):
    stage = stage_of_robot(path_robot(tmp_path))
    status = {"ok": True, "task": {"asked": requested_task(replace(stage.task, speed_m_s=0.1))}}
    other = replace(stage.task, points=stage.task.points[:-1])
    with serving("test", port=0) as served, closing(Desk(tmp_path / "control.sock", ROBOT_FILE)) as desk:
        live = LivePage(served.server, stage, tmp_path / "control.sock", desk)
        live.ingest(ticks(0, 51))
        live._learn_task(status)
        assert live._stage.task_at(live._snapshot().task).speed_m_s == 0.1
        assert live.scene.knows_task
        live._learn_task({"ok": True, "task": {"asked": requested_task(other)}})
        live.scene.show(live._snapshot())
        assert not live.scene._task.visible
        assert "TASK NOT DRAWN" in live_summary(None, None, live.scene.knows_task)
        live.close()


EDITED = {"center_x_m": 1.0, "center_y_m": -0.5, "radius_m": 2.0, "speed_m_s": 0.2}


def test_a_task_that_is_edited_is_drawn_and_can_be_pulled_within_its_limits(live):
    live._desk.status = {"ok": False}
    live._desk.draft = dict(EDITED)
    live.draw(everything=True)
    balls = live.editor.balls
    assert all(ball.visible for ball in balls.values())
    assert tuple(balls["rim"].position) == (3.0, -0.5, 0.0)
    live._desk.status = {"ok": True, "task": {"limits": {name: [-5.0, 50.0] for name in EDITED}}}
    live.editor.pull("middle", (0.504, 0.5))
    assert live._desk.draft == {**EDITED, "center_x_m": 0.5, "center_y_m": 0.5}
    live.editor.pull("rim", (-8.0, -0.5))
    assert live._desk.draft["radius_m"] == 9.0
    live.editor.pull("middle", (-99.0, 0.0))
    assert live._desk.draft["center_x_m"] == -5.0
    live._desk.draft = None
    live._desk.status = {"ok": False}
    live.draw(everything=True)
    assert not any(ball.visible for ball in balls.values())


def test_of_a_task_without_a_place_nothing_is_drawn_to_pull(live):
    live._desk.status, live._desk.draft = {"ok": False}, {"speed_m_s": 0.3}
    live.draw(everything=True)
    assert not any(ball.visible for ball in live.editor.balls.values())


def test_the_desk_is_as_dark_as_the_scene(live):
    live.scene.background = DARK
    live._shade()
    assert live._desk.dark
