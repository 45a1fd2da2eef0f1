"""A log of ours as a bag of ROS 2, read by the stock readers and imported again."""

import math
from dataclasses import replace
from itertools import islice

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="pip install 'disco-hw[ros2]'")

from mcap.reader import make_reader
from msgspec import structs
from rosbags.highlevel import AnyReader

from disco_hw.errors import LogError
from disco_hw.log import log_command
from disco_hw.log.importing import import_log
from disco_hw.log.importing.rosbag import read_rosbag
from disco_hw.log.load import load_drive
from disco_hw.log.log_command import export_rosbag, write_rosbag
from disco_hw.log.reader import open_log
from drivers.types import PoseSample
from tests.inference.drives import ROBOT, logged, robot_config, write_log
from tests.log.importing.bags import BEGAN_NS
from tests.log.importing.commands import call
from tests.runtime.simulated import write_ticks


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    folder = tmp_path_factory.mktemp("log")
    (folder / "robot.toml").write_text(ROBOT)
    return import_log(write_log(folder / "log.csv", "poor"), folder / "robot.toml", folder / "log.mcap").out


def test_what_is_exported_is_imported_again(log, tmp_path):
    call("log", "export", log, "-o", tmp_path / "bag", "--rosbag2")
    drive, back = load_drive(log), read_rosbag(tmp_path / "bag", robot_config())
    for part in ("wheels", "poses"):
        for name in getattr(drive, part).__slots__:
            reported, read = getattr(getattr(drive, part), name), getattr(getattr(back, part), name)
            np.testing.assert_allclose(read, reported, atol=1e-9, err_msg=f"{part}.{name}")
    given = np.isfinite(back.commands.left_rad_s)
    known = np.isfinite(drive.commands.left_rad_s)
    np.testing.assert_array_equal(back.commands.left_rad_s[given], drive.commands.left_rad_s[known])


def test_the_date_of_a_bag_is_kept_over_an_import_and_an_export(tmp_path):
    """Also where the first record of the log is one that is left out."""
    (tmp_path / "robot.toml").write_text(ROBOT)
    write_rosbag(logged("poor"), tmp_path / "bag", BEGAN_NS, None)
    imported = import_log(tmp_path / "bag", tmp_path / "robot.toml", tmp_path / "log.mcap").out
    with open_log(imported) as log:
        assert log.summary().start.startswith("2023-11-14T22:13:20")
        ticks = [(entry.now_ns + 10**9, [entry.record]) for entry in log.records()]
    times_ns = [stamps_of(export) for export in (tmp_path / "bag", exported(imported, tmp_path / "again"))]
    np.testing.assert_array_equal(*times_ns)
    bare = PoseSample(0, 0, 0.0, 0.0, math.nan, 0.01, math.nan)
    later = [(t_ns, [structs.replace(one, t_ns=one.t_ns + 10**9)]) for t_ns, (one,) in ticks]
    path = write_ticks(tmp_path / "later.mcap", [(0, [bare]), *later], wall_offset_ns=BEGAN_NS - 10**9)
    np.testing.assert_array_equal(stamps_of(exported(path, tmp_path / "later")), times_ns[0])


def exported(log, bag):
    export_rosbag(log, bag, as_json=False)
    return bag


def stamps_of(bag):
    """Return the times of the wheels in a bag, as the stock reader has them."""
    with AnyReader([bag]) as reader:
        return [t_ns for one, t_ns, _ in reader.messages() if one.topic == "/joint_states"]


def test_angles_that_were_derived_from_speeds_are_not_exported(tmp_path):
    drive = logged("poor")
    speeds_only = replace(drive, wheels=replace(drive.wheels, angle_measured=False, speed_measured=True))
    write_rosbag(speeds_only, tmp_path / "bag", 0, None)
    wheels = read_rosbag(tmp_path / "bag", robot_config()).wheels
    assert (wheels.angle_measured, wheels.speed_measured) == (False, True)
    np.testing.assert_array_equal(wheels.left_speed_rad_s, drive.wheels.left_speed_rad_s)


def test_stock_readers_open_it(log, tmp_path):
    export_rosbag(log, tmp_path / "bag", as_json=False)
    with AnyReader([tmp_path / "bag"]) as reader:
        kinds = {one.topic: one.msgtype for one in reader.connections}
        assert kinds["/cmd_vel"] == "geometry_msgs/msg/TwistStamped"
        assert kinds["/pose"] == "geometry_msgs/msg/PoseStamped"
        first = next(raw for one, _, raw in reader.messages() if one.topic == "/joint_states")
        assert reader.deserialize(first, "sensor_msgs/msg/JointState").name == ["left_wheel_joint", "right_wheel_joint"]
        count = reader.message_count
    with (tmp_path / "bag" / "bag.mcap").open("rb") as file:
        assert sum(1 for _ in make_reader(file).iter_messages()) == count


def test_a_bag_is_never_overwritten(log, tmp_path):
    (tmp_path / "bag").mkdir()
    with pytest.raises(LogError, match="bag: already exists; give another name"):
        export_rosbag(log, tmp_path / "bag", as_json=False)


def test_a_place_that_is_none_is_named(log, tmp_path):
    for place in (log / "bag", tmp_path / ("x" * 300)):
        with pytest.raises(LogError, match=r"(bag|xx): cannot be written \((Not a directory|File name too long)\)"):
            export_rosbag(log, place, as_json=False)


def test_an_interrupted_export_leaves_no_half_bag_behind(log, tmp_path, monkeypatch):
    def interrupted(*parts, key):
        yield from islice(merge(*parts, key=key), 20)
        raise KeyboardInterrupt

    merge = log_command.merge
    monkeypatch.setattr(log_command, "merge", interrupted)
    with pytest.raises(KeyboardInterrupt):
        export_rosbag(log, tmp_path / "bag", as_json=False)
    assert not (tmp_path / "bag").exists()
