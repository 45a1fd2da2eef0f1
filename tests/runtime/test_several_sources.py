"""The stack with two pose sources in robot.toml: the robot's own poses, and datagrams through a real socket."""

import socket
from contextlib import closing

import pytest

from disco_hw.config import load_robot_config
from disco_hw.daemon.check import pose_source_checks
from disco_hw.daemon.control_socket import counters, status
from disco_hw.errors import InputError, WorkError
from disco_hw.log.load import load_drive
from disco_hw.log.recorder import RecorderStats
from disco_hw.runtime.assembly import create_planner, pose_source_of
from disco_hw.runtime.robot_setup import load_setup
from drivers.types import PoseSample
from tests.drivers.waiting import free_port
from tests.runtime.pose_bench import PoseBench
from tests.runtime.simulated import ROBOT_FILE, recorded, replayed, robot_toml, write_run


class Bench(PoseBench):
    """The stack on its circle; datagrams say where the robot truly is, `off_m` east of it."""

    def __init__(self, directory):
        also = '[[pose.also]]\nsource = "udp"\nport = PORT\norigin = [1.0, 0.0, 0.0]\n'
        super().__init__(directory, f'[pose]\nsource = "robot"\n{also}', planner_of)
        self.off_m = 0.0
        position = {"position_std_m": 0.02, "age_s": 0.0}
        self.send(10.0, lambda _: self.off_m - 1.0, lambda pose: {"x_m": pose["x_m"], "y_m": pose["y_m"], **position})

    def poses(self):
        return recorded(self.stack, PoseSample)


def planner_of(setup):
    return create_planner(setup.config, setup.model)


@pytest.fixture
def bench(tmp_path):
    with closing(Bench(tmp_path)) as made:
        yield made


def test_both_are_fused_shown_recorded_and_replayed_bit_for_bit(bench, tmp_path):
    assert bench.start(1.0)
    bench.off_m = 0.6
    bench.stack.run(1.3)
    bench.senders[0].is_silent = True
    last = bench.stack.run(1.2)[-1]
    assert last.output.running
    now = status(bench.stack.core, {}, RecorderStats())["poses"]
    assert [one["source"] for one in now] == ["robot", "udp"]
    assert [one["standing"] for one in now] == ["good", "lost"]
    assert now[1]["origin"] == [1.0, 0.0, 0.0]
    assert now[1]["outliers"] >= 12
    assert now[0]["latency_s"] == pytest.approx(0.03, abs=0.02)
    jumped = "poses: udp: its poses jumped, which the wheels do not explain, and are not used; continuing with robot"
    assert bench.events(jumped)
    assert bench.events("poses: udp: no pose for 1 s; continuing with robot")
    assert {pose.source for pose in bench.poses()} == {0, 1}
    log = write_run(bench.stack, tmp_path / "run.mcap")
    replayed(log)
    # What compares poses takes one source: from one to the other is no motion.
    assert load_drive(log).poses.x_m.size == sum(pose.source == 0 for pose in bench.poses())


def test_two_that_contradict_each_other_stop_the_task_and_say_so(bench):
    assert bench.start(1.0)
    for tenth in range(40):
        bench.off_m = 0.005 * tenth
        if not bench.stack.run(0.1)[-1].output.running:
            break
    assert not bench.stack.core.last.output.running
    why = "udp and robot disagree by more than their stated noise"
    hint = "find the source that is wrong and remove it from [pose] in robot.toml"
    assert bench.events(f"task stopped: {why}; {hint}")


def test_what_is_learnt_is_learnt_from_the_first_alone(bench):
    fed = []
    bench.stack.core.adaptation.feed = lambda _now_ns, readings: fed.extend(readings.poses)
    bench.stack.run(2.0)
    assert fed
    assert {pose.source for pose in fed} == {0}


def test_counters_of_each_are_recorded(bench):
    bench.stack.run(1.5)
    made = counters(bench.stack.core, LoopFigures(), RecorderStats(), 0)
    assert made.poses["udp accepted"] > 5
    assert made.poses["robot outliers"] == 0


