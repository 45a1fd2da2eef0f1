"""The least that a host must do to drive the robot, written against the DBC; times in milliseconds."""

import binascii
import struct

from drivers.types import Frame
from firmware_protocol.codec import PROTOCOL_MAJOR, PROTOCOL_MINOR, Codec, Decoded


class MinimalHost:
    """Goes for `request` ("STANDBY", "READY", "ARM") and then commands `speeds`; `latest` holds what the robot sent.

    `patience`: how many times as long its commands hold, and are apart, as those of a daemon.
    """

    def __init__(self, session=1, patience=1):
        self.codec = Codec()
        self.session = session
        self._patience = patience
        self.request = "STANDBY"
        self.speeds = (0.0, 0.0)
        self.mode = "SPEED"
        self.silent = False
        self.latest = {}
        self.times = []
        self._counters = {}

    @property
    def robot_state(self):
        if "SYSTEM_STATE" not in self.latest:
            return None
        return self.codec.choice_name("SYSTEM_STATE", "state", self.latest["SYSTEM_STATE"]["state"])

    def receive(self, frame):
        decoded = self.codec.decode(frame.can_id, frame.data)
        assert isinstance(decoded, Decoded), decoded
        self.latest[decoded.name] = decoded.values
        if decoded.name == "TIME_RESPONSE":
            self.times.append(decoded.values["receive_time"])

    def due(self, now_ms):
        """Frames to send at this millisecond."""
        if self.silent:
            return []
        frames = []
        if now_ms % 500 == 1:
            handshake = {"protocol_major": PROTOCOL_MAJOR, "protocol_minor": PROTOCOL_MINOR}
            frames.append(self._encode("HELLO_REQUEST", **handshake, dbc_hash=self.codec.dbc_hash))
        if now_ms % 1000 == 7:
            frames.append(self._encode("TIME_REQUEST", sequence=now_ms // 1000 % 256))
        if now_ms % (50 * self._patience) == 3:
            challenge = int(self.latest.get("SESSION_STATE", {}).get("challenge", 0))
            response = binascii.crc_hqx(struct.pack("<HBI", challenge, self.session, self.codec.dbc_hash), 0xFFFF)
            state = {"request": self.request, "session": self.session, "challenge_answer": response}
            frames.append(self._encode("HOST_STATE", **state, host_fault=0))
        if now_ms % (20 * self._patience) == 5 and self.request == "ARM":
            left, right = self.speeds if self.robot_state == "ARMED" else (0.0, 0.0)
            command = {"mode": self.mode, "left_speed": left, "right_speed": right, "valid_for": 0.1 * self._patience}
            frames.append(self._encode("WHEEL_COMMAND", **command, session=self.session))
        return frames

    def _encode(self, name, **signals):
        counter = self._counters.get(name, 0)
        self._counters[name] = (counter + 1) % 16
        can_id, data = self.codec.encode(name, counter, **signals)
        return Frame(can_id, data)
