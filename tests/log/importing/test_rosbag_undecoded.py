"""Messages of a bag whose bytes are damaged: each costs itself, and no other message and no other topic."""

import pytest

from disco_hw.log.importing.losses import WARNING
from disco_hw.log.importing.rosbag import read_rosbag
from tests.inference.drives import logged, robot_config
from tests.log.importing.bags import Maker, recorded
from tests.log.refusals import refused
from tests.tables import thinned

MESSAGES = 400
"""Wheel samples of the drive."""


def record_damaged(path, monkeypatch, topic, every, storage="mcap"):
    """A bag of which every so-many-th message of a topic is cut to 20 bytes; all but these where it is negative."""
    written = {}

    def write(self, name, message, log_ns):
        kind = message.__msgtype__
        if name not in self.connections:
            self.connections[name] = self.writer.add_connection(name, kind, typestore=self.store)
        raw = self.store.serialize_ros1(message, kind) if self.ros1 else self.store.serialize_cdr(message, kind)
        written[name] = written.get(name, 0) + 1
        is_damaged = name == topic and (written[name] % every == 0) is (every > 0)
        self.writer.write(self.connections[name], int(log_ns), raw[:20] if is_damaged else raw)

    with monkeypatch.context() as patched:
        patched.setattr(Maker, "write", write)
        recorded(path, storage)


@thinned(("every", "undecoded", "is_warned"), [(10, 40, True), (200, 2, False), (3, 133, True)], quick=1)
def test_a_message_that_cannot_be_decoded_is_left_out_and_counted(tmp_path, monkeypatch, every, undecoded, is_warned):
    record_damaged(tmp_path / "b", monkeypatch, "/joint_states", every)
    drive = read_rosbag(tmp_path / "b", robot_config())
    assert drive.wheels.t_s.size == MESSAGES - undecoded
    assert drive.poses.t_s.size == 187
    (note,) = (note for note in drive.notes if "cannot be decoded" in note)
    assert f"/joint_states: {undecoded} of {MESSAGES} messages" in note
    assert note.startswith(WARNING) is is_warned


def test_a_topic_of_which_most_cannot_be_decoded_is_refused(tmp_path, monkeypatch):
    record_damaged(tmp_path / "b", monkeypatch, "/joint_states", -3)
    with refused(r"/joint_states: 267 of 400 messages cannot be decoded .*; name another"):
        read_rosbag(tmp_path / "b", robot_config())


@pytest.mark.thorough
def test_a_topic_of_which_no_message_can_be_decoded_is_not_chosen_and_named(tmp_path, monkeypatch):
    record_damaged(tmp_path / "b", monkeypatch, "/joint_states", 1)
    drive = read_rosbag(tmp_path / "b", robot_config())
    assert drive.wheels.t_s.size == MESSAGES
    assert "none of its messages can be decoded" in drive.notes[0]
    assert any("hides what that leaves out; record /joint_states" in note for note in drive.notes)


@thinned("topic", ["/rtabmap/odom", "/cmd_vel", "/tf", "/camera/image_raw"], quick=1)
def test_damage_in_one_topic_costs_no_wheel_sample(tmp_path, monkeypatch, topic):
    record_damaged(tmp_path / "b", monkeypatch, topic, 5)
    assert read_rosbag(tmp_path / "b", robot_config()).wheels.t_s.size == MESSAGES


@thinned("share", [0.3, 0.6, 0.97], quick=1)
def test_a_sqlite3_file_is_read_to_its_damage(tmp_path, share):
    truth = recorded(tmp_path / "b", "sqlite3", drive=logged("poor"))
    (path,) = (tmp_path / "b").glob("*.db3")
    size = path.stat().st_size
    path.write_bytes(path.read_bytes()[: int(share * size)])
    assert read_rosbag(path, robot_config()).wheels.t_s.size > 0.9 * share * truth.wheels.t_s.size
