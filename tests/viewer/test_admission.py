"""Tests of who may stay connected before the token was shown, and how often an error is written."""

import logging

from disco_hw.viewer.admission import Admission, RateLimit


class Transport:
    def __init__(self):
        self.aborted = False

    def abort(self):
        self.aborted = True


def test_the_oldest_without_the_token_makes_room_and_who_showed_it_stays():
    admission = Admission(most=3)
    made = [Transport() for _ in range(5)]
    admission.arrive(made[0])
    admission.prove(made[0])
    for transport in made[1:4]:
        admission.arrive(transport)
    assert not admission.is_flooded
    admission.arrive(made[4])
    assert [transport.aborted for transport in made] == [False, True, False, False, False]
    assert admission.is_flooded


def test_one_that_has_left_takes_no_place():
    admission = Admission(most=1)
    first, second = Transport(), Transport()
    admission.arrive(first)
    admission.leave(first)
    admission.arrive(second)
    assert not first.aborted
    assert not second.aborted


def record(created, text="opening handshake failed"):
    made = logging.LogRecord("websockets.server", logging.ERROR, "", 0, text, (), None)
    made.created = created
    return made


def test_a_repeated_error_is_one_line_a_second_with_the_count_of_the_others():
    limit = RateLimit()
    kept = [made for t in range(25) if limit.filter(made := record(100.0 + 0.1 * t))]
    assert [made.getMessage() for made in kept] == [
        "page: opening handshake failed",
        "page: opening handshake failed (9 more like this)",
        "page: opening handshake failed (9 more like this)",
    ]
    assert limit.filter(record(102.45, "another"))
