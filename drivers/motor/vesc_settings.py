"""Settings of VESC controllers in robot.toml, and what follows from them alone: e-stop, bus load, safety card."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from drivers.motor import vesc_codec as codec
from drivers.motor.vendor_parts import Nodes, Sign, all_of, in_sides, nodes_fault
from drivers.types import CyclicFrame, Frame, SafetyCard, SettingsFault

# Chosen: unlikely to be a controller's, and refused for one.
HOST_ID = 253
# 50 Hz, which the safety card asks for.
STATUS_PERIOD_S = 0.02
# Chosen: above the noise of a motor at rest, and below speeds that it can hold.
STATIONARY_ERPM = 60.0
# Chosen: equal but for the rounding of numbers that were typed in.
_SAME_TIMEOUT_S, _SAME_CURRENT_A = 0.002, 0.1
EXAMPLE = """nodes = [23, 51]
direction = [1, -1]
gear = 20.0
pole_pairs = 7
max_erpm = 15000.0
watchdog_s = 0.1
brake_current_a = 20.0
"""
FAULTS = {
    1: "the supply's voltage is too high",
    2: "the supply's voltage is too low",
    3: "the gate driver failed (DRV)",
    4: "the motor's current is far too high",
    5: "the power stage is too hot; let it cool",
    6: "the motor is too hot; let it cool",
    9: "its processor's voltage is too low",
    10: "it was restarted by its own watchdog",
    18: "the motor's phases are not balanced; check its cable",
    27: "the encoder failed",
}


class VescSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of VESCs in [link]: left before right; `gear` is motor turns per wheel turn.

    `pole_pairs` is half the motor's poles.
    `watchdog_s` (App Settings, Timeout), `timeout_brake_current_a`, `max_erpm` and `min_erpm` (below which the speed
    loop lets go) are what the controllers are set to. `uart_node`: on a serial link, the controller at its end, through
    which the others are reached on its CAN.
    """

    nodes: tuple[Nodes, Nodes]
    pole_pairs: Annotated[int, Meta(ge=1, le=100)]
    max_erpm: Annotated[float, Meta(gt=0.0, le=1e6)]
    watchdog_s: Annotated[float, Meta(gt=0.0, le=0.5)]
    brake_current_a: Annotated[float, Meta(gt=0.0, le=500.0)]
    timeout_brake_current_a: Annotated[float, Meta(ge=0.0, le=500.0)] = 0.0
    min_erpm: Annotated[float, Meta(ge=0.0, le=1e5)] = 900.0
    uart_node: int | None = None
    direction: tuple[Sign, Sign] = (1, 1)
    gear: Annotated[float, Meta(gt=0.0, le=1000.0)] = 1.0
    stop_deceleration_rad_s2: Annotated[float, Meta(gt=0.0, le=655.0)] = 10.0

    @property
    def erpm_per_rad_s(self) -> float:
        """Electrical rpm at a wheel speed of 1 rad/s."""
        return 60.0 / (2.0 * math.pi) * self.pole_pairs * self.gear

    def fault(self) -> SettingsFault | None:
        """Return what is wrong with the fields taken together, or None."""
        if self.uart_node is not None and self.uart_node not in all_of(self.nodes):
            return SettingsFault(
                "uart_node", f"{self.uart_node} is not in link.nodes", "write the id of the controller on the line"
            )
        if self.min_erpm >= self.max_erpm:
            return SettingsFault("max_erpm", "not above min_erpm", "write the largest erpm of the motor")
        return nodes_fault(self.nodes, codec.LARGEST_ID, HOST_ID)


def slowest_rad_s(settings: VescSettings) -> float:
    """Return the slowest speed of a wheel that the speed loop holds."""
    return settings.min_erpm / settings.erpm_per_rad_s


def timeout_fault(settings: VescSettings, node: int, timeout_s: float, brake_current_a: float) -> str | None:
    """Return how the timeout that a controller reports differs from what robot.toml declares, or None."""
    named = f"controller {node}: its timeout"
    if timeout_s <= 0.0:
        return f"{named} is off; set {1e3 * settings.watchdog_s:g} ms (VESC Tool, App Settings, General)"
    if abs(timeout_s - settings.watchdog_s) > _SAME_TIMEOUT_S:
        return f"{named} is {timeout_s:g} s; set {settings.watchdog_s:g} s there, or write link.watchdog_s"
    if not abs(brake_current_a - settings.timeout_brake_current_a) <= _SAME_CURRENT_A:
        return f"{named} brakes with {brake_current_a:g} A; write that value in link.timeout_brake_current_a"
    return None


