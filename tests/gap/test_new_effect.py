"""An effect of another package, one class in one file, is found by the registry and competes like any other."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.long

NEW_EFFECT = '''
"""Drag that grows with the speed squared: v -> v - k v^3."""

from disco_hw.effects.effect import Channel, Parameter, Stage
from disco_hw.jit import scalar_function


class SpeedDrag:
    name = "speed_drag"
    channel = Channel.WHEEL_TO_BODY
    moves = True
    stage = Stage.FORWARD
    order = 145
    parameters = (Parameter("k_s2_m2", "s^2/m^2", -5.0, 5.0, 0.3, realistic=0.2),)
    excitation = "straights at two speeds"
    script = "straights"
    sentence = "drag takes {k_s2_m2:.2f} v^3 of the speed"

    def coefficients(self, values, base, step_s):
        return (values[:, 0],)


@scalar_function
def term(forward, coefficients):
    if coefficients is None:
        return forward
    (k,) = coefficients
    return forward - k * forward * forward * forward


EFFECT = SpeedDrag()
'''

SEARCH = """
import json, sys
from dataclasses import replace
from pathlib import Path
import numpy as np
from disco_hw.gap import find_gap
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
    "sentences": [effect.sentence() for effect in report.effects],
    "k": {name: [e.value, e.low, e.high] for name, e in estimate.items()},
    "unnamed": [one.form for one in report.unnamed],
    "went_m": states[-1, 0],
    "rolled_m": float(model.wheel_radius_m * 7.0),
}))
"""


def test_an_effect_of_another_package_is_found_named_and_driven(tmp_path):
    site = tmp_path / "site"
    info = site / "castor-1.0.dist-info"
    info.mkdir(parents=True)
    (site / "speed_drag.py").write_text(NEW_EFFECT)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: castor\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[disco_hw.effects]\nspeed_drag = speed_drag\n")
    here = Path(__file__).parents[2]
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join([str(site), str(here)]),
        "NUMBA_CACHE_DIR": str(tmp_path / "numba"),
        "OPENBLAS_NUM_THREADS": "1",
    }
    done = subprocess.run(
        [sys.executable, "-c", SEARCH, str(tmp_path / "model.toml")],
        env=environment, cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["named"] == ["speed_drag"], found
    assert not found["unnamed"]
    value, low, high = found["k"]["k_s2_m2"]
    assert low < 0.5 < high, found
    assert found["sentences"] == [f"drag takes {value:.2f} v^3 of the speed"]
    v = found["rolled_m"]
    assert abs(found["went_m"] - (v - value * v**3)) < 1e-6
