"""What fits a channel and leads the chain from command to pose astray is left out, or another takes its place."""

from dataclasses import dataclass, field
from types import SimpleNamespace

import pytest

from disco_hw.gap import find_gap
from disco_hw.gap import search as stages
from disco_hw.gap.report.judge import residue_sentences
from disco_hw.gap.search import prune
from disco_hw.gap.search.cross_validation import PredictionErrors
from disco_hw.gap.settings import DEFAULT_SETTINGS
from disco_hw.model import Model
from tools.gap.logs import simulated_drive


@dataclass(frozen=True)
class Part:
    names: tuple
    rivals: dict = field(default_factory=dict)
    given: tuple = ()
    unnamed: tuple = ()
    plain: object = None

    @property
    def selector(self):
        return SimpleNamespace(given=self.given, rivals=lambda names, name: self.rivals.get(name, ()))


@dataclass(frozen=True)
class Whole:
    wheels: Part
    body: Part
    amended_m: dict
    pruned: tuple = ()
    drive: object = field(default_factory=lambda: SimpleNamespace(settings=DEFAULT_SETTINGS))

    def errors(self, stage, ahead_s=None):
        names = frozenset((*self.wheels.names, *self.body.names))
        size = 0.1 if stage == "refitted" else self.amended_m.get(names, 0.1)
        position_m, yaw_rad = size if isinstance(size, tuple) else (size, size)
        return PredictionErrors(position_m, (0.0, 1.0), yaw_rad, (0.0, 1.0), 0.0, {})


@pytest.fixture(autouse=True)
def _predictions_of_the_parts(monkeypatch):
    monkeypatch.setattr(stages, "stage_predictions", lambda whole: whole)


def told(amended_m, wheels, body=(), **rivals):
    by_set = {frozenset(names.split()): size for names, size in amended_m.items()}
    found = prune(Whole(Part(wheels, rivals), Part(body), by_set))
    return (*found.wheels.names, *found.body.names), found.pruned


def test_what_predicts_better_or_hardly_worse_stays_without_another_look():
    assert told({"motor_lag": 0.02}, ("motor_lag",)) == (("motor_lag",), ())
    assert told({"motor_lag": 0.104}, ("motor_lag",)) == (("motor_lag",), ())


def test_the_name_that_does_the_harm_goes_and_the_others_stay():
    amended_m = {"motor_lag battery_sag slope": 0.5, "motor_lag slope": 0.6, "battery_sag slope": 0.03,
                 "motor_lag battery_sag": 0.4}  # fmt: skip
    assert told(amended_m, ("motor_lag", "battery_sag"), ("slope",)) == (("battery_sag", "slope"), ("motor_lag",))


def test_of_two_that_do_as_much_harm_the_first_goes():
    amended_m = {"motor_lag battery_sag": 0.5, "motor_lag": 0.03, "battery_sag": 0.03}
    assert told(amended_m, ("motor_lag", "battery_sag")) == (("battery_sag",), ("motor_lag",))


def test_a_name_without_which_predictions_are_clearly_better_goes():
    amended_m = {"motor_lag wheel_gain": 0.03, "motor_lag": 0.02, "wheel_gain": 0.08}
    assert told(amended_m, ("motor_lag", "wheel_gain")) == (("motor_lag",), ("wheel_gain",))
    hardly = {"motor_lag wheel_gain": 0.03, "motor_lag": 0.029, "wheel_gain": 0.08}
    assert told(hardly, ("motor_lag", "wheel_gain")) == (("motor_lag", "wheel_gain"), ())
    # Another that would do as well needs more reason than that.
    swapped = {"motor_lag": 0.03, "command_delay": 0.01}
    assert told(swapped, ("motor_lag",), motor_lag=("command_delay",)) == (("motor_lag",), ())


@pytest.mark.parametrize(("yaw_rad", "goes"), [(0.030, False), (0.0287, False), (0.0284, True)])
def test_a_name_goes_only_where_position_and_heading_are_both_better_without(yaw_rad, goes):
    sizes = {"motor_lag wheel_gain": 0.03, "motor_lag": (0.015, yaw_rad), "wheel_gain": 0.08}
    assert told(sizes, ("motor_lag", "wheel_gain"))[1] == (("wheel_gain",) if goes else ())


def test_another_that_would_do_in_its_place_takes_it_if_it_predicts_better_than_none():
    amended_m = {"wheel_gain": 0.5, "": 0.1, "motor_lag": 0.04, "command_delay": 0.06}
    names, pruned = told(amended_m, ("wheel_gain",), wheel_gain=("command_delay", "motor_lag"))
    assert (names, pruned) == (("motor_lag",), ("wheel_gain",))


def test_nothing_goes_where_all_else_is_worse_still():
    assert told({"motor_lag": 0.2, "": 0.3}, ("motor_lag",)) == (("motor_lag",), ())


def test_what_the_given_model_has_stays():
    whole = Whole(Part(("motor_lag",), given=("motor_lag",)), Part(()), {frozenset(("motor_lag",)): 0.5})
    assert prune(whole).wheels.names == ("motor_lag",)


def test_what_was_left_out_is_said():
    (said,) = residue_sentences(Whole(None, None, {}, ("motor_lag",)))
    assert said.startswith("command_to_wheel: motor_lag fits")
    assert "worse" in said


@pytest.mark.long
def test_a_motor_with_a_slew_limit_is_not_given_a_gain_that_misleads(monkeypatch):
    monkeypatch.undo()
    report = find_gap(simulated_drive({"acceleration_limit": 10.0}, seed=7002), Model(0.061, 0.415, 0.238))
    assert report.why_not_amended is None
