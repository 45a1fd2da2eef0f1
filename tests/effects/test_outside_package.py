"""An effect of another package, one file, is rolled out, searched for and told like any other."""

import json
from pathlib import Path

import pytest

from tests.effects.outside import ROOT, OutsidePackage, effect_of_the_page, entry_points_of_the_page
from tests.tables import thinned

TURN_DROOP, MAST_LEAN = (
    Path(__file__).with_name(name).read_text(encoding="utf-8") for name in ("turn_droop.py", "mast_lean.py")
)

POINTS_DIFFER = """
from disco_hw.tasks.circle import CircleCost
from disco_hw.control import CommandLimits, Disco, DiscoSettings
from tests.control.kernel.test_skid_steer import model_of
for effects in ({"motor_lag": {"tau_s": 0.1}}, {"motor_lag": {"tau_s": 0.1}, "turn_droop": {"k_s": 0.8}}):
    disco = Disco(model_of((0.06, 0.4, 0.1), effects), CircleCost(0.3, -0.2), DiscoSettings(), CommandLimits(8.0, 20.0))
    print(disco._points.wheels_differ)
"""


@pytest.mark.thorough
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


EVERYWHERE = """
import json, sys
from pathlib import Path
import numpy as np
from disco_hw.effects.registry import REGISTRY
from disco_hw.gap.data import BODY, WHEEL, pose_sensor
from disco_hw.gap.search.richest_model import candidates_of, smooth_of
from disco_hw.gap.search.analysis import confounded_with
from disco_hw.gap.search.analysis import _OF_TURNING
from disco_hw.inference.checks import CHECKS
from disco_hw.log import records
from disco_hw.model import EffectSetting, Gaussian, Model, load_model, save_model
from disco_hw.viewer.recording import ParameterPoints

names = ("turn_droop.k_s", "speed_drag.k_s2_m2")
belief = Gaussian(names, np.array([0.5, 0.3]), np.diag([0.01, 0.01]))
effects = (EffectSetting("turn_droop", {"k_s": 0.5}), EffectSetting("speed_drag", {"k_s2_m2": 0.3}))
file = Path(sys.argv[1])
save_model(Model(0.06, 0.4, 0.1, effects=effects, belief=belief), file)
plan = records.Plan(0, 0, 0.1, (2.0,) * 10, (6.0,) * 10, path_x_m=(0.0,), path_y_m=(0.0,), path_yaw_rad=(0.0,))
fan = ParameterPoints(load_model(file)).trajectories(plan, (2.0, 6.0))
leaning = BODY.neutral.copy()
leaning[BODY.place["mast_lean.left_m"]] = 0.03
print(json.dumps({
    "compete": [candidates_of(WHEEL), candidates_of(BODY)],
    "smooth": [smooth_of(WHEEL), smooth_of(BODY)],
    "fan_m": np.ptp(fan[:, -1], axis=0).tolist(),
    "points": len(fan),
    "confounded": confounded_with(("lateral_icr",), False),
    "decided": REGISTRY["mast_lean"].mimics.decided_by,
    "sits_left_m": pose_sensor(leaning).left_m,
    "of_turning": _OF_TURNING,
    "checks": {check.name: check.effects for check in CHECKS},
}))
"""


@pytest.mark.thorough
def test_model_files_fan_competition_classes_and_checks_have_effects_of_other_packages(tmp_path):
    package = OutsidePackage(tmp_path, turn_droop=TURN_DROOP, mast_lean=MAST_LEAN, speed_drag=effect_of_the_page())
    found = json.loads(package.printed(EVERYWHERE, str(tmp_path / "model.toml")))
    wheels, body = found["compete"]
    assert "turn_droop" in wheels
    assert "speed_drag" in body
    assert "mast_lean" not in body
    assert "turn_droop" in found["smooth"][0]
    assert "speed_drag" in found["smooth"][1]
    assert found["points"] == 5
    assert min(found["fan_m"]) > 1e-3
    assert found["confounded"] == {"lateral_icr": ["mast_lean", "pose_offset"]}
    assert found["decided"] == "hold a plumb line to the mast"
    assert found["sits_left_m"] == 0.03
    assert "turn_droop.k_s" in found["of_turning"]
    assert "speed_drag" in found["checks"]["shorter at speed"]


def test_the_page_names_the_module_that_it_shows():
    assert entry_points_of_the_page() == {"speed_drag": "speed_drag"}
    assert 'name="speed_drag"' in effect_of_the_page()