class VescExchange:
    """Exchange with VESCs on a serial line (a `drivers.types.Exchange`): CAN frames in packets through one controller.

    A command has no reply. A ping is asked as values, and a packet's answer comes as one fragment that holds it whole.
    """

    timeout_s = 0.03
    quiet_s = 0.01

    def __init__(self, settings: VescSettings) -> None:
        self._on_the_line = settings.uart_node

    def request(self, frame: Frame) -> bytes:
        """Return the packet, forwarded where it is for another controller; for everybody both."""
        to, payload = frame.can_id & 0xFF, self._payload(frame)
        sent = b"" if to not in (self._on_the_line, codec.EVERYBODY) else codec.packet(payload)
        return sent if to == self._on_the_line else sent + codec.packet(codec.forward(to, payload))

    def is_answered(self, frame: Frame) -> bool:
        """Questions are, commands are not."""
        return frame.can_id >> 8 in (codec.PING, codec.PROCESS_SHORT)

    def reply(self, frame: Frame, received: bytes) -> Frame | None:
        """Return the first packet that answers this question, of this controller."""
        to, query = frame.can_id & 0xFF, self._payload(frame)
        for payload in codec.packets(received):
            if payload[0] == query[0] == codec.GET_APPCONF and codec.timeout(payload, to) is None:
                continue
            if payload[0] == codec.GET_VALUES_SELECTIVE:
                read = codec.values(payload)
                if payload[:5] != query or read is None or read.get("controller_id") != to:
                    continue
            elif payload[0] != query[0]:
                continue
            if frame.can_id >> 8 == codec.PING:
                return Frame(codec.PONG << 8 | HOST_ID, bytes((to, 0)), extended=True)
            return Frame(codec.PROCESS_SHORT << 8 | HOST_ID, bytes((to, 1)) + payload, extended=True)
        return None

    def _payload(self, frame: Frame) -> bytes:
        number = frame.can_id >> 8
        if number == codec.PROCESS_SHORT:
            return frame.data[2:]
        if number == codec.PING:
            return codec.request_values(codec.ALL_OF_A_MOTOR)
        # Both kinds of command have the value in the same steps.
        return bytes(in_packet for on_can, in_packet, _ in codec.COMMANDS.values() if on_can == number) + frame.data


def cyclic_frames(settings: VescSettings, command_rate_hz: float, _authenticated: bool) -> tuple[CyclicFrame, ...]:
    """Speeds, two status messages at 50 Hz and the question for faults of every controller, as long 11-bit frames."""
    frames: list[CyclicFrame] = []
    if settings.uart_node is not None:
        # Command, question and answer, each in a packet; forwarded ones wait for the controllers' own bus.
        return tuple(
            CyclicFrame(f"command and values of {node}", "LINE", 8, command_rate_hz, 12 + 12 + 26, 0.0015)
            for node in all_of(settings.nodes)
        )
    for node in all_of(settings.nodes):
        frames += [
            # 29-bit identifiers take about 25 bits more than the load's formula counts: two bytes and a half.
            CyclicFrame(f"SET_RPM of {node}", "HOST", 7, command_rate_hz),
            CyclicFrame(f"STATUS of {node}", "ROBOT", 11, 1.0 / STATUS_PERIOD_S),
            CyclicFrame(f"STATUS_5 of {node}", "ROBOT", 11, 1.0 / STATUS_PERIOD_S),
            CyclicFrame(f"faults of {node}", "ROBOT", 11, 30.0),
        ]
    return tuple(frames)


def recognise(frames: Sequence[Frame]) -> dict[str, Any] | None:
    """Return the controllers whose status was heard, split into left and right as they are numbered; None for none."""
    decoded = [codec.decode(frame) for frame in frames]
    nodes = sorted({one.node for one in decoded if one is not None and one.name == "status"})
    return {"nodes": in_sides(nodes)} if len(nodes) > 1 else None


def safety_card(settings: VescSettings) -> SafetyCard:
    """Return the safety card of VESCs."""
    brakes = settings.timeout_brake_current_a > 0.0
    braking = f"braking with {settings.timeout_brake_current_a:g} A"
    return SafetyCard(
        host_silent=f"each controller, {settings.watchdog_s:g} s after the last set command, by its timeout",
        stops_by=braking if brakes else "coasting: timeout_brake_current_a is 0",
        reaction_s=settings.watchdog_s + 0.01,
        brakes=brakes,
        estop=f"a frame to all controllers: they brake with {settings.brake_current_a:g} A; only this driver latches "
        "the stop, and only motors at rest confirm it",
        wheel_fault=f"a brake current of {settings.brake_current_a:g} A while a motor reports that it turns, then a "
        "current of zero; neither needs the speed loop",
        unverified=(
            "the speeds are declared in robot.toml and were not read back; the timeout and its brake current are, "
            "where the firmware reports them",
            "not tested on hardware: the driver was tested against a simulator made from the vendor's code",
        ),
        setup=(
            f"App Settings, General: Timeout {1e3 * settings.watchdog_s:g} ms, Timeout Brake Current "
            f"{settings.timeout_brake_current_a:g} A, CAN status messages 1 and 5 at 50 Hz or more",
        ),
    )
