import json

import numpy as np
import pytest

from disco_hw.errors import InputError, LogError
from disco_hw.log import ROBOT_TOML
from disco_hw.log.importing import import_log
from disco_hw.log.load import load_drive
from disco_hw.log.reader import open_log
from disco_hw.runtime.replay import replay
from disco_hw.runtime.robot_setup import setup_of_log
from disco_hw.viewer.recording import Recording
from tests.inference.drives import ROBOT, TICKS_PER_REV, write_log
from tests.log.importing.commands import call
from tests.log.importing.test_candump import dumped


@pytest.fixture
def imported(robot, tmp_path):
    """The log of a drive, whose robot names a model that the log lacks."""
    robot.write_text(ROBOT + '[model]\nfile = "model.toml"\n')
    return import_log(write_log(tmp_path / "log.csv", "poor"), robot, tmp_path / "log.mcap").out


def test_a_csv_file_becomes_a_log_with_the_robots_file_in_it(robot, tmp_path):
    source, out = write_log(tmp_path / "log.csv", "poor"), tmp_path / "log.mcap"
    reported = json.loads(call("import", source, "--robot", robot, "-o", out, "--json"))
    with open_log(out) as log:
        assert log.attachment(ROBOT_TOML) == robot.read_bytes()
        assert sum(topic.count for topic in log.summary().topics.values()) >= reported["records"]
    assert np.array_equal(load_drive(out).poses.x_m, load_drive(source, TICKS_PER_REV).poses.x_m)


def test_a_candump_is_distinguished_from_a_csv_file_by_its_content(robot, tmp_path):
    found = import_log(dumped(tmp_path / "dump.csv"), robot, tmp_path / "log.mcap")
    assert found.segments == 1
    assert found.duration_s == pytest.approx(9.95, abs=0.3)
    assert load_drive(found.out).poses.t_s.size > 190


def test_the_date_of_a_csv_file_and_of_a_candump_is_kept(robot, tmp_path):
    """A clock that counts from another time has no date, and a time beyond those of a log none that can be kept."""

    def start_of(path):
        with open_log(import_log(path, robot, path.with_suffix(".mcap")).out) as log:
            return log.summary().start[:16]

    def sheet(name, begin_s):
        rows = [f"{begin_s + 0.02 * k:.2f},1,1,2,2" for k in range(100)]
        header = "t_s,cmd_left_rad_s,cmd_right_rad_s,enc_left_rad_s,enc_right_rad_s"
        (tmp_path / name).write_text("\n".join([header, *rows]))
        return tmp_path / name

    assert start_of(sheet("a.csv", 1.7e9)) == start_of(dumped(tmp_path / "b.log")) == "2023-11-14T22:13"
    assert start_of(sheet("c.csv", 5.0)) == start_of(sheet("d.csv", 1e12)) == "1970-01-01T00:00"


def test_our_own_logs_need_no_import(imported, robot, tmp_path):
    with pytest.raises(LogError, match="an MCAP log; a log of disco-hw needs no import"):
        import_log(imported, robot, tmp_path / "again.mcap")


def test_what_cannot_be_opened_is_reported(robot, tmp_path):
    with pytest.raises(InputError, match=r"cannot be read \(No such file"):
        import_log(tmp_path / "none.csv", robot, tmp_path / "log.mcap")


def test_a_file_that_the_logs_robot_names_and_the_log_lacks_is_reported(imported):
    with (
        open_log(imported) as log,
        pytest.raises(InputError, match=r"log\.mcap: carries no model\.toml, which its robot\.toml names; do this"),
    ):
        setup_of_log(log, "do this")


def test_nothing_of_an_imported_log_can_be_shown_and_that_is_said_whatever_it_carries(imported):
    with pytest.raises(InputError, match="holds no estimates, so there is nothing to show"):
        Recording(imported)


def test_an_imported_log_cannot_be_replayed_and_says_so(imported):
    with pytest.raises(InputError, match=r"log\.mcap: its commands are from 'import', .*only logs of `disco-hw run`"):
        replay(imported)
