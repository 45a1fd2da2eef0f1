import threading
import time

import pytest

from disco_hw.inference.simulate import LocalWorkers, Tally


def slower_at_first(shared, item):
    time.sleep(0.02 if item == 0 else 0.0)
    return shared * item


def test_results_come_in_the_order_of_the_items():
    assert list(LocalWorkers().map(slower_at_first, 3, range(8))) == [0, 3, 6, 9, 12, 15, 18, 21]


def test_one_piece_is_done_where_it_is_asked_for():
    assert LocalWorkers().call(threading.get_ident) == threading.get_ident()


def test_a_failure_reaches_whoever_asked():
    with pytest.raises(ZeroDivisionError):
        list(LocalWorkers().map(lambda shared, item: shared // item, 1, [1, 0]))


def test_stages_and_shares_are_told_as_simulations_are_counted():
    reports = []
    tally = Tally(10, lambda stage, share: reports.append((stage, share)))
    tally.stage("first")
    tally.add(4)
    tally.stage("second")
    tally.add(8)
    assert reports == [("first", 0.0), ("first", 0.4), ("second", 0.4), ("second", 1.0)]
