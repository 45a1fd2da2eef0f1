"""Commands that come later and later, each in its turn, show in the counter that the robot gives back."""

from drivers.command_echo import CommandEcho

PERIOD_NS = 20_000_000


def echo_of(count, first=0):
    echo = CommandEcho()
    for number in range(first, first + count):
        echo.sent(number, number * PERIOD_NS)
    return echo


def test_the_oldest_command_not_taken_says_how_late_the_robot_is():
    assert echo_of(10).late_ns(9, 10 * PERIOD_NS) == 0
    assert echo_of(10).late_ns(7, 10 * PERIOD_NS) == 2 * PERIOD_NS
    assert CommandEcho().late_ns(5, 10 * PERIOD_NS) == 0


def test_none_taken_since_the_beginning():
    assert echo_of(5, first=100).late_ns(99 % 16, 105 * PERIOD_NS) == 5 * PERIOD_NS


def test_the_counter_is_followed_past_its_wrap():
    echo = CommandEcho()
    for number in range(200):
        echo.sent(number, number * PERIOD_NS)
        behind = number // 5
        if number % 5 == 4:
            assert echo.late_ns((number - behind) % 16, (number + 1) * PERIOD_NS) == behind * PERIOD_NS


def test_a_gap_in_what_the_robot_tells_is_no_lateness():
    echo = echo_of(1)
    assert echo.late_ns(0, PERIOD_NS) == 0
    for number in range(1, 40):
        echo.sent(number, number * PERIOD_NS)
    assert echo.late_ns(38 % 16, 40 * PERIOD_NS) == PERIOD_NS


def test_what_was_sent_before_does_not_count_after_forgetting():
    echo = echo_of(10)
    echo.forget()
    echo.sent(10, 500 * PERIOD_NS)
    assert echo.late_ns(5, 501 * PERIOD_NS) == PERIOD_NS
