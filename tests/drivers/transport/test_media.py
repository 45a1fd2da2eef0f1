from contextlib import closing

import pytest

from drivers.transport import TransportSettingsError, can, create_transport, open_transport
from drivers.transport.reconnecting import MUTE_AFTER_S
from drivers.types import LinkState


@pytest.mark.parametrize(
    ("settings", "expected_error"),
    [
        ({"kind": "can", "interface": "sockercan"}, 'link.interface: python-can has no interface "sockercan"'),
        ({"kind": "can", "interface": "nonsense"}, "unixcan"),
        ({"kind": "usb"}, 'link.kind: "usb"'),
        ({"kind": "can", "interface": "slcan", "bitrate": 123_456}, "link.bitrate: slcan has no 123456 bit/s"),
        ({"kind": "can", "interface": "socketcand"}, "link.options: socketcand needs host and port"),
        ({"kind": "can", "interface": "virtual", "options": {"channel": "a"}}, "write it as link.channel"),
    ],
)
def test_settings_that_no_device_can_satisfy_are_one_clear_line(settings, expected_error):
    with pytest.raises(TransportSettingsError) as caught:
        open_transport(**settings)
    assert expected_error in str(caught.value)
    assert "; write " in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("interface", "package"),
    [("gs_usb", "gs-usb"), ("canalystii", "canalystii"), ("cantact", "cantact"), ("neovi", "python-ics")],
)
def test_an_interface_without_its_package_says_what_to_install(monkeypatch, interface, package):
    monkeypatch.setattr(can, "find_spec", lambda module: None)
    with pytest.raises(TransportSettingsError, match=f"^link.interface: {interface} .* run: pip install {package}$"):
        open_transport("can", interface=interface, channel="0")


def test_an_interface_with_its_package_is_not_refused(monkeypatch):
    monkeypatch.setattr(can, "find_spec", lambda module: object())
    transport = create_transport("can", interface="gs_usb", channel="0")
    assert transport.name == "gs_usb 0"
    # Its library takes an adapter that was reset or unplugged for one that receives nothing.
    assert transport._mute_after_s == MUTE_AFTER_S


@pytest.mark.parametrize(
    "settings",
    [
        {"kind": "serial", "port": "/dev/does-not-exist"},
        {"kind": "can", "interface": "socketcan", "channel": "can_absent"},
        {"kind": "can", "interface": "slcan", "channel": "/dev/does-not-exist"},
        {"kind": "can", "interface": "unixcan", "channel": "/does/not/exist"},
    ],
)
def test_an_absent_device_is_waited_for(settings):
    with closing(open_transport(**settings)) as transport:
        assert transport.state is LinkState.CONNECTING
    assert transport.state is LinkState.CLOSED
    assert transport.generation == 0
    assert transport.last_error
