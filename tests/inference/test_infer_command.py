import base64
import html
import json
import re
import shlex
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from disco_hw.cli import logs
from disco_hw.config import SHIPPED_ROBOT
from disco_hw.daemon import run
from disco_hw.errors import InputError, WorkError
from disco_hw.inference import infer_command as verb
from disco_hw.inference.infer import InferOptions
from disco_hw.inference.infer_command import GapCheck, infer_command
from disco_hw.inference.simulate import NAMES
from disco_hw.log.contradictions import Contradiction
from disco_hw.log.importing import import_log
from disco_hw.model import Model, load_model
from tests.inference.drives import ROBOT, TRUTH, write_log

FEW = InferOptions(simulations=300)


def finds(*missing, why_not_checked=None):
    """A search for missing effects that finds these."""
    return lambda log, model: nullcontext(lambda: GapCheck(missing, why_not_checked))


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    path = tmp_path_factory.mktemp("robot") / "robot.toml"
    path.write_text(ROBOT)
    return path


@pytest.fixture(scope="module")
def circle(robot):
    return write_log(robot.parent / "circle.csv")


@pytest.fixture(scope="module")
def inferred(circle, robot):
    folder = robot.parent
    progress = []
    result = infer_command(
        [circle],
        robot,
        folder / "model.toml",
        folder / "report.html",
        InferOptions(simulations=600, seed=3),
        search=finds(),
        report_progress=lambda stage, share: progress.append((stage, share)),
    )
    return folder, result, progress


@pytest.fixture(scope="module")
def result(inferred):
    return inferred[1]


def test_the_truth_lies_in_the_posterior_of_a_circle(result):
    circle = result.inference
    truth = np.array([TRUTH[name] for name in NAMES])
    mean, sd = circle.draws.mean(axis=0), circle.draws.std(axis=0)
    assert mean == pytest.approx(truth, rel=0.03)
    assert np.all(np.abs(mean - truth) < 4.0 * sd)
    assert np.all(sd < 0.02 * np.array([0.5, 0.5, 0.4]))
    assert not circle.predictive.outside_simulated


def test_the_belief_has_the_moments_of_the_draws_and_goes_into_a_model(result):
    circle = result.inference
    assert circle.belief.mean() == pytest.approx(circle.draws.mean(axis=0), rel=0.01)
    assert np.sqrt(np.diag(circle.belief.covariance())) == pytest.approx(circle.draws.std(axis=0), rel=0.15)
    model = circle.model(Model(0.055, 0.4, name="test"))
    assert model.wheel_radius_m == pytest.approx(circle.belief.mean()[NAMES.index("wheel_radius_m")])
    assert model.belief is circle.belief
    assert model.name == "test"


def test_the_json_has_the_promised_shape(result):
    found = json.loads(json.dumps(result.as_dict()))
    for name, truth in TRUTH.items():
        one = found["posterior"][name]
        assert one["ci90"][0] < one["mean"] < one["ci90"][1]
        assert one["mean"] == pytest.approx(truth, rel=0.05)
    assert found["outside_simulated"] is False
    assert any("steady circle" in sentence for sentence in found["undetermined"])
    assert found["seconds"] > 0.0
    assert found["missing_effects"] == []
    assert found["gap_not_judged"] is None
    assert 600 <= found["diagnostics"]["simulations"] < 640
    assert set(found["diagnostics"]["sbc_p"]) == set(TRUTH)


def test_what_contradicts_itself_stands_first_in_text_and_json(result):
    wrong = Contradiction("encoder_scale", "a.csv: the wheels count 2.00 times the expected ticks", ())
    warned = replace(result, contradictions=(wrong,))
    assert warned.as_text().splitlines()[0] == f"warning: {wrong.message}"
    assert warned.all_warnings() == [f"warning: {wrong.message}", *result.warnings()]
    first, value = next(iter(warned.as_dict().items()))
    assert (first, value) == ("contradictions", [{"cause": wrong.cause, "message": wrong.message}])
    assert result.as_dict()["contradictions"] == []


