"""`init` and `commission` offer to record the fence: a way round along the edge ends in robot.toml, others do not."""

from __future__ import annotations

from disco_hw.config import load_robot_config
from disco_hw.drive.drive_command import DriveOptions, DriveResult
from disco_hw.errors import InputError
from disco_hw.first_use.fence_drive import record_fence
from tests.first_use.miswired import robot_file

EDGE = ((-2.0, -1.5), (2.0, -1.5), (2.0, 1.5), (-2.0, 1.5))


class Operator:
    """Answers questions one after the other, and remembers them."""

    def __init__(self, *answers: str) -> None:
        self.answers, self.prompts = list(answers), list[str]()

    def __call__(self, prompt: str) -> str:
        self.prompts.append(prompt)
        return self.answers.pop(0)


class Recorder:
    """In the place of `disco-hw drive`: remembers what was asked of it, and names a log."""

    def __init__(self, log) -> None:
        self.log, self.drives = log, list[DriveOptions]()

    def __call__(self, options: DriveOptions) -> DriveResult:
        self.drives.append(options)
        return DriveResult(self.log, "stopped on request", True, {}, "")


def test_who_says_no_records_nothing(tmp_path):
    robot, drive = robot_file(tmp_path), Recorder(tmp_path / "none.mcap")
    before = robot.read_bytes()
    assert not record_fence(robot, Operator("n"), "push it", drive=drive)
    assert not drive.drives
    assert robot.read_bytes() == before


def test_a_way_round_is_written_as_the_fence_once_that_is_agreed_to(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("disco_hw.first_use.fence_drive.fence_of_log", lambda log: EDGE)
    robot, drive = robot_file(tmp_path), Recorder(tmp_path / "edge.mcap")
    assert not record_fence(robot, Operator("yes", "n"), "push it", drive=drive)
    assert load_robot_config(robot).fence.keep_in is None
    operator = Operator("y", "y")
    assert record_fence(robot, operator, "push it", "simulated", drive=drive)
    assert load_robot_config(robot).fence.keep_in == EDGE
    assert drive.drives[-1] == DriveOptions(robot, link="simulated")
    assert "once round along the edge" in operator.prompts[0]
    assert "write this into" in operator.prompts[1]
    assert "push it; Ctrl-D ends the recording" in capsys.readouterr().err


def test_a_way_that_makes_no_fence_says_so_and_can_be_driven_again(tmp_path, monkeypatch, capsys):
    ways = iter([None, EDGE])

    def made(log):
        found = next(ways)
        if found is None:
            raise InputError(f"{log}: the path ends 1.2 m from its start; drive once round, back to the start")
        return found

    monkeypatch.setattr("disco_hw.first_use.fence_drive.fence_of_log", made)
    robot, drive = robot_file(tmp_path), Recorder(tmp_path / "edge.mcap")
    operator = Operator("y", "y", "y")
    assert record_fence(robot, operator, "push it", drive=drive)
    assert len(drive.drives) == 2
    assert operator.prompts[1].startswith("once more?")
    assert "edge.mcap: the path ends 1.2 m from its start" in capsys.readouterr().err
    assert load_robot_config(robot).fence.keep_in == EDGE
