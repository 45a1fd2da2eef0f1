"""Admission of pose senders to a port: allowed addresses, one sender at a time, and a proof under a key; pure.

Any user of this computer can send to a UDP port of it. Two programs that do so by mistake, or one on purpose, would
pull the estimate to and fro without a word.

A proven datagram is the time at which it was sent (UNIX time in ns, 8 bytes, big-endian), then the pose, then the
HMAC-SHA256 of both under the key.
"""

from __future__ import annotations

import hashlib
import hmac
from collections.abc import Collection, Hashable
from ipaddress import AddressValueError, IPv4Address, IPv4Network, NetmaskValueError

SILENCE_S = 2.0
"""A sender is kept until it has been silent for so long, unless the host says otherwise."""
# Chosen: often enough to be seen, without a line for each of many datagrams.
REPORT_AGAIN_NS = 10_000_000_000
CLOCKS_APART_NS = 1_000_000_000
"""A proven datagram was sent at most so long ago, by the sender's clock, or so far ahead of this computer's."""
# UNIX time in ns as 64-bit integer, and HMAC-SHA-256.
TIME_BYTES, PROOF_BYTES = 8, 32


def parse_allowed(addresses: Collection[str]) -> tuple[IPv4Network, ...]:
    """Return the networks that `pose.allow` names; raises ValueError with what is wrong with one of them."""
    if not addresses:
        raise ValueError("empty, which allows no sender at all")
    networks = []
    for text in addresses:
        try:
            networks.append(IPv4Network(text, strict=False))
        except (AddressValueError, NetmaskValueError, ValueError):
            raise ValueError(f'"{text[:60]}" is not an IPv4 address') from None
    return tuple(networks)


class PoseProof:
    """Check of proven datagrams: each must have been sent later than all before it, and since the port was opened."""

    def __init__(self, key: bytes, wall_ns: int) -> None:
        self._key = key
        self._newest_ns = wall_ns

    def unwrap(self, datagram: bytes, wall_ns: int) -> bytes | str:
        """Return the body of a datagram that arrives at this UNIX time (ns), or in words why it is refused."""
        payload, proof = datagram[:-PROOF_BYTES], datagram[-PROOF_BYTES:]
        if len(payload) < TIME_BYTES or not hmac.compare_digest(hmac.digest(self._key, payload, hashlib.sha256), proof):
            return "without the authentication code of pose.key_file"
        sent_ns = int.from_bytes(payload[:TIME_BYTES], "big")
        if abs(wall_ns - sent_ns) > CLOCKS_APART_NS:
            return f"{abs(wall_ns - sent_ns) * 1e-9:.0f} s old or ahead by their sender's clock; synchronise the clocks"
        if sent_ns <= self._newest_ns:
            return "sent again, or out of order"
        self._newest_ns = sent_ns
        return payload[TIME_BYTES:]


class RefusedDatagrams:
    """Counts datagrams that are not used, and has one in ten seconds reported."""

    def __init__(self) -> None:
        self.count = 0
        self._messages: list[str] = []
        self._next_report_ns = 0
        self._unreported = 0

    def add(self, now_ns: int, text: str, hint: str) -> None:
        """Count a datagram, and report it unless another was reported in the last ten seconds."""
        self.count += 1
        self._unreported += 1
        if now_ns >= self._next_report_ns:
            self._next_report_ns = now_ns + REPORT_AGAIN_NS
            self._messages.append(f"{text}: not used ({self._unreported} datagrams); {hint}")
            self._unreported = 0

    def new_messages(self) -> list[str]:
        """Return what a person should know since the last call."""
        messages, self._messages = self._messages, []
        return messages


class SenderGate:
    """Keeps to one sender: the first whose pose is good, until it has been silent; all others are counted and named.

    `allow`: addresses and networks that may send at all; None for every one. A `sender` is whatever names one, as
    (address, port).
    """

    def __init__(self, silence_s: float = SILENCE_S, allow: Collection[str] | None = None) -> None:
        self.refused = RefusedDatagrams()
        self._silence_ns = round(silence_s * 1e9)
        self._allowed = None if allow is None else parse_allowed(allow)
        self._known: dict[str, bool] = {}
        self._kept: Hashable | None = None
        self._came_ns = 0
        self._messages: list[str] = []

    @property
    def kept_address(self) -> str | None:
        """The network address of the sender that is kept to; None where there is none."""
        return str(self._kept[0]) if isinstance(self._kept, tuple) else None

    def may_send(self, sender: Hashable, now_ns: int) -> bool:
        """Return whether a datagram of this sender is worth reading; one that is not is counted and reported."""
        if self._allowed is not None and not self._is_allowed(sender):
            self.refused.add(
                now_ns, f"{_name(sender)} sends poses but is not in pose.allow", "add it there, or stop that sender"
            )
            return False
        if self._kept in (None, sender) or now_ns - self._came_ns >= self._silence_ns:
            return True
        self.refused.add(
            now_ns,
            f"{_name(sender)} sends poses while {_name(self._kept)} does",
            f"stop one of them; {_name(self._kept)} is used until it has sent nothing for "
            f"{self._silence_ns * 1e-9:g} s",
        )
        return False

    def note_pose(self, sender: Hashable, now_ns: int) -> None:
        """Take in that a good pose came from this sender, which is kept to from now on."""
        if self._kept not in (None, sender):
            self._messages.append(
                f"poses now come from {_name(sender)}; {_name(self._kept)} has sent nothing for "
                f"{(now_ns - self._came_ns) * 1e-9:.1f} s"
            )
        self._kept, self._came_ns = sender, now_ns

    def new_messages(self) -> list[str]:
        """Return what a person should know since the last call."""
        messages, self._messages = self._messages, []
        return [*messages, *self.refused.new_messages()]

    def _is_allowed(self, sender: Hashable) -> bool:
        address = sender[0] if isinstance(sender, tuple) else str(sender)
        if address not in self._known:
            if len(self._known) > 1000:
                # A flood from made-up addresses must not fill the memory.
                self._known.clear()
            self._known[address] = any(IPv4Address(address) in network for network in self._allowed or ())
        return self._known[address]


def _name(sender: Hashable) -> str:
    return f"{sender[0]}:{sender[1]}" if isinstance(sender, tuple) else str(sender)
