"""`disco-hw drive`: what is refused before anything is opened, and how a drive is summed up."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import pytest

from disco_hw.drive.drive_command import DriveOptions, DriveResult, run_drive
from disco_hw.errors import InputError
from tests.runtime.simulated import write_ticks
from tools.stack import write_robot_file
from tools.viewer_run import tick_records


@pytest.mark.parametrize(
    ("options", "expected_error"),
    [
        ({"script": "dance"}, "--script dance: no such script; write one of circle, steps, excite"),
        ({"unattended": True}, "--unattended and --seconds belong to a script"),
        ({"seconds": 3.0}, "--unattended and --seconds belong to a script"),
        ({"script": "steps", "unattended": True, "gamepad": True}, "only one deadman"),
        ({"gamepad": True, "page": True}, "--gamepad and --page: only one deadman"),
        ({"link": "wifi"}, "--link wifi"),
    ],
)
def test_wrong_options_get_one_line(tmp_path, options, expected_error):
    with pytest.raises(InputError, match=re.escape(expected_error)) as caught:
        run_drive(DriveOptions(write_robot_file(tmp_path), **options))
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "control.sock").exists()


@pytest.mark.parametrize(
    ("interface", "expected_error"), [("socketcan", "link.interface socketcan"), ("serial", "link.port /dev/ttyUSB0")]
)
def test_nobody_drives_a_robot_that_may_be_real_unattended(tmp_path, interface, expected_error):
    robot = write_robot_file(tmp_path)
    text = robot.read_text()
    if interface == "serial":
        text = re.sub(r"(?m)^port = .*$", 'port = "/dev/ttyUSB0"', text)
    else:
        text = re.sub(r"(?m)^interface = .*$", 'interface = "socketcan"', text)
    robot.write_text(text)
    link = "serial" if interface == "serial" else None
    with pytest.raises(InputError, match=f"^--unattended: {expected_error}.* may lead to a real robot; hold a deadman"):
        run_drive(DriveOptions(robot, link=link, script="steps", unattended=True))


def test_without_a_terminal_one_line_says_what_to_use(tmp_path, monkeypatch):
    with (tmp_path / "nothing").open("w+b") as file:
        monkeypatch.setattr("disco_hw.drive.drive_command.STANDARD_INPUT", file.fileno())
        with pytest.raises(InputError, match="not a terminal; use a terminal, --gamepad or --script with --unattended"):
            run_drive(DriveOptions(write_robot_file(tmp_path)))


def test_a_gamepad_that_is_not_there_gets_one_line(tmp_path):
    robot = write_robot_file(tmp_path)
    robot.write_text(robot.read_text() + f'[drive]\ngamepad_device = "{tmp_path / "event0"}"\n')
    with pytest.raises(InputError, match=r"--gamepad: .*event0: cannot be opened"):
        run_drive(DriveOptions(robot, gamepad=True))


def test_the_terminal_is_put_back_when_the_daemon_cannot_start(tmp_path, monkeypatch):
    import termios

    master, slave = os.openpty()
    before = termios.tcgetattr(slave)
    monkeypatch.setattr("disco_hw.drive.drive_command.STANDARD_INPUT", slave)
    robot = write_robot_file(tmp_path)
    (tmp_path / "control.sock").write_text("in the way")
    with pytest.raises(InputError, match="not a socket"):
        run_drive(DriveOptions(robot, as_json=True))
    assert termios.tcgetattr(slave) == before
    os.close(master)
    os.close(slave)


def test_the_result_is_for_people_and_machines():
    result = DriveResult(Path("a.mcap"), "script circle completed", True, {"missing": ["rest"]}, "1 of 2")
    assert result.as_text() == "script circle completed\n1 of 2\nlog a.mcap"
    assert json.loads(json.dumps(result.as_dict()))["log"] == "a.mcap"


@pytest.mark.parametrize("notification", [("event", "armed"), ("recording", "the log writer died (signal 9)")])
def test_a_drive_whose_log_is_not_whole_is_not_completed(tmp_path, monkeypatch, notification):
    monkeypatch.setattr(
        "disco_hw.drive.drive_command.serve", lambda _setup, _log, notify, _pilot, **_: notify(*notification)
    )
    result = run_drive(DriveOptions(write_robot_file(tmp_path), page=True, as_json=True))
    is_complete = notification[0] != "recording"
    assert result.completed is is_complete
    assert ("LOG NOT COMPLETE: the log writer died" in result.as_text()) is not is_complete
    assert result.as_dict()["recording_errors"] == (() if is_complete else (notification[1],))


def test_a_drive_of_whose_ticks_some_are_in_no_file_is_not_completed(tmp_path, monkeypatch):
    """A full log goes on in another file, which may not have all that it should."""
    log = tmp_path / "drive.mcap"

    def served(_setup, path, _notify, _pilot, **_options):
        write_ticks(path, map(tick_records, range(60)))
        return 1

    monkeypatch.setattr("disco_hw.drive.drive_command.serve", served)
    result = run_drive(DriveOptions(write_robot_file(tmp_path), page=True, as_json=True, log_file=log))
    assert not result.completed
    assert "LOG NOT COMPLETE: not every tick is in its file" in result.as_text()


@pytest.mark.parametrize("cut_off", [0, 40])
def test_a_writer_that_was_slow_has_lost_nothing_where_the_log_proves_it(tmp_path, monkeypatch, cut_off):
    log = tmp_path / "drive.mcap"
    pauses = "the log writer has not answered for 0.8 s; new ticks are kept until it does"

    def served(_setup, path, notify, _pilot, **_options):
        write_ticks(path, map(tick_records, range(60)))
        os.truncate(path, path.stat().st_size - cut_off)
        notify("recording", pauses)

    monkeypatch.setattr("disco_hw.drive.drive_command.serve", served)
    result = run_drive(DriveOptions(write_robot_file(tmp_path), page=True, as_json=True, log_file=log))
    assert result.completed is not bool(cut_off)
    assert result.recording_errors == ((pauses,) if cut_off else ())
