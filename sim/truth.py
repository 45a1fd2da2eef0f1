"""What truly happened to the virtual robot, as a CSV table for scoring and as one line for a person."""

from __future__ import annotations

from sim.text_record import TextRecord
from sim.virtual_robot import VirtualRobot

COLUMNS = (
    "t_ns",
    "x_m",
    "y_m",
    "yaw_rad",
    "left_speed_rad_s",
    "right_speed_rad_s",
    "left_setpoint_rad_s",
    "right_setpoint_rad_s",
    "speed_m_s",
    "yaw_rate_rad_s",
    "state",
    "driver_enabled",
    "brake",
    "session",
    "accepted_commands",
    "fault",
)
FLUSH_NS = 1_000_000_000


def truth_row(robot: VirtualRobot, t_ns: int) -> str:
    """The values of `COLUMNS` at the last step, which was at the monotonic time `t_ns`, separated by commas."""
    truth, outputs = robot.truth, robot.outputs
    return (
        f"{t_ns},{truth.x_m:.6f},{truth.y_m:.6f},{truth.yaw_rad:.6f},"
        f"{truth.left_speed_rad_s:.5f},{truth.right_speed_rad_s:.5f},"
        f"{outputs.left_setpoint_rad_s:.5f},{outputs.right_setpoint_rad_s:.5f},"
        f"{truth.speed_m_s:.6f},{truth.yaw_rate_rad_s:.6f},{outputs.state},"
        f"{int(outputs.driver_enabled)},{int(outputs.brake)},{outputs.session},{outputs.accepted_commands},{outputs.fault}"
    )


class TruthRecorder:
    """Writes `COLUMNS` as CSV; what is older than a second is on disk."""

    def __init__(self, record: TextRecord) -> None:
        self._record = record
        record.line(",".join(COLUMNS))
        record.flush()
        self._flushed_ns = 0

    def record(self, robot: VirtualRobot, t_ns: int) -> None:
        """Write the state of the last step, which was at the monotonic time `t_ns`."""
        self._record.line(truth_row(robot, t_ns))
        if t_ns - self._flushed_ns >= FLUSH_NS:
            self._flushed_ns = t_ns
            self._record.flush()
