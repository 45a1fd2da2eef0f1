"""An effect of another package, one file, is rolled out, searched for and told like any other."""

import json
from pathlib import Path

import pytest

from tests.effects.outside import ROOT, OutsidePackage, effect_of_the_page

TURN_DROOP = Path(__file__).with_name("turn_droop.py").read_text(encoding="utf-8")

POINTS_DIFFER = """
from disco_hw.tasks.circle import CircleCost
from disco_hw.control import CommandLimits, Disco, DiscoSettings
from tests.control.kernel.test_skid_steer import model_of
for effects in ({"motor_lag": {"tau_s": 0.1}}, {"motor_lag": {"tau_s": 0.1}, "turn_droop": {"k_s": 0.8}}):
    disco = Disco(model_of((0.06, 0.4, 0.1), effects), CircleCost(0.3, -0.2), DiscoSettings(), CommandLimits(8.0, 20.0))
    print(disco._wheels_differ)
"""


def test_the_wheels_of_an_effect_that_uses_the_geometry_differ_between_its_points(tmp_path):
    assert OutsidePackage(tmp_path, turn_droop=TURN_DROOP).printed(POINTS_DIFFER).split() == ["False", "True"]


ROLLOUTS = """
from tests.control.kernel import test_skid_steer as kernel
model = kernel.model_of((0.06, 0.4, 0.1), {"turn_droop": {"k_s": 0.8}, "motor_lag": {"tau_s": 0.1}})
state = kernel.state_of((0.5, 0.2, 1.0, 2.0, -1.0), [(2.0, 3.0)] * 20)
kernel.check_against_reference(model, state, kernel.CIRCLE, kernel.PLAN_SETTINGS, 7)
"""


@pytest.mark.long
def test_a_wheel_effect_is_rolled_out_with_the_geometry_of_each_point(tmp_path):
    OutsidePackage(tmp_path, turn_droop=TURN_DROOP).printed(ROLLOUTS)


REFUSALS = {
    "an effect that another one has the name of": (
        TURN_DROOP.replace('"turn_droop"', '"slope"'),
        "turn_droop: an effect 'slope' is there already; give it another name",
    ),
    "one that says nothing of the geometry it uses": (
        TURN_DROOP.replace("    uses_geometry=True,\n", ""),
        "turn_droop: its coefficients depend on the geometry; say uses_geometry=True",
    ),
    "a term that asks for what its stage does not have": (
        TURN_DROOP.replace("def term(left, right,", "def term(left, forward,"),
        "turn_droop: its `term` asks for 'forward', but may for",
    ),
    "a class, as effects once were": ("class EFFECT:\n    name = 'old'\n", "turn_droop: holds no EFFECT of the type"),
    "a file that does not load": ("import no_such_module\n", "turn_droop: an effect that cannot be loaded (No module"),
}


@pytest.mark.parametrize(("text", "line"), REFUSALS.values(), ids=REFUSALS)
def test_a_wrong_description_is_refused_in_one_line(tmp_path, text, line):
    package = OutsidePackage(tmp_path, turn_droop=text)
    done = package.python("-m", "disco_hw", "check", str(ROOT / "disco_hw/robots/wombot.toml"))
    assert done.returncode == 2, done.stderr
    assert line in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


SEARCH = """
import json, sys
from dataclasses import replace
from pathlib import Path
import numpy as np
from disco_hw.gap import find_gap
from disco_hw.gap.report.wording import sentence
from disco_hw.log.drive import Commands
from disco_hw.model import Model, load_model, save_model
from disco_hw.model.free_run import FreeRun
from tools.gap_logs import simulated_drive

log = simulated_drive({"x_speed_squared_drag": 0.5}, seed=905)
none, no_segment = np.empty(0), np.empty(0, dtype=np.int64)
# Without commands only the body is searched, which is enough and takes half the time.
log = replace(log, commands=Commands(none, none, none, no_segment))
report = find_gap(log, Model(0.061, 0.415, 0.238))
save_model(report.model, Path(sys.argv[1]))
model = load_model(Path(sys.argv[1]))
states = FreeRun(model, model.point()[None], 0.1).states(np.zeros(5), np.full((10, 2), 7.0), 0)
estimate = report.effects[0].parameters if report.effects else {}
print(json.dumps({
    "named": [effect.name for effect in report.effects],
    "sentences": [sentence(effect) for effect in report.effects],
    "k": {name: [e.value, e.low, e.high] for name, e in estimate.items()},
    "unnamed": [one.form for one in report.unnamed],
    "went_m": states[-1, 0],
    "rolled_m": float(model.wheel_radius_m * 7.0),
}))
"""


@pytest.mark.long
def test_the_effect_of_the_page_is_found_named_and_driven(tmp_path):
    package = OutsidePackage(tmp_path, speed_drag=effect_of_the_page())
    found = json.loads(package.printed(SEARCH, str(tmp_path / "model.toml")))
    assert found["named"] == ["speed_drag"], found
    assert not found["unnamed"]
    value, low, high = found["k"]["k_s2_m2"]
    assert low < 0.5 < high, found
    assert found["sentences"] == [f"drag takes {value:.2f} v^3 of the speed"]
    v = found["rolled_m"]
    assert abs(found["went_m"] - (v - value * v**3)) < 1e-6
