"""`infer` on logs that contradict themselves: refused with the cause, or warned of first; never a traceback."""

import json
import re

import numpy as np
import pytest

from disco_hw.errors import InputError
from disco_hw.inference import infer as inference
from disco_hw.inference import infer_command as verb
from disco_hw.inference.density_network import EmptyRegionError, Region
from disco_hw.inference.infer import InferOptions
from tests.inference.drives import ROBOT, logged, robot_config
from tests.inference.test_infer_command import FEW, finds
from tests.log.contradictory_drives import FAULTS, RADIUS_M, sound, with_wheels
from tests.tables import thinned

# Wheels that count all alike wrong are fitted, and commands are not read; without commands all is the same.
OF_USE = ("encoders doubled", "encoders halved", "a heading that stops for a third")
SPOILED = [name for name in FAULTS if name not in OF_USE and "commands" not in name]


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Infers from a drive that is taken for what a file holds; gives the result and the model's path."""
    robot = tmp_path / "robot.toml"
    robot.write_text(ROBOT.replace("0.055", str(RADIUS_M)))

    def infer(log, options=FEW):
        monkeypatch.setattr(verb, "load_drive", lambda *_: log)
        log_file = tmp_path / "log.csv"
        return verb.infer_command([log_file], robot, tmp_path / "model.toml", None, options, search=finds())

    return infer


# The first reversed needs one drive to be simulated, not two.
@thinned("fault", SPOILED[::-1], quick=1)
def test_a_log_that_says_nothing_of_the_robot_is_refused_with_the_cause(run, fault, tmp_path):
    change, _, hint = FAULTS[fault]
    log = change(sound())
    with pytest.raises(InputError, match=re.escape(hint)) as caught:
        run(log)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "model.toml").exists()


@pytest.mark.long
def test_wheels_that_count_double_are_warned_of_in_the_first_line(run):
    result = run(with_wheels(2.0, 2.0)(sound("circle")))
    first, *_ = result.as_text().splitlines()
    assert first.startswith("warning: simulated: the wheels count 2.00 times the expected ticks")
    assert "check ticks_per_rev and gear" in first
    report = json.loads(json.dumps(result.as_dict()))
    assert [each["cause"] for each in report["contradictions"]] == ["encoder_count"]
    assert report["posterior"]["wheel_radius_m"]["mean"] == pytest.approx(0.5 * RADIUS_M, rel=0.1)


@thinned("error", [EmptyRegionError("empty"), np.linalg.LinAlgError("singular")], quick=1)
def test_a_region_without_parameters_is_one_line(monkeypatch, error):
    def fail(*_):
        raise error

    monkeypatch.setattr(inference, "run_rounds", fail)
    with pytest.raises(InputError, match=r"no parameters within the prior of robot\.toml explain this log") as caught:
        inference.infer(logged("poor"), robot_config(), InferOptions(simulations=300))
    assert "\n" not in str(caught.value)


def test_a_region_that_is_all_but_empty_says_so():
    apart = Region.box(np.zeros(1), np.ones(1))
    empty_region = Region(apart.low, apart.high, np.array([9.0]), np.eye(1), apart)
    with pytest.raises(EmptyRegionError):
        empty_region.draw(10, np.random.default_rng(1))
