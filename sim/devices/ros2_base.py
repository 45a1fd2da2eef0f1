"""A base on ROS 2 with its bridge, in one piece: the bridge's own end of the link, and a base that takes its speeds.

The base holds the last speeds for its time-out, and says joint states 50 times a second. The messages between the two
are not simulated here: `tools/ros2_base_node.py` is a base that speaks DDS.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from drivers.motor import ros2_base_wire as wire
from drivers.types import Frame
from firmware_protocol.firmware_core import FirmwareInputs
from sim.can_protocol import CanFrame
from sim.encoder_loop import EncoderLoop, EncoderUse

# As of the bridge (disco_hw/bridge/ros2_base.py): odometry at 50 Hz, its state at 20 Hz.
WHEELS_MS, STATE_MS, STEP_MS = 20, 50, 20


class Ros2BaseController:
    """Controller of a base on ROS 2 (a `sim.virtual_robot.Controller`).

    `joints`: whether the base says how each of its wheels turns.
    """

    brakes = False

    def __init__(self, settings: wire.Ros2BaseSettings, ticks_per_rev: int) -> None:
        self._settings = settings
        self._per_tick = 2.0 * math.pi / ticks_per_rev
        self._ticks = self._zero_ticks = (0, 0)
        self.joints = True
        self.obeyed = 0
        self._begin()

    @property
    def wheels_rad_s(self) -> tuple[float | None, float | None]:
        """The speeds of its wheels: it always holds them."""
        linear, angular = self._speeds if self._now_ms - self._set_ms <= 1e3 * self._settings.watchdog_s else (0.0, 0.0)
        turn = 0.5 * self._settings.track_m * angular
        return (linear - turn) / self._settings.wheel_radius_m, (linear + turn) / self._settings.wheel_radius_m

    @property
    def regulates(self) -> bool:
        """Whether its wheels' loops run; they are reset by a speed of zero, as in the usual firmware of small bases."""
        return self.wheels_rad_s != (0.0, 0.0)

    def create_loop(self) -> EncoderLoop:
        """Create the wheels' speed loops."""
        return EncoderLoop(EncoderUse.SPEED, self._settings.max_speed_m_s / self._settings.wheel_radius_m)

    @property
    def state(self) -> str:
        """State of the base in one word."""
        return "ESTOP" if self.end.latched else "ARMED" if self.end.driving else "STANDBY"

    def receive(self, now_us: int, frame: CanFrame) -> Sequence[CanFrame]:
        """Take in one frame; the bridge answers nothing at once."""
        if not frame.remote and not frame.error:
            self._apply(
                now_us // 1000, self.end.receive(1000 * now_us, Frame(frame.can_id, frame.data, frame.extended))
            )
        return ()

    def step(self, now_us: int, inputs: FirmwareInputs) -> Sequence[CanFrame]:
        """Go through one millisecond; the joints count from zero at the start."""
        self._now_ms = now_ms = now_us // 1000
        self._ticks = (inputs.left_ticks, inputs.right_ticks)
        self.end.button, self.end.has_odometry = inputs.estop_button, self.joints
        frames: list[Frame] = []
        if now_ms % STEP_MS == 0:
            self._apply(now_ms, self.end.step(1000 * now_us))
        if now_ms % STATE_MS == 0:
            frames.append(self.end.state())
        if now_ms % WHEELS_MS == 0 and self.joints:
            left, right = (
                self._per_tick * (now - zero) for now, zero in zip(self._ticks, self._zero_ticks, strict=True)
            )
            speeds = (inputs.left_speed_rad_s, inputs.right_speed_rad_s)
            frames += wire.wheel_frames(wire.Wheels((left, right), speeds, 0.0))
        return [CanFrame(frame.can_id, frame.data) for frame in frames]

    def restart(self) -> None:
        """Switch base and bridge off and on: standing by, nothing counted."""
        self._zero_ticks = self._ticks
        self._begin()

    def _begin(self) -> None:
        self.end = wire.BaseEnd(self._settings)
        self.end.has_listener = True
        self._speeds, self._set_ms, self._now_ms = (0.0, 0.0), 0, 0

    def _apply(self, now_ms: int, speeds: tuple[float, float] | None) -> None:
        if speeds is not None:
            self._speeds, self._set_ms, self.obeyed = speeds, now_ms, self.obeyed + 1


CONTROLLER = Ros2BaseController
