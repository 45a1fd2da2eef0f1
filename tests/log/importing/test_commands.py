import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import disco_hw
from disco_hw.errors import InputError
from disco_hw.log.errors import LogError
from disco_hw.log.importing.commands import import_log
from disco_hw.log.load import load_drive
from disco_hw.log.provenance import ROBOT_TOML
from disco_hw.log.reader import open_log
from disco_hw.log_setup import setup_of_log
from disco_hw.replay import replay
from tests.inference.drives import TICKS_PER_REV, write_log
from tests.inference.test_commands import ROBOT
from tests.log.importing.test_candump import dumped

ROBOTS = Path(disco_hw.__file__).parent / "robots"
NAMED = '[model]\nfile = "wombot_model.toml"\n[task]\npath = "eight.csv"\n'


@pytest.fixture
def robot(tmp_path):
    path = tmp_path / "robot.toml"
    path.write_text(ROBOT)
    return path


def test_a_csv_file_becomes_a_log_with_the_robots_file_in_it(robot, tmp_path):
    source, out = write_log(tmp_path / "log.csv", "poor"), tmp_path / "log.mcap"
    command = [sys.executable, "-m", "disco_hw", "import", str(source), "--robot", str(robot), "-o", str(out), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    told = json.loads(done.stdout)
    with open_log(out) as log:
        assert log.attachment(ROBOT_TOML) == robot.read_bytes()
        assert sum(topic.count for topic in log.summary().topics.values()) >= told["records"]
    assert np.array_equal(load_drive(out).poses.x_m, load_drive(source, TICKS_PER_REV).poses.x_m)


def test_a_candump_is_told_from_a_csv_file_by_its_content(robot, tmp_path):
    found = import_log(dumped(tmp_path / "dump.csv"), robot, tmp_path / "log.mcap")
    assert found.segments == 1
    assert found.duration_s == pytest.approx(9.95, abs=0.3)
    assert load_drive(found.out).poses.t_s.size > 190


def test_our_own_logs_need_no_import(robot, tmp_path):
    import_log(write_log(tmp_path / "log.csv", "poor"), robot, tmp_path / "log.mcap")
    with pytest.raises(LogError, match="an MCAP log; ours needs no import"):
        import_log(tmp_path / "log.mcap", robot, tmp_path / "again.mcap")


def test_what_cannot_be_opened_is_told(robot, tmp_path):
    with pytest.raises(LogError, match=r"cannot be opened \(No such file"):
        import_log(tmp_path / "none.csv", robot, tmp_path / "log.mcap")


def test_what_robot_toml_names_goes_into_the_log_so_that_the_page_shows_it(tmp_path):
    for name in ("wombot_model.toml", "eight.csv"):
        shutil.copy(ROBOTS / name, tmp_path)
    robot = tmp_path / "robot.toml"
    robot.write_text(ROBOT + NAMED)
    found = import_log(write_log(tmp_path / "log.csv", "poor"), robot, tmp_path / "log.mcap")
    assert found.notes == ()
    with open_log(found.out) as log:
        setup = setup_of_log(log, "name the robot")
        assert setup.model.axial_distance_m == 0.415
        assert len(setup.config.task.points) > 10


def test_what_robot_toml_names_and_is_not_there_is_told_now_and_when_it_is_missed(tmp_path):
    robot = tmp_path / "robot.toml"
    robot.write_text(ROBOT + NAMED)
    found = import_log(write_log(tmp_path / "log.csv", "poor"), robot, tmp_path / "log.mcap")
    assert [note.split(": ")[1] for note in found.notes] == ["model.file", "task.path"]
    with open_log(found.out) as log:
        assert log.attachment_names() == (ROBOT_TOML,)
        with pytest.raises(InputError, match=r"log\.mcap: carries no model\.toml, which its .* names; name it"):
            setup_of_log(log, "name it")


def test_a_copy_that_is_wrong_is_named_by_its_log(robot, tmp_path):
    robot.write_text(ROBOT + '[model]\nfile = "model.toml"\n')
    (tmp_path / "model.toml").write_text("format = 7\n")
    import_log(write_log(tmp_path / "log.csv", "poor"), robot, tmp_path / "log.mcap")
    with open_log(tmp_path / "log.mcap") as log, pytest.raises(InputError) as error:
        setup_of_log(log, "")
    assert str(error.value).startswith(f"{tmp_path}/log.mcap: model.toml: format: ")


def test_an_imported_log_cannot_be_replayed_and_says_so(robot, tmp_path):
    import_log(write_log(tmp_path / "log.csv", "poor"), robot, tmp_path / "log.mcap")
    with pytest.raises(InputError, match=r"log\.mcap: its commands are from 'import', .*only logs of `disco-hw run`"):
        replay(tmp_path / "log.mcap")
