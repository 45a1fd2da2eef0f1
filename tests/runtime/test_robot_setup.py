"""Robot and model are read together, and what is believed of the geometry comes out in one order."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from disco_hw.config import SHIPPED_ROBOT
from disco_hw.daemon import run
from disco_hw.daemon.run import DaemonOptions, run_daemon
from disco_hw.errors import InputError
from disco_hw.model import EffectSetting, Gaussian, Model, load_model, save_model
from disco_hw.runtime.robot_setup import geometry, link_key, load_setup


def test_the_shipped_robot_carries_the_papers_posterior():
    setup = load_setup(SHIPPED_ROBOT)
    mean, covariance = geometry(setup.model)
    assert mean == (0.061, 0.415, 0.238)
    assert np.array(covariance) == pytest.approx(
        np.array([[0.15, 0.03, -0.03], [0.03, 0.09, -0.04], [-0.03, -0.04, 0.13]]) * 1e-3
    )


def test_overrides_and_their_mistakes():
    assert load_setup(SHIPPED_ROBOT, link="serial").config.link.kind == "serial"
    with pytest.raises(InputError, match="--link radio: not a link"):
        load_setup(SHIPPED_ROBOT, link="radio")
    with pytest.raises(InputError, match="cannot be read"):
        load_setup(SHIPPED_ROBOT, model=Path("/nowhere/model.toml"))


def test_without_a_model_the_prior_is_the_belief(tmp_path):
    path = tmp_path / "robot.toml"
    path.write_text(SHIPPED_ROBOT.read_text().replace('file = "wombot_model.toml"', ""))
    setup = load_setup(path)
    assert setup.model_file is None
    mean, covariance = geometry(setup.model)
    assert mean == pytest.approx((0.25, 0.3, 0.25))
    assert covariance[0][0] == pytest.approx(0.5**2 / 12)


def test_what_the_belief_does_not_name_is_exact():
    lag = EffectSetting("motor_lag", {"tau_s": 0.1})
    belief = Gaussian(("motor_lag.tau_s", "x_icr_m"), np.array([0.1, 0.2]), np.diag([1e-4, 4e-4]))
    mean, covariance = geometry(Model(0.05, 0.3, 0.0, (lag,), belief))
    assert mean == (0.05, 0.3, 0.2)
    assert np.array(covariance) == pytest.approx(np.diag([0.0, 0.0, 4e-4]))


def test_a_model_marked_as_lacking_an_effect_is_run_only_when_asked_to(tmp_path, monkeypatch):
    marked = tmp_path / "model.toml"
    save_model(replace(load_model(SHIPPED_ROBOT.parent / "wombot_model.toml"), missing_effects=("turn_slip",)), marked)
    monkeypatch.setattr(run, "serve", lambda *_: 0)
    message = r"model\.toml: missing_effects: the model lacks turn_slip.*--accept-missing-effects"
    with pytest.raises(InputError, match=message):
        run_daemon(DaemonOptions(robot=SHIPPED_ROBOT, model=marked))
    assert run_daemon(DaemonOptions(robot=SHIPPED_ROBOT, model=marked, accept_missing_effects=True)) == 0
    assert run_daemon(DaemonOptions(robot=SHIPPED_ROBOT)) == 0


def test_the_key_is_read_from_beside_robot_toml_and_a_bad_one_named_in_a_line(tmp_path):
    text = SHIPPED_ROBOT.read_text(encoding="utf-8").replace('file = "wombot_model.toml"', "")
    robot_file = tmp_path / "robot.toml"
    robot_file.write_text(text)
    assert link_key(load_setup(robot_file)) is None
    robot_file.write_text(text.replace("[link]\n", '[link]\nkey_file = "key"\n'))
    (tmp_path / "key").write_text("000102030405060708090a0b0c0d0e0f")
    (tmp_path / "key").chmod(0o644)
    with pytest.raises(InputError, match=r"robot.toml: link.key_file: .*others may read the key"):
        link_key(load_setup(robot_file))
    (tmp_path / "key").chmod(0o600)
    assert link_key(load_setup(robot_file)) == bytes(range(16))
