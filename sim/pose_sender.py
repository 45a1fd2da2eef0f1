"""Sends measured poses in datagrams, as a tracking system on the network would."""

from __future__ import annotations

import contextlib
import json
import socket

from sim.sensors import PoseMeasurement


class PoseSender:
    """To one address; what cannot be sent is lost, as on a network."""

    def __init__(self, address: tuple[str, int]) -> None:
        self._address = address
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)

    def send(self, pose: PoseMeasurement, now_us: int) -> None:
        """Send a pose that is there at robot time `now_us`, with its age."""
        text = json.dumps(
            {
                "age_s": 1e-6 * (now_us - pose.sample_us),
                "x_m": pose.x_m,
                "y_m": pose.y_m,
                "yaw_rad": pose.yaw_rad,
                "position_std_m": pose.position_std_m,
                "yaw_std_rad": pose.yaw_std_rad,
            }
        )
        with contextlib.suppress(OSError):
            self._socket.sendto(text.encode(), self._address)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()
