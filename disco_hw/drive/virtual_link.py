"""Whether a link can only lead to a virtual robot, which may drive with nobody's hand on it."""

from __future__ import annotations

import os

from disco_hw.config import Link

_VIRTUAL_INTERFACES = ("unixcan", "virtual")
_PSEUDO_TERMINALS = "/dev/pts/"


def leads_to_virtual_robot(link: Link) -> bool:
    """True for the simulator's own bus, Linux's vcan and pseudo-terminals that exist; False when in doubt."""
    if link.kind == "serial":
        return os.path.realpath(link.port).startswith(_PSEUDO_TERMINALS)
    if link.interface == "socketcan":
        return link.channel.startswith("vcan")
    return link.interface in _VIRTUAL_INTERFACES
