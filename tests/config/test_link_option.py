import pytest

from disco_hw.config import link_fields, names_address
from disco_hw.errors import InputError


@pytest.mark.parametrize(
    ("option", "fields"),
    [
        (None, {}),
        ("can", {"kind": "can"}),
        ("serial", {"kind": "serial"}),
        ("can:socketcan:can1", {"kind": "can", "interface": "socketcan", "channel": "can1", "options": {}}),
        ("can:slcan:a:1", {"kind": "can", "interface": "slcan", "channel": "a:1", "options": {}}),
        ("serial:/dev/ttyUSB1", {"kind": "serial", "port": "/dev/ttyUSB1"}),
        ("serial:socket://host:7000", {"kind": "serial", "port": "socket://host:7000"}),
    ],
)  # fmt: skip
def test_the_option_sets_a_kind_or_a_whole_address(option, fields):
    assert link_fields(option) == fields
    assert names_address(fields) == (len(fields) > 1)


@pytest.mark.parametrize("option", ["", "radio", "usb:can0", "can:", "can:socketcan", "can::can0", "serial:"])
def test_what_says_nothing_is_refused(option):
    with pytest.raises(InputError, match="write can, serial, can:INTERFACE:CHANNEL or serial:PORT"):
        link_fields(option)
