import errno

import can
import pytest
import serial

from drivers.transport.can import CanMedium
from drivers.transport.serial import error_number, explain_port


def caused(error, cause):
    error.__cause__ = cause
    return error


@pytest.mark.parametrize(
    ("error", "expected_text"),
    [
        (serial.SerialException(errno.ENOENT, "could not open"), "no such device"),
        (serial.SerialException(errno.EACCES, "could not open"), "usermod -aG dialout"),
        (serial.SerialException("Could not exclusively lock port /dev/ttyUSB0"), "in use by another program"),
        (OSError(errno.EIO, "Input/output error"), "no such device"),
        (ValueError("odd"), "/dev/ttyUSB0: odd"),
    ],
)
def test_serial_port(error, expected_text):
    assert expected_text in explain_port("/dev/ttyUSB0", error)


@pytest.mark.parametrize(
    ("interface", "error", "expected_text"),
    [
        ("socketcan", OSError(errno.ENODEV, "No such device"), "sudo ip link set can0 up type can bitrate 250000"),
        ("socketcan", can.CanOperationError("down", errno.ENETDOWN), "the interface is down"),
        ("socketcan", OSError(errno.EAFNOSUPPORT, "no"), "modprobe can_raw"),
        ("socketcan", can.CanOperationError("full", errno.ENOBUFS), "transmit queue full"),
        ("unixcan", can.CanInitializationError("no hub", errno.ENOENT), "start the other end first"),
        ("slcan", caused(can.CanInitializationError("x"), OSError(errno.EACCES, "no")), "usermod -aG dialout"),
        ("slcan", ValueError("Invalid bitrate"), "slcan can0: Invalid bitrate"),
        ("virtual", caused(can.CanOperationError("Cannot"), ValueError("why")), "virtual can0: Cannot (why)"),
        ("virtual", KeyError(), "virtual can0: KeyError"),
        ("kvaser", TypeError("no argument 'hots'"), "kvaser can0: link.options do not fit this interface"),
        ("kvaser", can.CanInterfaceNotImplementedError("here"), "kvaser can0: cannot be used here (here); install its"),
        (
            "kvaser",
            NameError("can..."),
            "kvaser can0: cannot be used here (can...); install its maker's driver, or use",
        ),
    ],
)
def test_can_bus(interface, error, expected_text):
    text = CanMedium(interface, "can0", 250_000).explain(error)
    assert expected_text in text
    assert "can0" in text
    assert "\n" not in text


def test_a_virtual_interface_has_no_bit_rate():
    absent = CanMedium("socketcan", "vcan0", 500_000).explain(OSError(errno.ENODEV, "No such device"))
    assert absent.endswith("sudo ip link add dev vcan0 type vcan && sudo ip link set vcan0 up")
    down = CanMedium("socketcan", "vcan0", 500_000).explain(OSError(errno.ENETDOWN, "down"))
    assert down.endswith("run: sudo ip link set vcan0 up")


def test_the_number_is_found_where_the_libraries_hide_it():
    assert error_number(can.CanOperationError("x", 105)) == 105
    assert error_number(OSError(5, "x")) == 5
    assert error_number(caused(can.CanError("x"), caused(RuntimeError("y"), OSError(19, "z")))) == 19
    assert error_number(ValueError("x")) is None
