"""Hostile message definitions in a bag: those that nobody needs are not parsed, the needed ones in bounded time."""

import pytest

from tests.tables import thinned

pytest.importorskip("rosbags", reason="pip install 'disco-hw[ros2]'")

from disco_hw.errors import LogError
from disco_hw.log.importing import rosbag_types
from disco_hw.log.importing.rosbag import read_rosbag
from tests.inference.drives import robot_config
from tests.log.importing.bags import BEGAN_NS, bag, config

IDL_HEAD = "=" * 80 + "\nIDL: "
NESTED = "module a_msgs { module msg { const long X = " + "(" * 4 + "1" + ")" * 4 + "; struct Drive { long y; }; }; };"
MANY_LINES = "float32[2] drivers\n" * 100_000
HOSTILE = {"nested brackets": IDL_HEAD + NESTED, "many lines": MANY_LINES}


def record_with_topics(path, kinds, definition):
    """A bag of wheels beside topics of types with this definition."""
    with bag(path) as maker:
        for k in range(50):
            maker.wheels(k)
        for number, kind in enumerate(kinds):
            connection = maker.writer.add_connection(f"/cmd_drive{number}", kind, msgdef=definition, rihs01="RIHS01_00")
            maker.writer.write(connection, BEGAN_NS, b"\0\1\0\0\0\0\0\0")
    # The library's writer knows IDL by a head that its parser refuses.
    (file,) = path.glob("*.mcap")
    file.write_bytes(file.read_bytes().replace(IDL_HEAD.encode(), b" " * len(IDL_HEAD)))
    return path


@pytest.fixture
def parsed(monkeypatch):
    """The CPU time that each definition was tried with."""
    times = []
    measure = rosbag_types._cpu_time_s
    monkeypatch.setattr(rosbag_types, "_cpu_time_s", lambda *given: times.append(measure(*given)) or times[-1])
    return times


@pytest.mark.parametrize("definition", HOSTILE.values(), ids=HOSTILE)
def test_a_definition_that_nobody_needs_is_not_parsed(tmp_path, parsed, definition):
    path = record_with_topics(tmp_path / "b", ["a_msgs/msg/Image", "b_msgs/msg/Cloud"], definition)
    assert read_rosbag(path, robot_config()).wheels.t_s.size == 50
    assert parsed == []


@thinned("definition", HOSTILE.values(), ids=HOSTILE, quick=1)
def test_needed_definitions_of_a_bag_are_given_up_after_half_a_second_together(tmp_path, parsed, definition):
    path = record_with_topics(tmp_path / "b", [f"a{k}_msgs/msg/Drive" for k in range(20)], definition)
    drive = read_rosbag(path, robot_config())
    assert drive.wheels.t_s.size == 50
    assert "takes over 0.5 s to parse" in drive.notes[0]
    # Those after the first that takes too long are not tried.
    assert parsed[-1] is None
    assert None not in parsed[:-1]
    assert sum(time for time in parsed if time is not None) <= rosbag_types.PARSE_LIMIT_S


def test_a_topic_that_was_asked_for_and_takes_too_long_is_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr(rosbag_types, "PARSE_LIMIT_S", 0.1)
    path = record_with_topics(tmp_path / "b", ["a_msgs/msg/Drive"], HOSTILE["nested brackets"])
    with pytest.raises(LogError, match=r"/cmd_drive0: the bag's definition of a_msgs/msg/Drive takes over 0\.1 s"):
        read_rosbag(path, config(command_topic="/cmd_drive0"))
