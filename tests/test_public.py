"""The public interface: what it holds, what importing it loads, and that its page says so and runs."""

from __future__ import annotations

import math
import os
import re
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest

import disco_hw
import disco_hw.errors

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
CSV = """t_s,cmd_left_rad_s,cmd_right_rad_s,enc_left_rad_s,enc_right_rad_s,pose_x_m,pose_y_m,pose_yaw_rad
0.0,1.0,1.0,0.0,0.0,0.0,0.0,0.0
0.02,1.0,1.0,0.9,0.9,,,
0.04,1.0,1.0,1.0,1.0,0.002,0.0,0.0
"""


def test_importing_it_loads_nothing():
    text = "import disco_hw, sys; print(*(m for m in sys.modules if m.split('.')[0] not in sys.stdlib_module_names))"
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, timeout=60, check=True)
    assert [name for name in done.stdout.split() if name.startswith(("disco_hw", "numpy", "msgspec"))] == ["disco_hw"]


@pytest.mark.parametrize("name", sorted(set(disco_hw.__all__) - {"__version__"}))
def test_every_name_is_there_described_and_on_the_page(name):
    assert getattr(disco_hw, name).__doc__
    assert name in dir(disco_hw)
    assert f"`{name}" in PAGE


def test_every_name_is_in_the_reference_that_is_made_from_docstrings():
    made = re.findall(r"^::: disco_hw\.(\w+)$", (ROOT / "docs" / "api.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(made) == sorted(set(disco_hw.__all__) - {"__version__"})


def test_files_are_named_by_text_as_the_page_does(tmp_path):
    model = disco_hw.Model.nominal(disco_hw.load_robot(str(ROOT / "disco_hw/robots/wombot.toml")).robot)
    disco_hw.save_model(model, str(tmp_path / "model.toml"))
    assert disco_hw.load_model(str(tmp_path / "model.toml")) == model
    (tmp_path / "drive.csv").write_text(CSV, encoding="utf-8")
    for named in (str(tmp_path / "drive.csv"), [str(tmp_path / "drive.csv")]):
        assert len(disco_hw.read_log(named).poses.t_s) == 2
    with pytest.raises(disco_hw.errors.InputError, match=r"^nowhere.toml: "):
        disco_hw.load_robot("nowhere.toml")


def test_any_other_name_is_not():
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = disco_hw.nonsense
    assert disco_hw.__version__ == metadata.version("disco-hw")


def test_a_type_checker_sees_the_same_names(tmp_path):
    source = Path(disco_hw.__file__).read_text(encoding="utf-8")
    hidden = source.split("if TYPE_CHECKING:")[1].split("_PUBLIC")[0]
    assert all(name in hidden for name in disco_hw.__all__)


def test_a_model_turns_as_its_equations_say():
    model = disco_hw.Model(0.1, 0.5)
    states = disco_hw.simulate(model, np.tile([1.0, 2.0], (100, 1)), 0.01)
    assert states.shape == (101, 5)
    yaw = 0.1 * (2.0 - 1.0) / 0.5
    assert states[-1, 2] == pytest.approx(yaw, rel=1e-6)
    assert states[-1, :2] == pytest.approx((0.75 * math.sin(yaw), 0.75 * (1.0 - math.cos(yaw))), rel=1e-4)


@pytest.mark.parametrize("commands", [np.zeros((3, 3)), np.full((3, 2), math.nan)])
def test_commands_that_are_none_are_refused(commands):
    with pytest.raises(ValueError, match=r"needed|finite"):
        disco_hw.simulate(disco_hw.Model(0.1, 0.5), commands)


def test_a_log_becomes_a_table(tmp_path):
    pytest.importorskip("pandas")
    path = tmp_path / "drive.csv"
    path.write_text(CSV, encoding="utf-8")
    table = disco_hw.read_log(path).to_pandas()
    assert list(table.t_s) == sorted(table.t_s)
    assert table.pose_x_m.dropna().tolist() == [0.0, 0.002]
    assert table.enc_left_rad_s.dropna().tolist() == [0.0, 0.9, 1.0]
    assert set(table.segment) == {0}


def run(program, directory, timeout_s=120):
    """Return what a program prints that is run in a directory."""
    done = subprocess.run(
        [sys.executable, "-c", program],
        cwd=directory,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=timeout_s,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_first_program_of_the_page_runs(monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    exec(PAGE.split("```python\n")[1].split("```")[0], {})
    assert capsys.readouterr().out.startswith("a turn of ")


def notebook(name):
    return (ROOT / "docs" / "notebooks" / name).read_text(encoding="utf-8")


@pytest.mark.long
@pytest.mark.timeout(1800)
def test_the_second_program_of_the_page_and_the_notebook_of_identification_run(tmp_path):
    printed = run(notebook("identification.py"), tmp_path, 900)
    found = {name: float(value) for name, value in re.findall(r"^(\w+): (\S+) \+-", printed, re.MULTILINE)}
    assert found["wheel_radius_m"] == pytest.approx(0.0609, rel=0.05)
    assert found["axial_distance_m"] == pytest.approx(0.416, rel=0.05)
    (tmp_path / "identification.mcap").rename(tmp_path / "drive.mcap")
    for name in ("wombot.toml", "wombot_model.toml"):
        (tmp_path / name).write_bytes((ROOT / "disco_hw" / "robots" / name).read_bytes())
    (tmp_path / "wombot.toml").rename(tmp_path / "robot.toml")
    pytest.importorskip("pandas")
    run(PAGE.split("```python\n")[2].split("```")[0], tmp_path, 900)
    assert disco_hw.load_model(tmp_path / "model.toml").parameter_names


@pytest.mark.long
@pytest.mark.timeout(900)
def test_the_notebook_of_control_runs(tmp_path):
    off_m = [float(value) for value in re.findall(r"RMS distance (\S+) m", run(notebook("control.py"), tmp_path, 900))]
    assert len(off_m) == 2
    assert max(off_m) < 0.2


@pytest.mark.long
@pytest.mark.timeout(900)
def test_the_notebook_of_a_new_effect_names_what_was_hidden(tmp_path):
    assert 'name = "deadband"' in run(notebook("new_effect.py"), tmp_path, 900)
    assert "deadband.width_rad_s" in disco_hw.load_model(tmp_path / "new_effect.toml").parameter_names
