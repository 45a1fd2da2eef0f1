"""The virtual robot in the host's own process and time: for experiments that must not wait for a clock."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from drivers.transport import connect_pair
from drivers.types import OutgoingFrame, Transport
from firmware_protocol.firmware_core import FirmwareConfig
from sim.body_dynamics import Pose
from sim.effects import hidden_effects
from sim.plant import Plant, TrueState
from sim.plant_parameters import PlantParameters
from sim.virtual_robot import STEP_US, VirtualRobot

_FOREVER_NS = 1 << 62


class RobotInProcess:
    """A virtual robot on an in-process link; `host` is the host's end of it, open, and `link` the robot's.

    Time begins at 0 and moves on by `advance` alone. `effects` as in `sim.effects`; raises HiddenEffectError.
    `board` may be exchanged for another one between two steps.
    """

    def __init__(
        self,
        plant: PlantParameters,
        effects: Mapping[str, float | Sequence[float]],
        firmware: FirmwareConfig,
        start: Pose,
        seed: int,
    ) -> None:
        host, self.link = connect_pair()
        self.host: Transport = host
        self.board = VirtualRobot(Plant(plant, hidden_effects(effects), seed, start), firmware)
        host.open()
        self.link.open()
        self._now_us = 0

    @property
    def truth(self) -> TrueState:
        """The true state of the plant now."""
        return self.board.truth

    def advance(self, until_us: int) -> None:
        """Let time pass until then; frames wait at both ends."""
        while self._now_us < until_us:
            self._now_us += STEP_US
            for received in self.link.receive():
                self.board.receive(self._now_us, received.frame)
            for frame in self.board.step(self._now_us):
                self.link.send(OutgoingFrame(frame, _FOREVER_NS), self._now_us * 1000)
