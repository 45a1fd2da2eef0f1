"""The virtual robot within the caller's process: its time goes on only when it is stepped; no clock, no thread."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from drivers.transport import InProcessTransport, connect_pair
from drivers.types import OutgoingFrame
from firmware_protocol.firmware_core import FirmwareConfig
from sim.body_dynamics import Pose
from sim.effects import hidden_effects
from sim.plant import Plant, TrueState
from sim.plant_parameters import PlantParameters
from sim.virtual_robot import STEP_US, VirtualRobot

_FOREVER_NS = 1 << 62


class InProcessRobot:
    """A plant with hidden effects and the firmware in front of it, at the end of an in-process link.

    `host` is the other end, open. `effects`: by name (see `sim.effects`); raises HiddenEffectError for wrong ones.
    """

    def __init__(
        self,
        parameters: PlantParameters,
        effects: Mapping[str, float | Sequence[float]],
        start: Pose,
        firmware: FirmwareConfig,
        seed: int = 1,
    ) -> None:
        plant = Plant(parameters, hidden_effects(effects), seed, start)
        self._robot = VirtualRobot(plant, firmware, seed=seed)
        host, self._end = connect_pair()
        self.host: InProcessTransport = host
        self.now_us = 0
        host.open()
        self._end.open()

    @property
    def truth(self) -> TrueState:
        """The true motion."""
        return self._robot.truth

    def step(self) -> int:
        """Let one step pass, frames both ways; returns the time (us)."""
        self.now_us += STEP_US
        for received in self._end.receive():
            self._robot.receive(self.now_us, received.frame)
        for frame in self._robot.step(self.now_us):
            self._end.send(OutgoingFrame(frame, _FOREVER_NS), self.now_us * 1000)
        return self.now_us
