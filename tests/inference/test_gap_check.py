import os
import time
from dataclasses import replace

import numpy as np
import pytest

from disco_hw.errors import WorkError
from disco_hw.gap.data.stamp_clock import picked
from disco_hw.inference import infer_command
from disco_hw.inference.infer_command import gap_check_in_parallel
from disco_hw.model import Model
from tests.inference.drives import logged, robot_config

NOMINAL = Model.nominal(robot_config().robot)


@pytest.mark.thorough
def test_an_effect_that_the_log_shows_is_named_by_a_process_beside():
    with gap_check_in_parallel(logged("poor", hidden=(("pose_latency", 0.15),)), NOMINAL) as searched:
        assert searched().missing == ("pose_latency",)


@pytest.mark.thorough
def test_a_robot_like_its_model_lacks_nothing():
    with gap_check_in_parallel(logged("circle"), NOMINAL) as searched:
        found = searched()
    assert (found.missing, found.why_not_checked) == ((), None)


def test_a_log_that_cannot_be_searched_is_not_judged():
    log, three = logged("poor"), np.arange(3)
    commands, wheels, poses = (picked(part, three) for part in (log.commands, log.wheels, log.poses))
    found = infer_command.gap_check(replace(log, commands=commands, wheels=wheels, poses=poses), NOMINAL)
    assert found.missing == ()
    assert "too little to judge" in found.why_not_checked


def die(send, log, model):
    os._exit(3)


@pytest.mark.thorough
def test_a_search_that_breaks_off_is_an_error_of_the_work(monkeypatch):
    monkeypatch.setattr(infer_command, "_search", die)
    with gap_check_in_parallel(logged("poor"), NOMINAL) as searched, pytest.raises(WorkError, match="was aborted"):
        searched()


def sleep(send, log, model):
    time.sleep(60.0)


def test_leaving_early_ends_the_search(monkeypatch):
    monkeypatch.setattr(infer_command, "_search", sleep)
    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt), gap_check_in_parallel(logged("poor"), NOMINAL):
        raise KeyboardInterrupt
    assert time.monotonic() - began < 30.0
