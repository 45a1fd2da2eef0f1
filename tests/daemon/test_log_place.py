"""Tests of where a drive is recorded: inside log.directory, whatever the robot is called."""

from pathlib import Path

import msgspec
import pytest

from disco_hw.daemon import default_socket_path
from disco_hw.daemon.run import DaemonOptions, new_log, run_daemon
from disco_hw.drive.drive_command import DriveOptions, run_drive
from disco_hw.errors import InputError
from tests.inference.drives import robot_config

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


@pytest.mark.parametrize(("run", "options"), [(run_daemon, DaemonOptions), (run_drive, DriveOptions)])
@pytest.mark.parametrize("name", ["a\nb.mcap", "a\0b.mcap", "a\x1b[2J.mcap"])
def test_a_log_file_whose_name_breaks_lines_is_refused_before_anything_is_opened(run, options, name, tmp_path):
    with pytest.raises(InputError, match=r"^--log '.*': holds .* character.*; give another name$"):
        run(options(robot=tmp_path / "robot.toml", log_file=tmp_path / name))
    assert not list(tmp_path.iterdir())
