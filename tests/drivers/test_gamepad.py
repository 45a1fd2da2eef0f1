"""The gamepad through evdev's own reader, fed with the kernel's event structures through a pipe or by uinput."""

from __future__ import annotations

import errno
import os
import struct
import sys
from pathlib import Path

import pytest

if not sys.platform.startswith("linux"):
    pytest.skip("evdev is Linux only", allow_module_level=True)

import evdev
from evdev import ecodes
from evdev.device import AbsInfo
from evdev.eventio import EventIO

from drivers.gamepad import Gamepad, GamepadError, GamepadMapping, open_gamepad
from tests.drivers.waiting import wait_until

EVENT = struct.Struct("@llHHi")
LOW, HIGH = -32768, 32767


class PipedPad(EventIO):
    """Stands for the device node: evdev's own reader on a pipe; what needs ioctl is answered here."""

    name = "piped pad"

    def __init__(self):
        self.fd, self.feed = os.pipe2(os.O_NONBLOCK)
        self.axes = {ecodes.ABS_X: 0, ecodes.ABS_Y: 0}
        self.keys = []

    def absinfo(self, code):
        return AbsInfo(self.axes[code], LOW, HIGH, 0, 0, 0)

    def active_keys(self):
        return list(self.keys)

    def send(self, *events):
        os.write(self.feed, b"".join(EVENT.pack(0, 0, *event) for event in (*events, (ecodes.EV_SYN, 0, 0))))

    def unplug(self):
        os.close(self.feed)

    def close(self):
        if self.fd >= 0:
            os.close(self.fd)
            self.fd = -1


@pytest.fixture
def device():
    made = PipedPad()
    yield made
    made.close()


@pytest.fixture
def pad(device):
    return Gamepad(device, GamepadMapping(), 0)


def stick(code, value):
    return (ecodes.EV_ABS, code, value)


def button(value, code=ecodes.BTN_TL):
    return (ecodes.EV_KEY, code, value)


def test_sticks_and_deadman_are_held_until_they_change(device):
    pad = Gamepad(device, GamepadMapping(dead_zone=0.0), now_ns=5)
    assert pad.poll(10).event_ns == 5
    device.send(stick(ecodes.ABS_Y, LOW), stick(ecodes.ABS_X, HIGH), button(1))
    state = pad.poll(20)
    assert (state.event_ns, state.deadman) == (20, True)
    assert state.forward == pytest.approx(1.0)
    assert state.left == pytest.approx(-1.0)
    assert pad.poll(30) == state
    device.send(button(0))
    assert pad.poll(40).deadman is False


def test_what_is_held_at_the_start_is_known(device):
    device.keys, device.axes[ecodes.ABS_Y] = [ecodes.BTN_TL], LOW
    state = Gamepad(device, GamepadMapping(), 0).poll(1)
    assert state.deadman
    assert state.forward == pytest.approx(1.0)


def test_a_press_while_an_axis_is_off_its_middle_does_not_count(device, pad):
    device.send(stick(ecodes.ABS_Y, LOW))
    device.send(button(1))
    assert pad.poll(1).deadman is False
    assert "ABS_Y off the middle" in pad.refusal
    device.send(stick(ecodes.ABS_Y, 0))
    assert pad.poll(2).deadman is False, "only a new press counts"
    device.send(button(0))
    device.send(button(1))
    device.send(stick(ecodes.ABS_Y, LOW))
    state = pad.poll(3)
    assert (state.forward, state.deadman, pad.refusal) == (pytest.approx(1.0), True, "")


class TriggerPad(PipedPad):
    """A pad whose ABS_RZ is a trigger: 0 to 255, at rest 0."""

    def absinfo(self, code):
        return AbsInfo(0, 0, 255, 0, 0, 0) if code == ecodes.ABS_RZ else super().absinfo(code)


def test_a_trigger_at_rest_is_no_full_speed():
    device = TriggerPad()
    pad = Gamepad(device, GamepadMapping(forward_axis="-ABS_RZ"), 0)
    for value in (0, 255, 0):
        device.send(stick(ecodes.ABS_RZ, value))
        device.send(button(1))
        assert pad.poll(1).deadman is False
        assert "ABS_RZ off the middle" in pad.refusal
        assert "for a trigger choose a stick in the [drive] section of robot.toml" in pad.refusal
        device.send(button(0))
    device.close()


def test_an_axis_that_the_kernel_knows_only_from_the_first_report_is_judged_by_that(device):
    device.axes[ecodes.ABS_Y] = LOW
    pad = Gamepad(device, GamepadMapping(), 0)
    device.send(button(1), stick(ecodes.ABS_Y, 0))
    assert pad.poll(1).deadman


def test_a_press_that_was_lost_in_an_overrun_is_judged_too(device, pad):
    device.send(stick(ecodes.ABS_X, LOW))
    device.keys, device.axes[ecodes.ABS_X] = [ecodes.BTN_TL], LOW
    device.send((ecodes.EV_SYN, ecodes.SYN_DROPPED, 0))
    assert pad.poll(1).deadman is False


def test_a_tap_within_one_poll_leaves_the_deadman_open(device, pad):
    device.send(button(1), button(0))
    assert pad.poll(1).deadman is False


def test_the_dead_zone_is_zero_and_the_rest_begins_there(device):
    pad = Gamepad(device, GamepadMapping(dead_zone=0.2), 0)
    for value, forward in ((-0.19, 0.0), (-0.6, 0.5), (-1.0, 1.0), (0.6, -0.5)):
        device.send(stick(ecodes.ABS_Y, round(value * HIGH)))
        assert pad.poll(1).forward == pytest.approx(forward, abs=1e-3)


