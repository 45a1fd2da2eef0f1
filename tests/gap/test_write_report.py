"""What the command hands to the search, and what it makes of a fleet's logs."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from typer.testing import CliRunner

from disco_hw import gap
from disco_hw.cli import app, logs
from disco_hw.config import SHIPPED_ROBOT, load_robot_config
from disco_hw.daemon import run
from disco_hw.effects.registry import REGISTRY
from disco_hw.errors import InputError, LogError
from disco_hw.gap.report import STAGES, EffectFinding, FleetRow, GapReport, LowConfidence, UnnamedFinding
from disco_hw.gap.search.channel_result import ParameterEstimate
from disco_hw.gap.search.cross_validation import PredictionErrors
from disco_hw.log.importing import write_log
from disco_hw.model import EffectSetting, Model, save_model
from tools.gap.strange_robot import record
from tools.joystick import joystick


class EnoughError(Exception):
    """Ends the command where the search would begin."""


def test_the_search_knows_what_the_robot_can_do(monkeypatch, tmp_path):
    handed = SimpleNamespace()

    def search(*_, **options):
        vars(handed).update(options)
        raise EnoughError

    monkeypatch.setattr(gap, "load_drive", lambda *_: None)
    monkeypatch.setattr(gap, "find_gap", search)
    with pytest.raises(EnoughError):
        gap.gap([], SHIPPED_ROBOT, tmp_path)
    assert handed.top_rad_s == load_robot_config(SHIPPED_ROBOT).robot.max_wheel_speed_rad_s


def test_a_directory_that_cannot_be_used_is_refused_before_the_search(monkeypatch, tmp_path):
    def search(*_, **__):
        raise EnoughError

    monkeypatch.setattr(gap, "load_drive", search)
    robot, given = SHIPPED_ROBOT, tmp_path / "model.toml"
    given.write_bytes((robot.parent / "wombot_model.toml").read_bytes())
    with pytest.raises(InputError, match="exists and is not a directory"):
        gap.gap([], robot, given)
    with pytest.raises(InputError, match=r"model\.toml: is read here and would be overwritten"):
        gap.gap([], robot, tmp_path, given)
    with pytest.raises(EnoughError):
        gap.gap([], robot, tmp_path / "gap", given)


def robot_with_model(directory, name):
    """A robot.toml whose model of this name has a dead band."""
    model = replace(Model(0.06, 0.4), effects=(EffectSetting("deadband", {"width_rad_s": 0.8}),))
    (directory / name).parent.mkdir(exist_ok=True)
    save_model(model, directory / name)
    robot = directory / "robot.toml"
    robot.write_text(SHIPPED_ROBOT.read_text("utf-8").replace("wombot_model.toml", name), "utf-8")
    return robot


def test_the_search_starts_from_robot_toml_s_model_unless_another_is_given(monkeypatch, tmp_path):
    handed = []

    def search(_, model, *__, **___):
        handed.append([setting.name for setting in model.effects])
        return report_of("motor_lag", 0.02, 0.01)

    monkeypatch.setattr(gap, "load_drive", lambda *_: None)
    monkeypatch.setattr(gap, "find_gap", search)
    robot, other = robot_with_model(tmp_path, "known.toml"), SHIPPED_ROBOT.parent / "wombot_model.toml"
    used = [gap.gap([], robot, tmp_path / "out", model).report.provenance for model in (None, other)]
    assert [one.model_file for one in used] == [str(tmp_path / "known.toml"), str(other)]
    gap.gap_fleet([tmp_path / "a.csv"], robot, tmp_path / "fleet")
    assert handed == [["deadband"], [], ["deadband"]]


def test_robot_toml_s_model_is_not_written_over(monkeypatch, tmp_path):
    monkeypatch.setattr(gap, "load_drive", lambda *_: None)
    refusal = r"model\.toml: is read here and would be overwritten"
    with pytest.raises(InputError, match=refusal):
        gap.gap([], robot_with_model(tmp_path, "model.toml"), tmp_path)
    with pytest.raises(InputError, match=refusal):
        gap.gap_fleet([tmp_path / "run.csv"], robot_with_model(tmp_path, "run/model.toml"), tmp_path)


def report_of(name, timed_m, amended_m, offered="amended"):
    """A report that found one effect, a form without a name and a doubt, with errors that its name tells apart."""
    sizes = dict(zip(STAGES, (0.09, 0.08, timed_m, amended_m, 0.004), strict=True))

    def errors(stage, ahead_s):
        at = 0.5 * ahead_s * sizes[stage]
        return PredictionErrors(at, (at, at), 2.0 * at, (at, at), 0.1, {})

    gap = {stage: {ahead_s: errors(stage, ahead_s) for ahead_s in (0.5, 1.0, 2.0, 5.0)} for stage in STAGES}
    effect = EffectFinding(
        name, "command_to_wheel", {REGISTRY[name].parameters[0].name: ParameterEstimate(0.1234, 0.1, 0.15)}, 50.0
    )
    values = {p.name: p.start for p in REGISTRY[name].parameters}
    effects = (EffectSetting(name, values),) if offered == "amended" else ()
    return GapReport(
        (name,), (), (effect,), (UnnamedFinding("wheel_to_body", "v_x += 3 v", 30.0),), (), gap,
        Model(0.06, 0.4, effects=effects), 1.0, offered, doubtful=(LowConfidence("slope", "at its bound"),),
    )  # fmt: skip


@pytest.fixture
def fleet(monkeypatch, tmp_path):
    """Three logs, two of one name and one too short, and the reports that a search would make of them."""
    logs = [tmp_path / "monday" / "drive.mcap", tmp_path / "tuesday" / "drive.mcap", tmp_path / "short.mcap"]
    for log in logs:
        log.parent.mkdir(exist_ok=True)
        log.write_bytes(b"a log")
    reports = {logs[0]: report_of("motor_lag", 0.020, 0.010), logs[1]: report_of("deadband", 0.030, 0.040, "timed")}

    def search(log, *_, **__):
        if log not in reports:
            raise LogError(f"{log}: too little to judge")
        return reports[log]

    monkeypatch.setattr(gap, "load_drive", lambda paths, *_: paths[0])
    monkeypatch.setattr(gap, "find_gap", search)
    return logs


def test_a_fleet_ends_in_one_table_with_a_row_for_each_log(fleet, tmp_path):
    out = tmp_path / "out"
    said = []
    result = gap.gap_fleet(fleet, SHIPPED_ROBOT, out, progress=said.append)
    head, monday, tuesday, short = (out / "fleet.txt").read_text().splitlines()
    assert head.split() == ["log", "found", "doubtful", "ahead", "timed", "offered", "floor", "model"]
    assert monday.split("  ")[0] == str(fleet[0])
    # Offered is what model.toml holds, and errors are told where the answer looks: 2 s ahead.
    columns = [head.index(f"  {name}") + 2 for name in head.split()[1:]]
    # What could not be judged makes no column wider.
    assert columns[1] - columns[0] == len("motor_lag 0.123; v_x += 3 v") + 2
    cut = [
        ", ".join(line[a:b].strip() for a, b in zip(columns, [*columns[1:], None], strict=True))
        for line in (monday, tuesday)
    ]
    assert cut == [
        "motor_lag 0.123; v_x += 3 v, slope, 2 s, 20.0 mm 40 mrad, 10.0 mm 20 mrad, 4.0 mm 8 mrad, amended",
        "deadband 0.123; v_x += 3 v, slope, 2 s, 30.0 mm 60 mrad, 30.0 mm 60 mrad, 4.0 mm 8 mrad, timed",
    ]
    assert short.endswith(f"not judged: {fleet[2]}: too little to judge")
    assert result.as_text().startswith(head)
    assert [text.partition(":")[0] for text in said] == ["1 of 3", "2 of 3", "3 of 3"]


def test_a_fleet_s_json_has_the_numbers_and_every_log_its_report(fleet, tmp_path):
    out = tmp_path / "out"
    answer = CliRunner().invoke(
        app(), ["gap", *map(str, fleet), "--robot", str(SHIPPED_ROBOT), "-o", str(out), "--fleet", "--json"]
    )
    assert answer.exit_code == 0, answer.output
    content = json.loads((out / "fleet.json").read_text())
    assert json.loads(answer.stdout) == content
    monday, tuesday, short = content["logs"]
    assert monday["effects"] == {"motor_lag": {"tau_s": [0.1234, 0.1, 0.15]}}
    assert (monday["verdict"], monday["unnamed"], monday["doubtful"]) == ("effects_found", ["v_x += 3 v"], ["slope"])
    assert (monday["horizon_s"], monday["judged_by"], monday["offered"]) == (2.0, "poses", "amended")
    assert monday["held_out"]["amended"]["position_rmse_m"] == pytest.approx(0.010)
    assert tuesday["held_out"]["timed"]["yaw_rmse_rad"] == pytest.approx(0.060)
    assert short == {"log": str(fleet[2]), "verdict": "not_judged", "why_not": f"{fleet[2]}: too little to judge"}
    assert [Path(row["directory"]).name for row in (monday, tuesday)] == ["drive-1", "drive-2"]
    for row, name in ((monday, "motor_lag"), (tuesday, "deadband")):
        assert json.loads((Path(row["directory"]) / "report.json").read_text())["effects"][0]["name"] == name
        assert (Path(row["directory"]) / "model.toml").exists()
    assert not (out / "short").exists()


def test_no_two_logs_of_a_fleet_share_a_directory(monkeypatch, tmp_path):
    monkeypatch.setattr(gap, "load_drive", lambda paths, *_: paths[0])
    monkeypatch.setattr(gap, "find_gap", lambda *_, **__: report_of("motor_lag", 0.02, 0.01))
    logs = [tmp_path / name for name in ("a/run.csv", "b/run.csv", "c/run-2.csv", "d/run-2-1.csv", "e/run.csv")]
    places = [row.directory.name for row in gap.gap_fleet(logs, SHIPPED_ROBOT, tmp_path / "out").rows]
    assert places == ["run-1", "run-3", "run-2", "run-2-1", "run-4"]


def test_reports_of_a_fleet_are_written_over_no_log(fleet, tmp_path):
    inside = tmp_path / "out" / "drive" / "model.toml"
    inside.parent.mkdir(parents=True)
    inside.write_bytes(b"a log too")
    with pytest.raises(InputError, match="is read here and would be overwritten"):
        gap.gap_fleet([fleet[0], inside], SHIPPED_ROBOT, tmp_path / "out")


def test_a_log_of_a_fleet_without_poses_is_told_by_its_wheels():
    found = report_of("motor_lag", 0.020, 0.010)
    wheels = {stage: found.gap[stage] for stage in ("nominal", "timed", "amended")}
    bare = replace(found, gap={}, wheels=wheels, effects=(), unnamed=(), doubtful=(), offered="refitted")
    row = FleetRow(Path("lifted.mcap"), Path("out/lifted"), bare)
    assert row.cells() == (
        "lifted.mcap", "nothing", "-", "2 s", "20.0 mm 40 mrad", "90.0 mm 180 mrad", "-", "refitted",
    )  # fmt: skip
    assert row.as_dict()["judged_by"] == "wheels"
    assert row.as_dict()["held_out"]["timed"]["position_rmse_m"] == pytest.approx(0.020)


@pytest.mark.parametrize(("offered", "shown"), [("amended", "80.0 mm 160 mrad"), ("timed", "20.0 mm 40 mrad")])
def test_a_fleet_shows_the_errors_of_the_model_that_is_in_the_directory(offered, shown):
    found = report_of("motor_lag", 0.020, 0.010, offered)
    whole = replace(found, gap=found.gap | {"written": found.gap["refitted"]})
    for judged in (whole, replace(whole, gap={}, wheels=whole.gap)):
        assert FleetRow(Path("drive.mcap"), Path("out/drive"), judged).cells()[5] == shown


def test_a_planner_is_compiled_for_the_model_that_was_written(tmp_path, monkeypatch):
    compiled_for = []
    monkeypatch.setattr(gap, "gap", lambda *_: SimpleNamespace(as_dict=dict, as_text=str))
    monkeypatch.setattr(run, "compile_beforehand", lambda robot_file, model, report: compiled_for.append(model))
    logs.gap([SHIPPED_ROBOT], SHIPPED_ROBOT, tmp_path)
    assert compiled_for == [tmp_path / "model.toml"]


# Each worker imports and compiles the search anew.
@pytest.mark.long
@pytest.mark.timeout(900)
def test_a_cluster_makes_the_same_table(tmp_path):
    distributed = pytest.importorskip("distributed")
    logs = [tmp_path / f"drive{seed}.mcap" for seed in (1, 2)]
    for seed, log in enumerate(logs, 1):
        write_log(record("hysteresis", seed, joystick(seed, 40.0)).log, log, "strange")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, host="127.0.0.1", dashboard_address=None
    ) as cluster:
        cluster.wait_for_workers(2)
        address = ["--dask", cluster.scheduler_address]
        answer = CliRunner().invoke(
            app(), ["gap", *map(str, logs), "--robot", str(SHIPPED_ROBOT), "-o", str(tmp_path / "far"), *address]
        )
    assert answer.exit_code == 0, answer.output
    here = gap.gap_fleet(logs, SHIPPED_ROBOT, tmp_path / "here")
    assert (tmp_path / "far" / "fleet.txt").read_text() == (tmp_path / "here" / "fleet.txt").read_text()
    assert here.table() in answer.output
    assert (tmp_path / "far" / "drive2" / "report.html").stat().st_size > 10_000