class LoopFigures:
    ticks = overruns = skipped_periods = 0


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ('[[pose.also]]\nsource = "sonar"\n', r'pose\.also\[0\]\.source: there is no source "sonar"; write one of'),
        ('[[pose.also]]\nport = 7\n', r"pose\.also\[0\]: does not say which source; add source, one of"),
        ('[[pose.also]]\nsource = "udp"\nbaud = 9600\n', r'also\[0\]\.baud: belongs to the source "nmea", but'),
        ('[[pose.also]]\nsource = "udp"\nrate_hz = 50.0\n', r"also\[0\]\.rate_hz: decides nothing any more; remove it"),
        ('[[pose.also]]\nsource = "udp"\noffset = [inf, 0.0]\n', r"also\[0\]\.offset: not a finite number"),
        ('[pose]\nsource = "udp"\nallow = []\n', r"pose\.allow: empty, which allows no sender at all; write addr"),
        ('[pose]\nsource = "natnet"\nallow = ["host"]\n', r'pose\.allow: "host" is not an IPv4 address; write addr'),
        ('[[pose.also]]\nsource = "udp"\nallow = ["10.0.0.0/99"]\n',
         r'also\[0\]\.allow: "10\.0\.0\.0/99" is not an IPv4'),
        ('[pose]\nsource = "robot"\nkey_file = "k"\n',
         r'pose\.key_file: belongs to the source "udp", but pose\.source is "robot"; write source = "udp", or remove'),
        ('[pose]\nport = 5005\n', r'pose\.port: belongs to the source "ros2" or "udp", but pose\.source is "robot"; '
         "write source = one of those, or remove it$"),
        ('[[pose.also]]\nsource = "udp"\nprot = 7\n', r"pose\.also.*prot: no such field; did you mean port"),
        ('[[pose.also]]\nsource = "udp"\nposition_unit = "km"\n', r"pose\.also.*position_unit: .*write one of"),
        ('[[pose.also]]\nsource = "udp"\n[[pose.also.also]]\nsource = "robot"\n', r"also\[0\]\.also: sources are not"),
    ],
)  # fmt: skip
def test_a_further_source_that_is_wrong_is_one_line(tmp_path, lines, message):
    with pytest.raises(InputError, match=message):
        load_robot_config(robot_toml(tmp_path, lines))


def test_two_of_one_kind_are_numbered_and_a_port_taken_twice_is_said(tmp_path):
    port = free_port(socket.SOCK_DGRAM)
    lines = f'[pose]\nsource = "udp"\nport = {port}\n[[pose.also]]\nsource = "udp"\nport = {port}\n'
    config = load_robot_config(robot_toml(tmp_path, lines))
    assert config.pose.labels() == ("udp 1", "udp 2")
    with pytest.raises(WorkError, match=rf"pose\.source udp 2: 127\.0\.0\.1:{port}: Address already in use"):
        pose_source_of(config)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as again:
        # The first is closed with it.
        again.bind(("127.0.0.1", port))


def test_check_shows_each_and_that_two_disagree(tmp_path):
    lines = (
        '[pose]\nsource = "udp"\n[[pose.also]]\nsource = "robot"\n[[pose.also]]\nsource = "nmea"\noffset = [0.1, 0.0]\n'
    )
    reported = load_robot_config(robot_toml(tmp_path, lines)).pose
    poses = [PoseSample(t, t + 30_000_000, 1.0, 2.0, 0.5, 0.01, 0.02) for t in range(30)]
    assert pose_source_checks(load_robot_config(ROBOT_FILE).pose, poses) == []
    poses += [PoseSample(t, t + 5_000_000, 1.5, 2.0, 0.5, 0.01, 0.02, source=1) for t in range(9)]
    found = {check.name: f"{check.level.value} {check.text}" for check in pose_source_checks(reported, poses)}
    assert found["poses udp"].startswith("ok 10 a second, 30 ms old, 0.01 m, 0.02 rad; frame at [0.0, 0.0, 0.0]")
    assert found["poses nmea"].endswith(
        "no pose received; frame at [0.0, 0.0, 0.0], sensor at [0.1, 0.0]; check that the sensor sends"
    )
    assert "0.50 m apart, more than their stated noise" in found["poses udp and robot"]
    turned = [PoseSample(t, t, 1.0, 2.0, 0.9, 0.01, 0.02, source=1) for t in range(9)]
    (last,) = [each for each in pose_source_checks(reported, [*poses[:30], *turned]) if "apart" in each.text]
    assert last.text.startswith("0.40 rad apart,")


@pytest.mark.parametrize("where", ["[pose]\n", "[[pose.also]]\n"])
def test_a_key_beside_robot_toml_is_read_and_one_that_others_can_read_or_is_none_is_refused(tmp_path, where):
    port = free_port(socket.SOCK_DGRAM)
    file = robot_toml(tmp_path, f'{where}source = "udp"\nport = {port}\nkey_file = "pose.key"\n')
    key = tmp_path / "pose.key"
    with pytest.raises(InputError, match=r"pose\.source.*: .*pose\.key: .*make one with"):
        pose_source_of(load_setup(file).config)
    key.write_text("00" * 16, encoding="utf-8")
    key.chmod(0o644)
    with pytest.raises(InputError, match=r"pose\.key: others may read the key"):
        pose_source_of(load_setup(file).config)
    key.chmod(0o600)
    source = pose_source_of(load_setup(file).config)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.sendto(b'{"x_m":1,"y_m":2,"position_std_m":0.1,"age_s":0}', ("127.0.0.1", port))
        assert list(source.receive(10**12, ())) == []
    assert any("without the authentication code of pose.key_file" in message for message in source.new_messages())
    source.close()