def test_the_model_file_loads_and_holds_the_posterior(inferred):
    folder, result, _ = inferred
    model = load_model(folder / "model.toml")
    assert set(model.belief.names) == set(TRUTH)
    assert model.belief.mean() == pytest.approx(result.inference.belief.mean())
    assert model.name == "test"
    assert model.missing_effects == ()


def test_the_report_is_whole_in_one_file(inferred):
    folder, _, _ = inferred
    page = (folder / "report.html").read_text()
    assert 'src="http' not in page
    pictures = re.findall(r'<img alt="([^"]*)" src="data:image/png;base64,([^"]*)">', page)
    titles = ["Marginals and pairs of the posterior", "Posterior predictive check", "Simulation-based calibration"]
    assert [title for title, _ in pictures] == titles
    assert all(base64.b64decode(picture).startswith(b"\x89PNG") for _, picture in pictures)


def test_the_report_has_every_figure_of_the_diagnostics(inferred):
    folder, result, _ = inferred
    page, report = (folder / "report.html").read_text(), result.as_dict()
    numbers = report["diagnostics"]
    assert f"rests on {numbers['effective_simulations']:.0f}; seed 3" in page
    assert f"{numbers['simulations']} simulations" in page
    for name, p in numbers["sbc_p"].items():
        assert f"{name} p = {p:.2g}" in page
    for level, share in numbers["coverage"].items():
        assert f"<td class=n>{float(level):.0%}</td><td class=n>{share:.0%}</td>" in page
    for one in report["posterior"].values():
        assert f"{one['mean']:.5f}</td><td class=n>{one['sd']:.5f}" in page
    assert all(f"<p>{html.escape(sentence)}</p>" in page for sentence in report["undetermined"])
    assert "steady circle cannot tell the wheel radius" in page


@pytest.mark.long
def test_the_report_of_the_papers_way_says_what_its_statistics_cannot_tell(robot, tmp_path):
    log, report = write_log(tmp_path / "circle.csv"), tmp_path / "report.html"
    infer_command([log], robot, report=report, options=InferOptions(paper=True), search=finds())
    page = report.read_text()
    assert "the wheel radius is left open" in page
    assert "the wheel radius enters only through the angle at which the drive happens to end" in page
    assert "1000 simulations" in page
    assert "driven by commands" in page


@pytest.mark.thorough
def test_a_log_of_ours_gives_what_its_table_gives(robot, tmp_path):
    """To the microsecond that tables keep: the same poses, the same geometry."""
    log, ours = write_log(tmp_path / "poor.csv", "poor"), tmp_path / "poor.mcap"
    import_log(log, robot, ours)
    one, other = (infer_command([path], robot, options=FEW, search=finds()).inference for path in (log, ours))
    assert other.drive.source == "encoders"
    assert other.draws.mean(axis=0) == pytest.approx(one.draws.mean(axis=0), rel=1e-3)


def test_the_text_names_every_parameter_and_progress_is_told(inferred):
    _, result, progress = inferred
    text = result.as_text()
    assert all(name in text for name in TRUTH)
    assert "written in" in text
    assert "next: disco-hw gap" not in text
    assert progress[0] == ("round 1 of 5: 64 simulations", 0.0)
    shares = [share for _, share in progress]
    assert shares == sorted(shares)
    assert shares[-1] == 1.0


@pytest.fixture
def known(circle, result, monkeypatch):
    """A log whose inference is known."""
    monkeypatch.setattr(verb, "infer", lambda *_: result.inference)
    return circle


@pytest.mark.thorough
def test_a_log_unlike_the_simulations_is_warned_of_with_the_next_step(robot, tmp_path):
    log = write_log(tmp_path / "late.csv", "poor", 5, {"pose_latency": 0.2})
    text = infer_command([log], robot, options=FEW, search=finds()).as_text()
    assert "pose_latency" in text
    assert f"next: disco-hw gap {log} --robot {robot} -o gap" in text


