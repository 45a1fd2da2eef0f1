import math
from dataclasses import asdict

from disco_hw.estimation.pose_sources import PoseSources, Standing
from disco_hw.log import records
from disco_hw.log.recorder import RecorderStats
from disco_hw.tasks.circle import CircleTask
from disco_hw.viewer.panel import (
    coverage_text,
    escaped,
    events_text,
    health_rows,
    live_details,
    live_summary,
    number,
    replay_details,
    replay_text,
)
from disco_hw.viewer.recording import snapshot_at
from disco_hw.viewer.timeline import Timeline
from drivers.types import RobotStatus
from firmware_protocol.status_codes import advice
from tools.viewer_run import PERIOD_NS, START_NS, plan_at

RECORDED = RecorderStats(ticks=90, dropped_ticks=10, delivered_ticks=80, waiting_ticks=7, lost_ticks=3, path="run.mcap")
STATUS = {
    "ok": True, "state": "ARMED", "detail": "running the task", "running": True, "estop": False, "link": "up",
    "link_error": None, "robot_state": "ARMED", "fault": "NONE", "stop_cause": "NONE",
    "task": {"laps": 1.5, "distance_m": 0.012, "progress": ["laps", "1.50"]},
    "transport": {"frames_received": 10, "frames_sent": 4, "malformed": 1},
    "driver": {"rejected_crc": 2, "rejected_sequence": 3, "lost_frames": 5}, "recorder": asdict(RECORDED),
    "loop": {"lateness_us": {"p99": 100.4, "max": 900.0}, "overruns": 7, "skipped": 8},
}  # fmt: skip


def shot_at(timeline, tick, plan=None):
    return snapshot_at(timeline, START_NS + tick * PERIOD_NS, plan)


def test_what_fails_is_in_the_summary():
    assert "FAILS" not in live_summary(STATUS, None)
    failing = STATUS | {"recorder": STATUS["recorder"] | {"fault": "nothing is being recorded: no room"}}
    assert "| RECORDING FAILS | nothing is being recorded: no room |" in live_summary(failing, None)


def test_of_several_pose_sources_the_details_say_how_each_does():
    status = PoseSources(("natnet", "nmea"), 0.5, 1.0)
    status.all[0].came_ns, status.all[0].standing, status.all[0].outliers = 1_000_000_000, Standing.GOOD, 3
    text = live_details({**STATUS, "poses": status.status(1_020_000_000)}, None, 0, None)
    assert "| poses 1 | natnet: good, the last 0.02 s ago, 3 outliers |" in text
    assert "| poses 2 | nmea: waiting, none received, 0 outliers |" in text
    alone = PoseSources(("natnet",), 0.5, 1.0).status(1_020_000_000)
    assert "poses" not in live_details({**STATUS, "poses": alone}, None, 0, None)


def test_the_details_add_up_where_every_tick_has_gone_and_what_went_wrong(timeline):
    text = live_details(STATUS, shot_at(timeline, 50, plan_at(50)), 0, None)
    for row in (
        "| recording | run.mcap: 80 of 100 ticks, 7 waiting, 10 dropped, 3 lost with a deleted file |",
        "| rejected, lost | 6, 5 |",
        "| loop late p99, max | 100, 900 us |",
        "| overruns, skipped | 7, 8 |",
        "| bus errors | 0 sent, 0 received, 0 bus-off |",
        "rad/s (plan)",
    ):
        assert row in text
    assert "battery" not in text
    assert "| page is behind | 12 ms, 3 batches missed |" in live_details(None, None, 3, 12.4)


def test_what_matters_comes_first_in_metres_and_the_counters_after_it(timeline):
    text = live_summary(STATUS, shot_at(timeline, 50, plan_at(50)))
    rows = [line.split("|")[1].strip() for line in text.splitlines()[2:]]
    assert rows == ["laps", "distance", "speed", "battery", "loop"]
    assert "| distance | 0.012 m |" in text
    assert "| battery | 24.5 V, 1.0 A, 30 °C |" in text
    assert "| loop | 100 us late (99 %), 7 overruns |" in text
    single_overrun = {**STATUS, "loop": {**STATUS["loop"], "overruns": 1}}
    assert "| loop | 100 us late (99 %), 1 overrun |" in live_summary(single_overrun, None)


def test_a_replay_shows_the_same_motion_and_the_distance(timeline):
    shot = shot_at(timeline, 70)
    text = replay_text(shot, START_NS, CircleTask(radius_m=0.5))
    assert text.startswith("### ARMED")
    assert "| time | 1.400 s |" in text
    assert "| distance | 0.250 m |" in text
    assert "bus errors" not in text
    assert "bus errors" in replay_details(shot)
    assert "Overcurrent" in text


def test_a_fault_is_told_in_words_with_what_to_do():
    line = Timeline()
    line.add(5, RobotStatus(5, "FAULT", 0, "STALL_LEFT", "FAULT", "NONE", 1, 0, "NONE"))
    text = replay_text(snapshot_at(line, 5, None), 5, CircleTask())
    assert "Stall left" in text
    assert advice("STALL_LEFT")[1:] in text.replace("\\", "")


def test_what_is_in_force_of_adaptation_is_told():
    line = Timeline()
    line.add(5, records.BeliefChange(5, "adapted", reason="worn"))
    line.add(6, records.Adaptation(6, "agrees", "nothing new"))
    rows = dict(health_rows(snapshot_at(line, 7, None)))
    assert rows["belief"] == "adapted"
    assert rows["adaptation"] == "nothing new"


def test_what_is_missing_of_the_excitation_comes_first():
    items = [
        {"name": "rest", "found": 9.0, "wanted": 5.0, "unit": "s", "covered": True},
        {"name": "hard start", "found": 1.0, "wanted": 6.0, "unit": "times", "covered": False},
    ]
    text = coverage_text(items)
    assert text.startswith("**1 of 2 still missing**")
    assert text.index("○ hard start | 1 of 6 times") < text.index("✔ rest | 5 of 5 s")
    assert "nothing is missing" in coverage_text(items[:1])


def test_an_empty_instant_can_be_shown():
    shot = snapshot_at(Timeline(), 5, None)
    assert "state not recorded" in replay_text(shot, 5, CircleTask())
    assert "—" in replay_text(shot, 5, CircleTask())
    assert events_text(None, None) == events_text(shot, 5) == "nothing yet"


def test_events_are_listed_newest_first(timeline):
    text = events_text(shot_at(timeline, 50), START_NS)
    assert "0.20 s" in text
    assert "armed on request" in text


def test_text_from_elsewhere_is_no_markup():
    hostile = "<img src=x onerror=alert(1)>\n# [a](javascript:b) `c` | d"
    text = escaped(hostile)
    assert "<" not in text
    assert "\n" not in text
    for letter in "[`|#":
        assert text.replace(f"\\{letter}", "").count(letter) == 0


def test_numbers_that_are_none_become_a_dash():
    assert number(None, 2) == number(math.nan, 2) == number(math.inf, 2) == "—"
    assert number(1.005, 1) == "1.0"


def test_of_a_path_the_panel_tells_the_progress_and_the_side():
    task = {"laps": 0.25, "distance_m": -0.012, "progress": ["progress", "2.00 of 8.00 m (25%)"]}
    text = live_summary({**STATUS, "task": task}, None)
    assert "| progress | 2.00 of 8.00 m (25%) |" in text
    assert "| distance | -0.012 m |" in text
    assert "| laps | 1.50 |" in live_summary(STATUS, None)
