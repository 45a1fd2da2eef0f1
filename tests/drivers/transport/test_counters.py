import threading

import pytest

from drivers.transport.counters import Counters


def test_nothing_is_lost_between_threads():
    counters = Counters()

    def count():
        for _ in range(2000):
            counters.add(frames_sent=1, malformed=2)

    threads = [threading.Thread(target=count) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert counters.snapshot().frames_sent == 8000
    assert counters.snapshot().malformed == 16000


def test_a_counter_that_does_not_exist_is_a_programming_error():
    with pytest.raises(KeyError):
        Counters().add(frames_lost=1)
