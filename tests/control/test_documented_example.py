"""Tests of what docs/control.md says, and of the black-box example of docs/my-controller.md as it stands there."""

import math
import re
from pathlib import Path

import numpy as np
import pytest

from disco_hw.control import DiscoSettings
from disco_hw.model import Model
from disco_hw.model.step import FreeRun

DOCUMENT = Path(__file__).parents[2] / "docs/control.md"
TUTORIAL = DOCUMENT.with_name("my-controller.md")


def test_the_example_is_short_and_reaches_its_goal(capsys):
    example = re.findall(r"```python\n(.*?)```", TUTORIAL.read_text("utf-8"), re.DOTALL)[-1]
    assert len([line for line in example.splitlines() if line.strip()]) < 40
    scope = {"__name__": "example"}
    exec(compile(example, str(TUTORIAL), "exec"), scope)
    assert abs(scope["position"] - 1.0) < 0.05
    assert abs(scope["speed"]) < 0.1
    assert capsys.readouterr().out.startswith("at ")


def test_the_document_begins_with_the_oracle():
    text = DOCUMENT.read_text("utf-8")
    assert "oracle.py" in text.splitlines()[2]
    assert text.index("oracle.py") < text.index("disco_hw.control.Disco")


def test_it_is_said_which_mode_takes_which_step():
    assert "| exact arc | Euler step: straight along the heading" in DOCUMENT.read_text("utf-8")
    assert (DiscoSettings().euler, DiscoSettings.paper().euler) == (False, True)


@pytest.mark.parametrize("turn_rad_s", [0.0, 0.5, 2.0])
def test_a_step_is_an_exact_arc(turn_rad_s):
    model = Model(0.06, 0.4, 0.0)
    v, step_s = 0.3, 0.1
    left, right = ((v - 0.5 * side * 0.4 * turn_rad_s) / 0.06 for side in (1.0, -1.0))
    pose = FreeRun(model, model.point()[None], step_s).states(np.zeros(5), np.full((1, 2), [left, right]), 0)[1, :3]
    half = 0.5 * turn_rad_s * step_s
    chord = v * step_s * (math.sin(half) / half if half else 1.0)
    np.testing.assert_allclose(pose, [chord * math.cos(half), chord * math.sin(half), 2.0 * half], atol=1e-9)