def test_other_axes_and_buttons_are_of_no_matter(device, pad):
    device.send(stick(ecodes.ABS_RZ, 255), button(1, ecodes.BTN_SOUTH))
    state = pad.poll(1)
    assert (state.forward, state.left, state.deadman) == (0.0, 0.0, False)


def test_an_overrun_of_the_kernels_queue_is_made_good_from_the_device(device, pad):
    device.send(button(1))
    assert pad.poll(1).deadman
    # The release was lost in the overrun: only the device knows.
    device.keys, device.axes[ecodes.ABS_X] = [], LOW
    device.send((ecodes.EV_SYN, ecodes.SYN_DROPPED, 0), button(1))
    state = pad.poll(2)
    assert state.deadman is False
    assert state.left == pytest.approx(1.0)


def test_nothing_counts_between_an_overrun_and_the_next_report(device, pad):
    os.write(device.feed, EVENT.pack(0, 0, ecodes.EV_SYN, ecodes.SYN_DROPPED, 0) + EVENT.pack(0, 0, *button(1)))
    assert pad.poll(1).deadman is False


def test_a_device_that_goes_is_noticed_and_stays_gone(device, pad):
    device.send(button(1))
    assert pad.poll(1).deadman
    device.unplug()
    assert pad.poll(2) is None
    assert pad.poll(3) is None


def test_an_error_of_the_device_is_a_device_gone(device, pad):
    device.close()
    assert pad.poll(1) is None


@pytest.mark.parametrize(
    "mapping",
    [GamepadMapping(forward_axis="ABS_NONE"), GamepadMapping(left_axis="X"), GamepadMapping(deadman_button="KEY_A")],
)
def test_unknown_names_are_refused_by_name(device, mapping):
    with pytest.raises(GamepadError, match=r"evdev has no such name.*\[drive\]"):
        Gamepad(device, mapping, 0)


def test_without_a_device_one_line_says_what_to_do(tmp_path):
    with pytest.raises(GamepadError, match="cannot be opened"):
        open_gamepad(GamepadMapping(), 0, str(tmp_path / "event0"))
    if not evdev.list_devices():
        with pytest.raises(GamepadError, match="no gamepad found"):
            open_gamepad(GamepadMapping(), 0)


def test_pads_that_do_not_fit_are_named_with_what_they_lack(monkeypatch):
    found = {
        "/dev/input/event1": ("a keyboard", {ecodes.EV_KEY: [ecodes.KEY_A]}),
        "/dev/input/event7": (
            "Dual Action", {ecodes.EV_KEY: [ecodes.BTN_TRIGGER], ecodes.EV_ABS: [ecodes.ABS_X, ecodes.ABS_Y]}
        ),
        "/dev/input/event8": ("buttons", {ecodes.EV_KEY: [ecodes.BTN_TL]}),
    }  # fmt: skip

    class Plugged:
        def __init__(self, path):
            self.name, self._capabilities = found[path]

        def capabilities(self, absinfo):
            return self._capabilities

        def close(self):
            pass

    monkeypatch.setattr(evdev, "list_devices", lambda writable: list(found))
    monkeypatch.setattr(evdev, "InputDevice", Plugged)
    with pytest.raises(GamepadError) as refused:
        open_gamepad(GamepadMapping(), 0)
    assert str(refused.value) == (
        "no gamepad found: /dev/input/event7 (Dual Action) lacks BTN_TL; /dev/input/event8 (buttons) lacks "
        "-ABS_Y, -ABS_X; plug one in, or change the [drive] section of robot.toml"
    )
    with pytest.raises(GamepadError, match=r"event1 \(a keyboard\) lacks -ABS_Y, -ABS_X, BTN_TL; change .*\[drive\]"):
        open_gamepad(GamepadMapping(), 0, "/dev/input/event1")
    del found["/dev/input/event7"], found["/dev/input/event8"]
    with pytest.raises(GamepadError, match="no gamepad found; plug one in, and let its user read"):
        open_gamepad(GamepadMapping(), 0)


def test_a_device_that_goes_while_it_is_looked_at_is_passed_over(monkeypatch):
    class Going:
        def __init__(self, _path):
            pass

        def capabilities(self, absinfo):
            raise OSError(errno.ENODEV, "No such device")

    monkeypatch.setattr(evdev, "list_devices", lambda writable: ["/dev/input/event7"])
    monkeypatch.setattr(evdev, "InputDevice", Going)
    with pytest.raises(GamepadError, match="no gamepad found"):
        open_gamepad(GamepadMapping(), 0)
    with pytest.raises(GamepadError, match="cannot be opened"):
        open_gamepad(GamepadMapping(), 0, "/dev/input/event7")


@pytest.mark.skipif(
    not os.access("/dev/uinput", os.W_OK), reason="needs /dev/uinput, to make an input device of the kernel's"
)
def test_a_device_of_the_kernel_is_found_read_and_missed():
    axes = [(code, AbsInfo(0, LOW, HIGH, 0, 0, 0)) for code in (ecodes.ABS_X, ecodes.ABS_Y)]
    made = evdev.UInput({ecodes.EV_ABS: axes, ecodes.EV_KEY: [ecodes.BTN_TL, ecodes.BTN_SOUTH]}, name="made pad")
    wait_until(lambda: made.device and Path(made.device.path).exists())
    pad = open_gamepad(GamepadMapping(), 0, made.device.path)
    made.write(*stick(ecodes.ABS_Y, LOW))
    made.write(*button(1))
    made.syn()
    state = wait_until(lambda: (polled := pad.poll(1)) and polled.deadman and polled)
    assert state.forward == pytest.approx(1.0)
    made.close()
    wait_until(lambda: pad.poll(2) is None)
    pad.close()
