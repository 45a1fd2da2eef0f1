"""Whatever the robot, the last stage of `gap` judges what its log could not show and writes every file."""

import json
from contextlib import nullcontext
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

from disco_hw import gap
from disco_hw.gap import WRITTEN
from disco_hw.gap.search import joint_predictions
from disco_hw.gap.search.analysis import final_fit
from disco_hw.model import Model, load_model
from tools.gap.logs import simulated_drive

MODEL = Model(0.061, 0.415, 0.238)


@pytest.fixture(scope="module")
def searched():
    """A log in which something is hidden, what the search finds in it, and its predictions, each made once."""
    log = simulated_drive({"motor_lag": 0.15}, 1, "circle")
    analysis, notes = gap.search_log(log, MODEL)
    predictions = joint_predictions(analysis, final_fit(analysis))
    made = {"table": predictions.table().copy, "errors_of_body": cache(predictions.errors_of_body)}
    return log, analysis, notes, SimpleNamespace(joint=predictions.joint, kept=predictions.kept, **made)


def robot_toml(generator):
    """A robot from a toy to a lorry, drawn at random; some that turn slower than robots are held to."""
    radius_m = float(10.0 ** generator.uniform(-2.0, 0.3))
    axial_m = float(min(10.0 ** generator.uniform(-1.3, 0.69), 5.0))
    fastest_rad_s = float(10.0 ** generator.uniform(-1.0, 1.81))
    return (radius_m, axial_m, fastest_rad_s), (
        f'[robot]\nname = "drawn"\nwheel_radius_m = {radius_m}\naxial_distance_m = {axial_m}\n'
        f"ticks_per_rev = {int(generator.integers(1, 65536))}\nmax_wheel_speed_rad_s = {fastest_rad_s}\n"
        f'[task]\nkind = "circle"\nradius_m = {2.0 * axial_m}\nspeed_m_s = {0.3 * fastest_rad_s * radius_m}\n'
    )


def of_geometry(analysis, radius_m, axial_m):
    """The same result of the search for a robot of another size, on whose wheels the turning limits depend."""
    geometry = np.array([radius_m, axial_m, 0.1 * axial_m])
    wheels = analysis.wheels
    channel = replace(wheels.channel, geometry=geometry)
    selector = replace(wheels.selector, channel=channel)
    return replace(analysis, wheels=replace(wheels, selector=selector, channel=channel))


def written(searched, monkeypatch, folder, seeds):
    """Whether each of some random robots is judged as slow to turn; the files of all were written and are sound."""
    log, analysis, notes, predictions = searched
    slow = []
    monkeypatch.setattr(gap, "load_drive", lambda *_: log)
    # One log stands for the logs of all robots, and so contradicts most of them.
    monkeypatch.setattr(gap, "check_consistency", lambda *_: ())
    # None depends on the robot's limits, and each takes long.
    monkeypatch.setattr(gap, "joint_predictions", lambda *_: predictions)
    monkeypatch.setattr(gap, "being_proved", lambda spots, *_: nullcontext(lambda: spots))
    monkeypatch.setattr(gap, "_draw_images", lambda *_: {"picture": b"PNG"})
    for seed in seeds:
        (radius_m, axial_m, fastest_rad_s), text = robot_toml(np.random.default_rng([23, seed]))
        robot, out = folder / f"{seed}.toml", folder / str(seed)
        robot.write_text(text)
        here = of_geometry(analysis, radius_m, axial_m)
        monkeypatch.setattr(gap, "search_log", lambda *_, here=here: (here, notes))
        result = gap.gap([], robot, out)
        report = json.loads((out / "report.json").read_text())
        assert all(type(spot["blind"]) is bool for spot in report["blind_spots"])
        # What was asked of this robot's wheels is the same; a limit beyond it is one that the log is blind to.
        turning = next(spot for spot in report["blind_spots"] if spot["name"] == "yaw_rate_limit")
        enough = min(0.75 * fastest_rad_s * 2.0 * radius_m / axial_m, 1.2)
        assert turning["blind"] is (turning["smallest_visible"] is None or turning["smallest_visible"] < enough)
        assert report["blind_spots"] == json.loads(json.dumps(result.as_dict()["blind_spots"]))
        assert (out / "report.html").read_text().startswith("<!doctype html>")
        assert load_model(out / "model.toml").effects[0].name == "motor_lag"
        assert {path.name for path in out.iterdir()} == {*WRITTEN, "picture.png"}
        slow.append(enough < 1.2)
    return slow


@pytest.mark.parametrize(
    ("count", "fewest"),
    [pytest.param(12, 1, marks=pytest.mark.thorough), pytest.param(200, 41, marks=pytest.mark.long)],
)
def test_robots_of_every_size_get_their_report(searched, monkeypatch, tmp_path, count, fewest):
    slow = written(searched, monkeypatch, tmp_path, range(count))
    # Of the slow ones as of the others.
    assert fewest <= sum(slow) <= count - fewest
