"""What idle ODrive nodes are asked: their version, their watchdogs, and then what keeps those from running out.

Firmware 0.5 does not know the first question, so that its silence is the answer. The second is asked where robot.toml
says at which endpoints a watchdog is read.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from drivers.motor import odrive_protocol as protocol
from drivers.motor import vendor_parts as parts
from drivers.motor.odrive_protocol import Generation, OdriveSettings
from drivers.types import Frame

VERSION_TRIES = 3
WATCHDOG_TRIES = 5
_PERIOD_NS = 100_000_000
_ALIVE_PERIOD_NS = 30_000_000
_SAME_TIMEOUT_S = 0.002


@dataclass(slots=True)
class _Watchdog:
    """What a node has said of it."""

    is_on: bool | None = None
    timeout_s: float | None = None


class Questions:
    """What is asked of all nodes, and what they have answered since they were met; pure.

    `known`: all has been answered as robot.toml declares. `refusal`: why they are not driven. `said`: that they are
    there, once, for whoever takes it away.
    """

    def __init__(self, settings: OdriveSettings) -> None:
        self._settings = settings
        self._nodes = parts.all_of(settings.nodes)
        self.begin_anew(0)

    def begin_anew(self, now_ns: int) -> None:
        """Nothing is known of them."""
        self.known, self.version = False, ""
        self.refusal: str | None = None
        self.said: str | None = None
        self._is_met = False
        self._watchdogs = {node: _Watchdog() for node in self._nodes}
        self._version_tries = self._watchdog_tries = 0
        self._asked_ns = now_ns - _PERIOD_NS

    def due(self, now_ns: int, all_are_heard: bool) -> list[Frame]:
        """The questions that are due now; only of nodes that idle, as each feeds their watchdogs."""
        waits = self.known or self.refusal is not None
        if now_ns - self._asked_ns < (_ALIVE_PERIOD_NS if waits else _PERIOD_NS):
            return []
        if not (waits or self._is_met or all_are_heard):
            return []
        self._asked_ns = now_ns
        if waits:
            number = protocol.TELEMETRY[self._settings.generation]["Get_Bus_Voltage_Current"].command
            return [protocol.ask(node, number) for node in self._nodes]
        return self._for_watchdogs() if self._is_met else self._for_version()

    def take_version(self, values: Mapping[str, float]) -> None:
        """An answer for the version."""
        if self._settings.generation is Generation.V05:
            self.refusal = 'the nodes answer for their version, which 0.5 does not; write link.firmware = "0.6"'
        elif not self._is_met:
            version = ".".join(str(values[f"fw_{part}"]) for part in ("major", "minor", "revision"))
            self._meet(version)

    def take_parameter(self, frame: Frame) -> bool:
        """Whether the frame answers for a watchdog, which is then judged."""
        node, _ = protocol.split(frame.can_id)
        if node not in self._watchdogs or self._settings.watchdog_endpoints is None or not self._is_met:
            return False
        enabled, timeout = self._settings.watchdog_endpoints
        is_on = protocol.parameter(frame, node, enabled, "bool")
        timeout_s = protocol.parameter(frame, node, timeout, "f32")
        if is_on is None and timeout_s is None:
            return False
        watchdog = self._watchdogs[node]
        watchdog.is_on = watchdog.is_on if is_on is None else bool(is_on)
        watchdog.timeout_s = watchdog.timeout_s if timeout_s is None else float(timeout_s)
        wanted_s = self._settings.watchdog_s
        if watchdog.is_on is False:
            self.refusal = f"node {node}: its watchdog is off; set axis0.config.enable_watchdog (odrivetool)"
        elif watchdog.timeout_s is not None and not abs(watchdog.timeout_s - wanted_s) <= _SAME_TIMEOUT_S:
            self.refusal = f"node {node}: its watchdog waits {watchdog.timeout_s:g} s; set {wanted_s:g} s there"
        elif not self.known and all(one.is_on and one.timeout_s is not None for one in self._watchdogs.values()):
            self._announce(f", watchdog {wanted_s:g} s")
        return True

    def _for_version(self) -> list[Frame]:
        self._version_tries += 1
        if self._version_tries <= VERSION_TRIES:
            return [protocol.ask(node, protocol.GET_VERSION) for node in self._nodes]
        if self._settings.generation is Generation.V05:
            # That generation does not know the question.
            self._meet()
        else:
            self.refusal = 'the nodes do not answer for their version as 0.6 does; write link.firmware = "0.5"'
        return []

    def _for_watchdogs(self) -> list[Frame]:
        """Until every node has said whether its watchdog is on and how long it waits."""
        self._watchdog_tries += 1
        endpoints = self._settings.watchdog_endpoints or ()
        waiting = [node for node, one in self._watchdogs.items() if one.is_on is None or one.timeout_s is None]
        if self._watchdog_tries > WATCHDOG_TRIES:
            self.refusal = f"node {waiting[0]} does not report its watchdog; correct link.watchdog_endpoints"
            return []
        return [protocol.read_parameter(node, number) for node in waiting for number in endpoints]

    def _meet(self, version: str = "") -> None:
        self._is_met, self.version = True, version
        if self._settings.watchdog_endpoints is None:
            self._announce()

    def _announce(self, watchdog: str = "") -> None:
        self.known = True
        nodes = ", ".join(map(str, self._nodes))
        version = self.version and f", firmware {self.version}"
        self.said = f"nodes {nodes} are there: ODrive {self._settings.firmware}{version}{watchdog}"
