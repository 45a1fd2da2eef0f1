"""Outputs: what cannot be written, or would destroy what is read, is refused before the work; JSON without NaN."""

import json
import math
from functools import partial
from pathlib import Path

import pytest

from disco_hw.cli.options import print_result
from disco_hw.cli.virtual import adapt, circle, pendulum
from disco_hw.errors import InputError
from disco_hw.reports import as_json, refuse_directory, refuse_file


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "drive.csv"
    path.write_text("kept")
    return path


def test_what_can_be_written_is_not_refused_and_nothing_is_made(tmp_path, file):
    refuse_directory(tmp_path / "some" / "where")
    refuse_directory(tmp_path, ["model.toml"], [file])
    refuse_file(tmp_path / "some" / "model.toml", [file])
    refuse_file(file)
    refuse_file(Path("model.toml"), [Path("nowhere.csv")])
    assert list(tmp_path.iterdir()) == [file]


def test_a_place_that_cannot_be_written_is_refused(monkeypatch, tmp_path, file):
    for path, fault in (
        (file, "exists and is not a directory"),
        (file / "deep" / "er", "drive.csv is not a directory"),
    ):
        with pytest.raises(InputError, match=fault):
            refuse_directory(path)
    with pytest.raises(InputError, match="is a directory; give the path of a file"):
        refuse_file(tmp_path)
    with pytest.raises(InputError, match=r"drive\.csv is not a directory"):
        refuse_file(file / "model.toml")
    monkeypatch.setattr("os.access", lambda path, mode: path != tmp_path)
    for refuse in (refuse_directory, refuse_file):
        with pytest.raises(InputError, match="cannot be written to; give another path"):
            refuse(tmp_path / "some" / "where")


def test_an_input_is_not_written_over_by_whatever_name(tmp_path, file):
    link = tmp_path / "link.csv"
    link.symlink_to(file)
    for path in (file, link, tmp_path / "." / ".." / tmp_path.name / "drive.csv"):
        with pytest.raises(InputError, match="is read here and would be overwritten"):
            refuse_file(path, [file])
    with pytest.raises(InputError, match="would be overwritten"):
        refuse_directory(tmp_path, ["drive.csv"], [link])
    with pytest.raises(InputError, match="would be overwritten"):
        refuse_file(tmp_path / "new", [tmp_path / "new"])


def test_an_experiment_looks_at_its_directory_first(file):
    for begin in (pendulum, partial(circle, None), partial(adapt, None)):
        with pytest.raises(InputError, match="exists and is not a directory"):
            begin(seeds=1, out=file)


def test_what_is_no_number_is_null(capsys):
    print_result({"std": math.nan, "limits": [1.0, math.inf], "ci": (0.5, -math.inf), "n": 1, "ok": True}, True, "")
    printed = capsys.readouterr().out
    assert printed == '{"std": null, "limits": [1.0, null], "ci": [0.5, null], "n": 1, "ok": true}\n'
    assert json.loads(as_json({"deep": [{"x": math.nan}]}, indent=1)) == {"deep": [{"x": None}]}
