"""Tests of what a piece's shares make the wheels do."""

import pytest

from disco_hw.drive.script import REST_S, Pieces

PIECES = Pieces(5.0)


@pytest.mark.parametrize(
    ("forward", "turn", "wheels"),
    [(1.0, 0.0, (5.0, 5.0)), (0.0, 0.4, (-2.0, 2.0)), (-0.5, 0.2, (-3.5, -1.5)), (0.5, -0.5, (5.0, 0.0))],
)
def test_shares_are_of_the_largest_speed_and_left_turns_have_the_right_wheel_ahead(forward, turn, wheels):
    manoeuvre = PIECES.hold("name", "purpose", 2.0, forward, turn)
    assert manoeuvre.wheels(0.0) == pytest.approx(wheels)
    assert manoeuvre.wheels(1.9) == pytest.approx(wheels)
    assert (manoeuvre.name, manoeuvre.purpose, manoeuvre.duration_s) == ("name", "purpose", 2.0)


def test_a_played_piece_follows_its_profile():
    played = PIECES.play("name", "purpose", 2.0, lambda t_s: (0.1 * t_s, 0.0))
    assert played.wheels(0.0) == (0.0, 0.0)
    assert played.wheels(2.0) == pytest.approx((1.0, 1.0))


def test_each_piece_is_followed_by_a_rest():
    found = PIECES.each("purpose", ("one", 1.0, 0.5, 0.0), ("two", 3.0, 0.0, 0.5))
    assert [part.name for part in found] == ["one", "rest", "two", "rest"]
    assert [part.duration_s for part in found] == [1.0, REST_S, 3.0, REST_S]
    assert found[1].wheels(0.3) == (0.0, 0.0)
