"""docs/results.md: its last part is what the kept figures make, and every row before names its command."""

import json
import re

import pytest

from tools import results

ROWS = [
    [cell.strip() for cell in line.strip("|").split("|")]
    for line in results.PAGE.read_text("utf-8").split(results.BEGIN)[0].splitlines()
    if line.startswith("| ") and not line.startswith("| what")
]
BENCH = {
    "machine": {"date": "1 Jan 2026", "commit": "abc", "cpu": "a", "cores": 2, "python": "3.11", "load": 0.5},
    "parts": {"bench_wire": ["wire.command_us"], "bench_log": ["log.us"]},
    "figures": {"wire.command_us": 12.3456, "log.us": 7.0},
}


def test_the_page_is_what_the_kept_figures_make():
    kept = json.loads(results.KEPT.read_text("utf-8"))
    page = results.PAGE.read_text("utf-8")
    assert kept
    assert results.written(page, kept) == page


def test_each_part_of_a_bench_has_its_command_and_a_new_run_takes_the_place_of_the_old(tmp_path, monkeypatch):
    page, kept = tmp_path / "results.md", tmp_path / "figures.json"
    page.write_text(f"above\n{results.BEGIN}\nold\n{results.END}\nbelow\n", "utf-8")
    monkeypatch.setattr(results, "PAGE", page)
    monkeypatch.setattr(results, "KEPT", kept)
    file = tmp_path / "bench.json"
    for value in (12.3456, 9.0):
        file.write_text(json.dumps({**BENCH, "figures": {"wire.command_us": value, "log.us": 7.0}}), "utf-8")
        assert results.main([str(file)]) == 0
    text = page.read_text("utf-8")
    assert (
        "### `make bench PARTS=bench_wire`\n\n1 Jan 2026, `abc`, a, 2 cores, Python 3.11, load 0.5 at the end." in text
    )
    assert "| `wire.command_us` | 9 |" in text
    assert "12.35" not in text
    assert text.startswith("above\n")
    assert text.endswith("\nbelow\n")
    assert "old" not in text


def test_a_study_needs_its_command_and_keeps_what_is_a_number():
    study = {"revision": "f00", "figures": {"right": 198, "share": None, "yes": True, "bad": float("nan")}}
    with pytest.raises(ValueError, match="--shown-by"):
        results.runs_of(study, None)
    (run,) = results.runs_of(study, "make gap-study").values()
    assert run["figures"] == {"right": 198}
    assert run["commit"] == "f00"


def test_what_a_command_has_printed_as_json_is_kept_number_by_number():
    printed = {"rms_m": 0.0075, "loop": {"overruns": 0, "late_us": {"p99": 3.5}}, "ok": True, "log": "a", "x": [1, 2]}
    ((command, run),) = results.runs_of(printed, "disco-hw demo --json").items()
    assert command == "disco-hw demo --json"
    assert run["figures"] == {"rms_m": 0.0075, "loop.overruns": 0, "loop.late_us.p99": 3.5}


def test_a_part_says_how_long_it_took_and_what_else_the_machine_did():
    about = {**BENCH["machine"], "load_before": 0.25}
    runs = results.runs_of({**BENCH, "machine": about, "took_s": {"bench_wire": 61.2}}, None)
    text = results.measured(runs)
    assert "load 0.25 before and 0.5 at the end. It took 61 s.\n" in text
    assert text.count("It took") == 1


def test_the_quantiles_of_a_figure_stand_in_one_row_in_their_order():
    figures = {"wire.us.p50": 1.5, "wire.us.p99": 20.0, "wire.us.p99.9": 300.0, "wire.p5x": 4.0}
    text = results.measured({"make bench": {**BENCH["machine"], "figures": figures}})
    assert "| `wire.us` | p50 1.5, p99 20, p99.9 300 |\n| `wire.p5x` | 4 |" in text


def test_a_file_without_figures_is_one_line(tmp_path, capsys):
    file = tmp_path / "x.json"
    file.write_text("{}", "utf-8")
    assert results.main([str(file)]) == 2
    assert "no figures" in capsys.readouterr().err


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0][:40])
def test_every_figure_in_words_has_its_day_and_a_command_that_is_there(row):
    what, _, noted, shown_by = row
    assert re.match(r"\d+ \w{3} `[0-9a-f]{7}`", noted), what
    gone = re.findall(r"`(tools/[\w/]+\.py)[^`]*` of `[0-9a-f]{7}`", shown_by)
    assert not [tool for tool in gone if (results.ROOT / tool).exists()], what
    commands = [] if gone else re.findall(r"`([^`]+)`", re.sub(r" of `[0-9a-f]{7}`", "", shown_by))
    assert commands or gone, what
    targets = set(re.findall(r"^([a-z][\w\-]*):", (results.ROOT / "Makefile").read_text("utf-8"), re.MULTILINE))
    for command in commands:
        parts = command.removeprefix("sudo ").split()
        if parts[0] == "make":
            assert {part for part in parts[1:] if "=" not in part} <= targets, command
        elif parts[:2] == ["python", "-m"]:
            assert (results.ROOT / (parts[2].replace(".", "/") + ".py")).exists(), command
        elif parts[0] == "pytest":
            assert all((results.ROOT / part).exists() for part in parts[1:] if part.startswith("tests/")), command
        else:
            assert parts[0] == "disco-hw", command
