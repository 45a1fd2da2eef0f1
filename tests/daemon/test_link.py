"""Settings of the link that no device could satisfy are bad input: one line with file, field and remedy."""

import pytest

from disco_hw.daemon.check import run_check
from disco_hw.daemon.run import DaemonOptions, run_daemon
from disco_hw.errors import InputError
from disco_hw.runtime import assembly
from disco_hw.runtime.robot_setup import load_setup

ROBOT = """
[robot]
name = "misspelt"
wheel_radius_m = 0.06
axial_distance_m = 0.31
ticks_per_rev = 2048
max_wheel_speed_rad_s = 8.0

[link]
"""


@pytest.mark.parametrize(
    ("section", "message"),
    [
        ('interface = "sockercan"', 'link.interface: python-can has no interface "sockercan"; write one of '),
        ('interface = "socketcand"', "link.options: socketcand needs host and port; write options = { host = "),
        (
            'interface = "virtual"\noptions = { bitrate = 1 }',
            "link.options: bitrate has a field of its own; write ",
        ),
        ('interface = "slcan"\nbitrate = 123456', "link.bitrate: slcan has no 123456 bit/s; write one of "),
    ],
)
@pytest.mark.parametrize("verb", [run_check, lambda robot: run_daemon(DaemonOptions(robot))], ids=["check", "run"])
def test_what_no_device_could_satisfy_is_refused_before_anything_is_opened(tmp_path, section, message, verb):
    robot = tmp_path / "robot.toml"
    robot.write_text(ROBOT + section)
    with pytest.raises(InputError) as caught:
        verb(robot)
    assert str(caught.value).startswith(f"{robot}: {message}")
    assert "\n" not in str(caught.value)


def test_what_robot_toml_says_of_the_link_reaches_it(tmp_path, monkeypatch):
    requested = {}
    monkeypatch.setattr(assembly, "create_transport", lambda kind, **settings: requested.update(settings))
    robot = tmp_path / "robot.toml"
    robot.write_text(ROBOT + 'options = { host = "10.0.0.1", port = 29536 }\ndtr = true\nrts = true\n')
    assembly.create_link(load_setup(robot))
    assert requested["options"] == {"host": "10.0.0.1", "port": 29536}
    assert (requested["dtr"], requested["rts"]) == (True, True)
