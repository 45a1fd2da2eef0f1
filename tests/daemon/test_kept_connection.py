"""The connection that an e-stop goes over: no new descriptor, and a new one after the daemon was started again."""

import resource
from contextlib import closing, contextmanager

import pytest

from disco_hw.daemon.emergency import read_robot_toml, stop_robot
from disco_hw.daemon.kept_connection import KeptConnection
from disco_hw.errors import InputError, WorkError
from disco_hw.processes import DescriptorReserve, free_descriptors
from tests.viewer.test_operator_controls import Daemon


@contextmanager
def no_descriptors():
    """Nothing can be opened within the block."""
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (3, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)


def test_a_kept_connection_needs_no_descriptor_and_outlives_a_restart_of_the_daemon(tmp_path):
    daemon = Daemon(tmp_path / "run")
    with closing(KeptConnection(daemon.server.path)) as kept:
        kept.ensure_connected()
        # Accepted, in this same process.
        assert kept.request({"do": "status"}, 60.0)["ok"]
        with no_descriptors():
            assert all(kept.request({"do": "estop"}, 60.0)["ok"] for _ in range(3))
        daemon.close()
        with pytest.raises(WorkError, match="no daemon listens there"):
            kept.request({"do": "estop"}, 60.0)
        with closing(Daemon(tmp_path / "run")):
            assert kept.request({"do": "estop"}, 60.0)["ok"]


def test_a_reply_that_came_too_late_is_not_taken_for_the_next(tmp_path):
    with closing(Daemon(tmp_path / "run")) as daemon, closing(KeptConnection(daemon.server.path)) as kept:
        assert kept.request({"do": "status"}, 60.0)["ok"]
        daemon.hangs = True
        with pytest.raises(WorkError, match="no answer"):
            kept.request({"do": "status"}, 0.05)
        daemon.hangs = False
        assert kept.request({"do": "estop"}, 60.0)["do"] == "estop"


def test_a_reserve_gives_its_descriptors_to_the_block_alone():
    before = free_descriptors()
    reserve = DescriptorReserve(5)
    assert free_descriptors() == before - 5
    with reserve.released():
        assert free_descriptors() == before
    assert free_descriptors() == before - 5
    reserve.close()
    assert free_descriptors() == before


def test_the_stop_uses_what_robot_toml_said_before_where_it_cannot_be_read_now(tmp_path):
    robot = tmp_path / "robot.toml"
    robot.write_text('[robot]\nname = "x"\n[link]\nkind = "serial"\nport = "/dev/none"\n')
    kept = read_robot_toml(robot)
    robot.unlink()
    with pytest.raises(InputError, match="cannot be read"):
        stop_robot(robot)
    assert stop_robot(robot, None, kept).link == "/dev/none"
