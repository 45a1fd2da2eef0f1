"""Where a drive is recorded to: inside log.directory, whatever the robot is called."""

from pathlib import Path

import msgspec
import pytest

from disco_hw.daemon import default_socket_path
from disco_hw.daemon.run import _log_path
from disco_hw.drive.drive_command import _new_log
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
    for path in (_log_path(config, None), _new_log(config)):
        assert path.parent == tmp_path
        path.write_bytes(b"")
        assert path.resolve().parent == tmp_path.resolve()
        path.unlink()
    assert default_socket_path(name).name == Path(default_socket_path(name).name).name
    assert "\0" not in str(default_socket_path(name))