@pytest.mark.thorough
def test_the_virtual_robot_refuses_to_hide_it_in_one_line(tmp_path):
    package = OutsidePackage(tmp_path, turn_droop=TURN_DROOP)
    robot = str(ROOT / "disco_hw/robots/wombot.toml")
    done = package.python("-m", "disco_hw", "sim", robot, "--hide", "turn_droop=0.1")
    assert done.returncode == 2, done.stderr
    (line,) = done.stderr.strip().splitlines()
    assert "turn_droop" in line


REFUSALS = {
    "an effect that another one has the name of": (
        TURN_DROOP.replace('"turn_droop"', '"slope"'),
        "turn_droop: an effect 'slope' already exists; give it another name",
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


@thinned(("text", "line"), list(REFUSALS.values()), quick=1, ids=REFUSALS)
def test_a_wrong_description_is_refused_in_one_line(tmp_path, text, line):
    package = OutsidePackage(tmp_path, turn_droop=text)
    done = package.python("-m", "disco_hw", "check", str(ROOT / "disco_hw/robots/wombot.toml"))
    assert done.returncode == 2, done.stderr
    assert line in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


SEARCH = """
import json, sys, tomllib
from dataclasses import replace
from pathlib import Path
import numpy as np
from disco_hw.gap import find_gap
from disco_hw.gap.report.page import sentence
from disco_hw.log.drive import Commands
from disco_hw.model import Model, load_model, save_model
from disco_hw.model.step import FreeRun
from tools.gap.logs import simulated_drive

# Strong enough to be worth a model of its own: with 0.5 its predictions would be less than a tenth worse without it.
log = simulated_drive({"x_speed_squared_drag": 0.8}, seed=905)
# Without commands only the body is searched, which is enough and takes half the time.
log = replace(log, commands=Commands())
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
    "driven_with": tomllib.loads(Path(sys.argv[1]).read_text())["effects"][0]["k_s2_m2"],
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
    assert low < 0.8 < high, found
    assert found["sentences"] == [f"drag takes {value:.2f} v^3 of the speed"]
    # The model has the value of the last joint fit, commands to poses.
    v, k = found["rolled_m"], found["driven_with"]
    assert low < k < high
    assert abs(found["went_m"] - (v - k * v**3)) < 1e-6


SEARCH_WHEELS = """
import json
from dataclasses import replace
import numpy as np
from disco_hw.gap import find_gap
from disco_hw.gap.report.page import as_text
from disco_hw.log.drive import Poses
from disco_hw.model import Model
from tools.gap.logs import simulated_drive

RADIUS_M, AXIAL_M, K_S = 0.06, 0.4, 0.3
log = simulated_drive({}, seed=905)
# The wheels turn as commanded. So they show the effect if what was commanded is what it makes them turn by.
mean = 0.5 * (log.commands.left_rad_s + log.commands.right_rad_s)
half = 0.5 * (log.commands.right_rad_s - log.commands.left_rad_s)
half = half / (1.0 - 2.0 * K_S * RADIUS_M / AXIAL_M * np.abs(half))
log = replace(
    log,
    commands=replace(log.commands, left_rad_s=mean - half, right_rad_s=mean + half),
    poses=Poses(),
)
report = find_gap(log, Model(RADIUS_M, AXIAL_M, 0.1), top_rad_s=8.0)
print(json.dumps({
    "named": [effect.name for effect in report.effects],
    "k": [[e.value, e.low, e.high] for effect in report.effects for e in effect.parameters.values()],
    "blind": [spot.name for spot in report.blind_spots],
    "text": as_text(report),
}))
without = find_gap(simulated_drive({}, seed=906), Model(RADIUS_M, AXIAL_M, 0.1))
(spot,) = [spot for spot in without.blind_spots if spot.name == "turn_droop"]
print(json.dumps([spot.smallest_visible, spot.experiment]))
"""


@pytest.mark.long
def test_a_wheel_effect_is_found_told_and_has_a_blind_spot(tmp_path):
    package = OutsidePackage(tmp_path, turn_droop=TURN_DROOP)
    found, spot = map(json.loads, package.printed(SEARCH_WHEELS).splitlines())
    assert found["named"] == ["turn_droop"], found
    ((value, low, high),) = found["k"]
    assert low < 0.3 < high, found
    assert value == pytest.approx(0.3, rel=0.1)
    assert "turn_droop" not in found["blind"]
    assert "Turning asks for more than the wheels give: 0.300 of it" in found["text"]
    smallest, experiment = spot
    assert 0.0 < smallest < 0.3
    assert experiment == "disco-hw drive ROBOT.toml --script spins: turning on the spot at two rates"