@pytest.mark.thorough
def test_a_model_that_lacks_a_found_effect_is_marked_and_says_so(known, robot, tmp_path):
    model, report = tmp_path / "model.toml", tmp_path / "report.html"
    result = infer_command([known], robot, model, report, FEW, search=finds("motor_lag", "slope"))
    assert load_model(model).missing_effects == ("motor_lag", "slope")
    assert result.as_dict()["missing_effects"] == ["motor_lag", "slope"]
    assert "the robot shows motor_lag, slope, which the model lacks" in report.read_text()
    assert "`disco-hw run` refuses it without --accept-missing-effects" in result.as_text()
    assert f"next: disco-hw gap {known}" in result.as_text()


def test_the_next_step_can_be_pasted_where_paths_have_spaces():
    check = SimpleNamespace(disagreements=(), edge=(), unexplained=0.0, outside_simulated=False)
    logs = Path("my logs/a.csv"), Path("b.csv")
    inference = SimpleNamespace(predictive=check)
    result = verb.InferResult(inference, verb.GapCheck(("slope",)), logs, Path("my robot.toml"), None, 1.0)
    command = result.warnings()[-1].removeprefix("next: ").partition("  ")[0]
    assert shlex.split(command) == [
        "disco-hw", "gap", "my logs/a.csv", "b.csv", "--robot", "my robot.toml", "-o", "gap"
    ]  # fmt: skip


def test_a_log_that_the_search_cannot_judge_gives_a_model_with_a_warning(known, robot, tmp_path):
    search = finds(why_not_checked="too little to judge")
    result = infer_command([known], robot, tmp_path / "model.toml", options=FEW, search=search)
    assert load_model(tmp_path / "model.toml").missing_effects == ()
    assert "was not checked: too little to judge" in result.as_text()
    assert "next: disco-hw gap" not in result.as_text()


@pytest.mark.thorough
def test_several_logs_count_together(robot, tmp_path, result):
    logs = [write_log(tmp_path / f"{seed}.csv", "poor", seed) for seed in (1, 2)]
    together = infer_command(logs, robot, options=FEW, search=finds()).inference
    assert len(together.drive.run_pose) == 3
    assert together.drive.duration_s == pytest.approx(2 * 13.0, abs=4.0)
    assert result.inference.drive.run_pose.size == 2


def test_a_model_that_cannot_be_written_is_an_error_of_the_work(known, robot, tmp_path):
    def in_the_way(*given):
        (tmp_path / "file").write_text("")
        return finds()(*given)

    with pytest.raises(WorkError, match="cannot be written"):
        infer_command([known], robot, tmp_path / "file" / "model.toml", options=FEW, search=in_the_way)


def test_nothing_that_is_read_is_written_over(circle, robot, tmp_path):
    before = circle.read_bytes(), robot.read_bytes()
    for out, report in ((circle, None), (robot, None), (None, circle), (tmp_path / "new", tmp_path / "new")):
        with pytest.raises(InputError, match="is read here and would be overwritten; give another path"):
            infer_command([circle], robot, out, report, FEW, search=finds())
    assert (circle.read_bytes(), robot.read_bytes()) == before


def test_a_file_that_cannot_be_written_is_told_before_the_work(circle, robot):
    with pytest.raises(InputError, match=r"circle\.csv is not a directory; give another path"):
        infer_command([circle], robot, circle / "model.toml", options=FEW, search=finds())


def test_a_planner_is_compiled_for_the_model_that_was_written(tmp_path, monkeypatch):
    compiled_for = []
    monkeypatch.setattr(verb, "infer_command", lambda *_: SimpleNamespace(as_dict=dict, as_text=str))
    monkeypatch.setattr(run, "compile_beforehand", lambda robot_file, model, report: compiled_for.append(model))
    logs.infer([SHIPPED_ROBOT], SHIPPED_ROBOT, tmp_path)
    assert compiled_for == [tmp_path]
