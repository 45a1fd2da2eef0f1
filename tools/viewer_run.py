"""A run that is known by heart: the shipped robot on its circle at 50 Hz, as records and as a log."""

import math

from disco_hw.config import SHIPPED_ROBOT
from disco_hw.control.plan import PLANNER_VERSION
from disco_hw.files import MODEL_TOML as MODEL_KIND
from disco_hw.files import ROBOT_TOML as ROBOT_KIND
from disco_hw.log import MODEL_TOML, ROBOT_TOML, attachment, records
from disco_hw.log.process_recorder import ProcessRecorder, RecordingSettings
from drivers.types import PoseSample, PowerSample, RobotLinkHealth, RobotStatus, WheelSample

ROBOT_FILE = SHIPPED_ROBOT
MODEL_FILE = ROBOT_FILE.with_name("wombot_model.toml")
PERIOD_NS = 20_000_000
START_NS = 5_000_000_000_000
RADIUS_M, SPEED_M_S = 0.75, 0.2
LEFT_RAD_S, RIGHT_RAD_S = 2.5, 4.5
FAULT_TICK, GATED_TICK, OVERRUN_TICK, REJECTED_TICK = 60, 80, 100, 120
FAN_TICK = 50


def pose_at(tick, offset_m=0.0):
    """On the circle from (radius, 0), counter-clockwise; `offset_m` outside of it."""
    angle = SPEED_M_S / RADIUS_M * tick * PERIOD_NS * 1e-9
    away = RADIUS_M + offset_m
    return away * math.cos(angle), away * math.sin(angle), math.remainder(angle + math.pi / 2.0, math.tau)


def plan_at(tick):
    now_ns = START_NS + tick * PERIOD_NS
    path = [pose_at(tick + 5 * step) for step in range(11)]
    return records.Plan(
        t_ns=now_ns, t0_ns=now_ns, step_s=0.1, left_rad_s=(LEFT_RAD_S,) * 10, right_rad_s=(RIGHT_RAD_S,) * 10,
        effective_samples=40.0 + tick % 7, temperature=0.3, min_cost=1.0, mean_cost=2.0,
        path_x_m=tuple(x for x, _, _ in path), path_y_m=tuple(y for _, y, _ in path),
        path_yaw_rad=tuple(yaw for _, _, yaw in path),
    )  # fmt: skip


def fan_at(tick):
    """Three rollouts that part to either side of the circle."""
    paths = [[pose_at(tick + 5 * step, 0.02 * step * side)[:2] for step in range(11)] for side in (0, 1, -1)]
    flat = [place for path in paths for place in path]
    return records.Fan(
        START_NS + tick * PERIOD_NS, (0.5, 0.2, 0.05), tuple(x for x, _ in flat), tuple(y for _, y in flat)
    )


def tick_records(tick):
    """Everything that is recorded of one tick, and the tick's time."""
    now_ns = START_NS + tick * PERIOD_NS
    seconds = tick * PERIOD_NS * 1e-9
    x_m, y_m, yaw_rad = pose_at(tick)
    angles = (LEFT_RAD_S * seconds, RIGHT_RAD_S * seconds)
    got = [
        records.FrameIn(now_ns, 0x181, b"\1\2"),
        WheelSample(now_ns, now_ns, *angles, LEFT_RAD_S, RIGHT_RAD_S),
        records.Estimate(
            now_ns, x_m, y_m, yaw_rad, (1e-4, 0.0, 0.0, 0.0, 4e-4, 0.0, 0.0, 0.0, 1e-3), SPEED_M_S,
            SPEED_M_S / RADIUS_M, LEFT_RAD_S, RIGHT_RAD_S,
        ),
        records.Command(now_ns, 2.6, 4.6, LEFT_RAD_S, RIGHT_RAD_S, 0.1, True, "plan"),
        records.LoopTiming(now_ns, tick, now_ns, 80_000, {"plan": 1}, overruns=int(tick >= OVERRUN_TICK)),
        plan_at(tick),
    ]  # fmt: skip
    if tick % 2 == 0:
        gated = tick == GATED_TICK
        got.append(PoseSample(now_ns, now_ns, x_m, y_m, yaw_rad, 0.01, 0.01))
        got.append(records.Innovation(now_ns, (0.01, -0.01, 0.0), (1e-4,) * 3, 3.0 if gated else 0.2, not gated))
    if tick % 5 == 0:
        fault = "OVERCURRENT" if tick >= FAULT_TICK else "NONE"
        got.append(RobotStatus(now_ns, "ARMED", 0, fault, "NONE", "NONE", 1, 0, "NONE"))
        got.append(PowerSample(now_ns, 24.5, 1.0, 30.0))
        got.append(RobotLinkHealth(now_ns, 0, 0, 0, 0, 0, 0))
    if tick % FAN_TICK == 0:
        got.append(fan_at(tick))
    if tick == 10:
        got.append(records.DaemonState(now_ns, "ARMED", "READY", "armed on request"))
        got.append(records.Event(now_ns, "info", "daemon", "ready -> armed: armed on request"))
    if tick % 50 == 20:
        counts = {"rejected_crc": 3 if tick >= REJECTED_TICK else 0}
        got.append(records.Counters(now_ns, transport={"malformed": 0}, driver=counts))
    return now_ns, got


def write_log(path, ticks=200, records_of=tick_records):
    """A log of the run, written by the real writer; `records_of(tick)` is what each tick holds."""
    attachments = (attachment(ROBOT_FILE, ROBOT_TOML, ROBOT_KIND), attachment(MODEL_FILE, MODEL_TOML, MODEL_KIND))
    recorder = ProcessRecorder(
        RecordingSettings(path, "wombot", planner=PLANNER_VERSION, attachments=attachments, queue_ticks=100_000)
    )
    for tick in range(ticks):
        recorder.put(*records_of(tick))
    stats = recorder.close(300.0)
    assert stats.dropped_ticks == 0
    assert stats.refused == 0
    return path
