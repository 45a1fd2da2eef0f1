import csv
import io

import pytest

from firmware_protocol.firmware_core import FirmwareConfig
from sim.body_dynamics import Pose
from sim.plant import Plant
from sim.text_record import TextRecord
from sim.truth import COLUMNS, FLUSH_NS, TruthRecorder, truth_row
from sim.virtual_robot import VirtualRobot


@pytest.fixture
def robot():
    config = FirmwareConfig(ticks_per_rev=2048, max_wheel_speed_rad_s=8.0)
    robot = VirtualRobot(Plant(start=Pose(1.0, -2.0, 0.5)), config)
    robot.step(1000)
    return robot


def read(text):
    return list(csv.DictReader(io.StringIO(text)))


def test_row_has_the_columns_and_the_true_values(robot):
    (row,) = read(",".join(COLUMNS) + "\n" + truth_row(robot, 42))
    assert None not in row
    assert None not in row.values()
    truth = robot.truth
    assert row["t_ns"] == "42"
    assert (float(row["x_m"]), float(row["y_m"]), float(row["yaw_rad"])) == pytest.approx((1.0, -2.0, 0.5), abs=1e-5)
    assert float(row["left_speed_rad_s"]) == pytest.approx(truth.left_speed_rad_s, abs=1e-4)
    assert float(row["speed_m_s"]) == pytest.approx(truth.speed_m_s, abs=1e-5)
    assert row["state"] == robot.outputs.state
    assert (row["driver_enabled"], row["brake"], row["session"]) == ("0", "1", "0")


def test_rows_are_on_disk_after_a_second_and_at_the_end(tmp_path, robot):
    path = tmp_path / "truth.csv"
    record = TextRecord(path, print)
    recorder = TruthRecorder(record)
    assert read(path.read_text()) == []
    for t_ns in range(FLUSH_NS, 3 * FLUSH_NS, FLUSH_NS // 10):
        recorder.record(robot, t_ns)
    assert len(read(path.read_text())) >= 11
    record.close()
    assert len(read(path.read_text())) == 20
