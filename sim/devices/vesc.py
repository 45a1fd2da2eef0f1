"""The VESC controllers of one robot: what their motors hold, on CAN or on a serial line that forwards to the others."""

from __future__ import annotations

from collections.abc import Sequence

from drivers.motor.vendor_parts import sides_of
from drivers.motor.vesc_settings import VescSettings
from firmware_protocol.firmware_core import FirmwareInputs
from sim.can_protocol import CanFrame
from sim.devices.vesc_firmware import Vesc
from sim.encoder_loop import EncoderLoop, EncoderUse


class VescController:
    """Controller of all VESCs of one robot (a `sim.virtual_robot.Controller`).

    Below its least speed a motor is let go.
    """

    def __init__(self, settings: VescSettings, ticks_per_rev: int) -> None:
        self._settings = settings
        self._ticks_per_rev = ticks_per_rev
        self._zero_ticks = (0, 0)
        self._ticks = (0, 0)
        self._now_ms = 0
        self.sides = self._create_boards()

    @property
    def brakes(self) -> bool:
        """Whether every motor brakes."""
        return all(_brakes(vesc) for side in self.sides for vesc in side)

    @property
    def wheels_rad_s(self) -> tuple[float | None, float | None]:
        """The speeds that the motors hold, zero where they brake."""
        wheels: list[float | None] = []
        for side, direction in zip(self.sides, self._settings.direction, strict=True):
            known_speeds = [speed for vesc in side if (speed := self._commanded_erpm(vesc)) is not None]
            erpm = sum(known_speeds) / len(known_speeds) if known_speeds else None
            wheels.append(None if erpm is None else direction * erpm / self._settings.erpm_per_rad_s)
        return wheels[0], wheels[1]

    @property
    def regulates(self) -> bool:
        """Whether a motor has a speed to hold; currents need no loop of speed."""
        return any(vesc.last_command[0] == "set_erpm" for side in self.sides for vesc in side)

    def create_loop(self) -> EncoderLoop:
        """Create the field-oriented control, whose angle is the encoder's."""
        return EncoderLoop(EncoderUse.COMMUTATION, self._settings.max_erpm / self._settings.erpm_per_rad_s)

    @property
    def state(self) -> str:
        """State of all VESCs in one word."""
        vescs = [vesc for side in self.sides for vesc in side]
        if any(vesc.values.fault for vesc in vescs):
            return "FAULT"
        return "ARMED" if any(not vesc.timed_out and vesc.fed for vesc in vescs) else "STANDBY"

    @property
    def obeyed(self) -> int:
        """Number of set commands that the VESCs have accepted."""
        return sum(vesc.fed for side in self.sides for vesc in side)

    def receive(self, now_us: int, frame: CanFrame) -> Sequence[CanFrame]:
        """Take in one frame; return the replies."""
        replies: list[CanFrame] = []
        if self._settings.uart_node is not None:
            return self._receive_bytes(now_us // 1000, frame.data)
        for side in self.sides:
            for vesc in side:
                vesc.at(now_us // 1000)
                replies += vesc.receive(frame)
                vesc.pop_calls()
        return replies

    def step(self, now_us: int, inputs: FirmwareInputs) -> Sequence[CanFrame]:
        """Go through one millisecond; a tachometer counts six in an electrical turn from zero at its start."""
        self._now_ms = now_us // 1000
        self._ticks = (inputs.left_ticks, inputs.right_ticks)
        settings = self._settings
        per_tick = 6.0 * settings.pole_pairs * settings.gear / self._ticks_per_rev
        speeds = (inputs.left_speed_rad_s, inputs.right_speed_rad_s)
        frames: list[CanFrame] = []
        for side, vescs in enumerate(self.sides):
            for vesc in vescs:
                counted = settings.direction[side] * (self._ticks[side] - self._zero_ticks[side])
                vesc.values.tachometer = round(per_tick * counted)
                vesc.values.erpm = settings.direction[side] * speeds[side] * settings.erpm_per_rad_s
                vesc.kill_switch_pin = inputs.estop_button
                frames += vesc.step(self._now_ms)
        # A serial line has no status messages.
        return frames if settings.uart_node is None else ()

    def restart(self) -> None:
        """Switch off and on: the tachometers begin at zero."""
        self._zero_ticks = self._ticks
        self.sides = self._create_boards()

    def _receive_bytes(self, now_ms: int, received: bytes) -> Sequence[CanFrame]:
        """Bytes from the serial line; what is forwarded goes over the bus between the controllers, and back."""
        everyone = [vesc for side in self.sides for vesc in side]
        for vesc in everyone:
            vesc.at(now_ms)
        (near,) = (vesc for vesc in everyone if vesc.controller_id == self._settings.uart_node)
        out, forwarded = near.receive_bytes(received)
        for frame in forwarded:
            for vesc in everyone:
                if vesc is not near:
                    out += b"".join(near.handle_packet_reply(reply) for reply in vesc.receive(frame))
        for vesc in everyone:
            vesc.pop_calls()
        return [CanFrame(0, out)] if out else []

    def _create_boards(self) -> tuple[list[Vesc], list[Vesc]]:
        settings = self._settings
        left, right = (
            [Vesc(node, round(1e3 * settings.watchdog_s), settings.timeout_brake_current_a) for node in side]
            for side in sides_of(settings.nodes)
        )
        for vesc in (*left, *right):
            vesc.status_ms = {9: 20, 27: 20, 16: 200}
            vesc.last_fed_ms = self._now_ms
        return left, right

    def _commanded_erpm(self, vesc: Vesc) -> float | None:
        if _brakes(vesc):
            return 0.0
        name, value = vesc.last_command
        limit = self._settings.max_erpm
        stopped = vesc.values.fault or vesc.kill_switch_active
        lets_go = stopped or name != "set_erpm" or abs(value) < self._settings.min_erpm
        return None if lets_go else min(max(value, -limit), limit)


def _brakes(vesc: Vesc) -> bool:
    name, value = vesc.last_command
    return name == "set_brake_current" and value > 0.0 and not vesc.values.fault


CONTROLLER = VescController
