"""Tests of where a drive is recorded: inside log.directory, whatever the robot is called."""

from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace

import msgspec
import pytest

from disco_hw.daemon import default_socket_path, run
from disco_hw.daemon.run import DaemonOptions, new_log, run_daemon
from disco_hw.drive.drive_command import DriveOptions, run_drive
from disco_hw.errors import InputError, WorkError
from disco_hw.runtime.core import TaskPilot
from disco_hw.runtime.robot_setup import load_setup
from tests.inference.drives import robot_config
from tests.runtime.simulated import ROBOT_FILE

NAMES = ["../../x", "/etc/x", "a\0b", "..", "x" * 64, "a/b", "\n", "ü" * 64, "~root"]


@pytest.mark.parametrize("name", NAMES)
def test_no_name_of_a_robot_leaves_the_directory(name, tmp_path):
    config = robot_config()
    config = msgspec.structs.replace(
        config,
        robot=msgspec.structs.replace(config.robot, name=name),
        log=msgspec.structs.replace(config.log, directory=str(tmp_path)),
    )
    for path in (new_log(config), new_log(config, "drive-")):
        assert path.parent == tmp_path
        path.write_bytes(b"")
        assert path.resolve().parent == tmp_path.resolve()
        path.unlink()
    assert default_socket_path(name).name == Path(default_socket_path(name).name).name
    assert "\0" not in str(default_socket_path(name))


def test_a_name_that_is_taken_is_counted_on(tmp_path, monkeypatch):
    """As after a power cut, where no clock has run on: the same second comes again."""
    monkeypatch.setattr(run, "datetime", SimpleNamespace(now=lambda _: datetime(2026, 1, 2, tzinfo=UTC)))
    config = robot_config()
    config = msgspec.structs.replace(config, log=msgspec.structs.replace(config.log, directory=str(tmp_path)))
    first = new_log(config)
    names = []
    for _ in range(3):
        path = new_log(config)
        path.write_bytes(b"")
        names.append(path.name)
    assert names == [first.name, f"{first.stem}-2.mcap", f"{first.stem}-3.mcap"]
    assert new_log(config, directory=tmp_path / "other") == tmp_path / "other" / first.name


def test_a_log_that_cannot_be_made_now_is_no_bad_input(tmp_path, monkeypatch):
    """As on a full disk: the service is started again, when there may be room."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(WorkError, match=r"file.*cannot be created.*give another path with --log$"):
        run.serve(load_setup(ROBOT_FILE), tmp_path / "file" / "run.mcap", lambda topic, text: None, TaskPilot())


@pytest.mark.parametrize(("verb", "options"), [(run_daemon, DaemonOptions), (run_drive, DriveOptions)])
@pytest.mark.parametrize("name", ["a\nb.mcap", "a\0b.mcap", "a\x1b[2J.mcap"])
def test_a_log_file_whose_name_breaks_lines_is_refused_before_anything_is_opened(verb, options, name, tmp_path):
    with pytest.raises(InputError, match=r"^--log '.*': holds .* character.*; give another name$"):
        verb(options(robot=tmp_path / "robot.toml", log_file=tmp_path / name))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("verb", "options"), [(run_daemon, DaemonOptions), (run_drive, DriveOptions)])
def test_a_log_file_that_exists_is_refused_before_anything_is_opened(verb, options, tmp_path):
    log = tmp_path / "run.mcap"
    log.write_bytes(b"")
    with pytest.raises(InputError, match=r"^--log .*run\.mcap: already exists; give another name$"):
        verb(options(robot=tmp_path / "robot.toml", log_file=log))
