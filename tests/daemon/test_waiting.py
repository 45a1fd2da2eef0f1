from disco_hw.daemon.process import Waiting
from disco_hw.runtime import State


def said(waiting, state, words, seconds):
    return sum(waiting.should_report(state, words) for _ in range(seconds))


def test_a_missing_robot_is_reported_every_second_and_after_a_minute_every_minute():
    waiting = Waiting()
    assert said(waiting, State.DISCONNECTED, "no link", 60) == 60
    assert said(waiting, State.DISCONNECTED, "no link", 600) == 10
    assert said(waiting, State.HANDSHAKE, "no answer", 20) == 20


def test_a_robot_that_is_there_is_reported_once_for_each_change():
    waiting = Waiting()
    assert said(waiting, State.READY, "ready", 100) == 1
    assert said(waiting, State.ARMED, "armed", 100) == 1
    assert said(waiting, State.READY, "ready", 100) == 1
