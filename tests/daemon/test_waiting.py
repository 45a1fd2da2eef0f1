from disco_hw.daemon.process import Waiting
from disco_hw.runtime import State


def count_reports(waiting, state, text, seconds):
    return sum(waiting.should_report(state, text) for _ in range(seconds))


def test_a_missing_robot_is_reported_every_second_and_after_a_minute_every_minute():
    waiting = Waiting()
    assert count_reports(waiting, State.DISCONNECTED, "no link", 60) == 60
    assert count_reports(waiting, State.DISCONNECTED, "no link", 600) == 10
    assert count_reports(waiting, State.HANDSHAKE, "no answer", 20) == 20


def test_a_robot_that_is_there_is_reported_once_for_each_change():
    waiting = Waiting()
    assert count_reports(waiting, State.READY, "ready", 100) == 1
    assert count_reports(waiting, State.ARMED, "armed", 100) == 1
    assert count_reports(waiting, State.READY, "ready", 100) == 1
