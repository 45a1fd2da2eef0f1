import pytest

from firmware_protocol.firmware_core import FirmwareConfig
from sim.body_dynamics import Pose
from sim.effects import HiddenEffectError
from sim.in_process import RobotInProcess
from sim.plant_parameters import PlantParameters

FIRMWARE = FirmwareConfig(ticks_per_rev=2048, max_wheel_speed_rad_s=8.0)


def test_frames_come_while_time_passes_and_only_then():
    robot = RobotInProcess(PlantParameters(), {}, FIRMWARE, Pose(1.0, 2.0, 0.5), seed=1)
    robot.advance(500_000)
    assert robot.truth.t_us == 500_000
    assert robot.host.receive()
    assert not robot.host.receive()
    assert (robot.truth.x_m, robot.truth.y_m) == (1.0, 2.0)


def test_an_unknown_effect_is_refused():
    with pytest.raises(HiddenEffectError):
        RobotInProcess(PlantParameters(), {"levitation": 1.0}, FIRMWARE, Pose(), seed=1)
