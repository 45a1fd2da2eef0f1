"""Errors of the operating system in words, with the remedy."""

from __future__ import annotations

import errno

import can

_NOT_HERE = (can.CanInterfaceNotImplementedError, ImportError, NameError)
_GONE = (errno.ENOENT, errno.ENODEV, errno.ENXIO, errno.EIO)


_OVER_A_TTY = ("slcan", "serial", "seeedstudio", "robotell")


def error_number(error: BaseException) -> int | None:
    """Return the errno of an error or of what caused it; python-can and pyserial hide it in several places."""
    seen: BaseException | None = error
    while seen is not None:
        for attribute in ("error_code", "errno"):
            number = getattr(seen, attribute, None)
            if isinstance(number, int):
                return number
        seen = seen.__cause__ or seen.__context__
    return None


def explain_port(port: str, error: BaseException) -> str:
    """Say what went wrong with a serial port and what to do about it."""
    number = error_number(error)
    if number in _GONE:
        return f"{port}: no such device; plug the adapter in, or correct the port (ls /dev/serial/by-id shows them)"
    if number in (errno.EACCES, errno.EPERM):
        return f"{port}: permission denied; run: sudo usermod -aG dialout $USER, then log in again"
    if number in (errno.EBUSY, errno.EAGAIN) or "exclusively lock" in str(error):
        return f"{port}: in use by another program; stop it (sudo fuser {port} shows which)"
    return f"{port}: {_plain(error)}"


def explain_mute(port: str, error: BaseException) -> str:
    """Say what to look at when a serial port is open and nothing comes from it."""
    return (
        f"{port}: {error}; is the robot switched on, and is this its port? Adapters change their numbers: name it as "
        "in /dev/serial/by-id. Some USB boards speak only with link.dtr = true"
    )


def explain_can(interface: str, channel: str, bitrate: int, error: BaseException) -> str:
    """Say what went wrong with a CAN bus and what to do about it."""
    number = error_number(error)
    where = f"{interface} {channel}"
    if isinstance(error, TypeError):
        return f"{where}: link.options do not fit this interface ({error}); correct them"
    if isinstance(error, _NOT_HERE):
        return f"{where}: cannot be used here ({_plain(error)}); install its maker's driver, or use another interface"
    if type(error).__name__ == "NoBackendError":
        return f"{where}: libusb is missing; run: sudo apt-get install libusb-1.0-0"
    if interface == "socketcan":
        virtual = channel.startswith("vcan")
        bring_up = f"sudo ip link set {channel} up" + ("" if virtual else f" type can bitrate {bitrate}")
        if number == errno.ENODEV and virtual:
            return f"{where}: no such CAN interface; run: sudo ip link add dev {channel} type vcan && {bring_up}"
        if number == errno.ENODEV:
            return f"{where}: no such CAN interface; plug the adapter in and run: {bring_up}"
        if number == errno.ENETDOWN:
            return f"{where}: the interface is down; run: {bring_up}"
        if number == errno.EAFNOSUPPORT:
            return f"{where}: this kernel has no CAN; load it with: sudo modprobe can_raw, or use another interface"
        if number == errno.ENOBUFS:
            return f"{where}: transmit queue full; is anybody else on the bus? (ip -details link show {channel})"
    if interface in _OVER_A_TTY and number is not None:
        return explain_port(channel, error)
    if number in (errno.ENOENT, errno.ECONNREFUSED):
        return f"{where}: nothing listens there; start the other end first"
    return f"{where}: {_plain(error)}"


def _plain(error: BaseException) -> str:
    text = str(error) or type(error).__name__
    cause = error.__cause__
    return f"{text} ({cause})" if cause is not None and str(cause) else text
