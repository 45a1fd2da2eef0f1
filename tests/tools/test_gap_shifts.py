"""How moved logs are counted: against what the log itself shows, and by what is named."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import pytest

from disco_hw.gap.data import WHEEL
from disco_hw.gap.search.richest_model import LATE, LATE_COLUMNS
from tools.gap_shifts import compare, form_of, row


@dataclass(frozen=True)
class Found:
    """A search that named some effects in a log whose commands are acted on late."""

    names: tuple[str, ...]
    late_s: float
    timed: bool = True
    unnamed: tuple[SimpleNamespace, ...] = ()

    @property
    def told(self):
        vector = WHEEL.neutral.copy()
        if "command_delay" in self.names:
            vector[WHEEL.place["command_delay.delay_s"]] = self.late_s
        return SimpleNamespace(vector=vector)

    @property
    def selector(self):
        return SimpleNamespace(channel=SimpleNamespace(layout=WHEEL))

    @property
    def channel(self):
        return SimpleNamespace(drive=SimpleNamespace(commands_timed=self.timed))


def counted(plain, moved):
    (one,) = compare("a_log", "commands", {0.0: plain, 0.2: moved}, LATE_COLUMNS, LATE)
    return one


@pytest.mark.parametrize("named", [(), ("command_delay",)])
def test_a_delay_of_the_log_itself_counts_whether_it_has_a_name_there_or_not(named):
    one = counted(Found(named, 0.03), Found(("command_delay",), -0.17))
    assert one.found_s == pytest.approx(0.2)
    assert one.found
    assert not counted(Found(named, 0.03), Found(("command_delay",), -0.14)).found


def test_what_has_no_name_in_the_moved_log_is_not_found():
    one = counted(Found((), 0.0), Found(("deadband",), -0.2))
    assert one.found_s == 0.0
    assert not one.found
    assert one.besides == ("deadband",)


def test_names_of_time_and_of_the_log_itself_are_none_too_many():
    term = SimpleNamespace(form="command += -0.31 u |du/dt|")
    plain = Found(("stiction",), 0.0, unnamed=(term,))
    other = replace(plain, names=("stiction", "motor_lag", "command_delay"), late_s=-0.2)
    assert counted(plain, other).besides == ()
    # The same form with another coefficient is no other one.
    again = replace(other, unnamed=(SimpleNamespace(form="command += 0.29 u |du/dt|"),))
    assert counted(plain, again).besides == ()
    assert form_of(term.form) == "command += k u |du/dt|"


@pytest.mark.parametrize(("timed", "cell"), [(True, "no"), (False, "said")])
def test_that_the_time_of_a_log_is_not_known_is_no_find_and_told_apart(timed, cell):
    one = counted(Found((), 0.0), Found(("command_delay",), -0.1, timed=timed))
    assert not one.found
    assert f"| +0.100 | {cell} |" in row(one)


def test_poses_that_are_moved_later_are_found_older():
    column = "command_delay.delay_s"
    plain, moved = Found(("command_delay",), 0.05), Found(("command_delay",), 0.25, timed=False)
    (one,) = compare("a_log", "poses", {0.0: plain, 0.2: moved}, (column,), ("command_delay",))
    assert one.found_s == pytest.approx(0.2)
    assert not one.said
