"""The registry of motor controllers: robot.toml's `link.driver` names one, and each name stands in one file."""

import re
import subprocess
import sys
import tomllib
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest

from disco_hw.config import load_robot_config
from disco_hw.errors import InputError
from drivers.motor import DEFAULT, UnknownDriverError, create_driver, find_driver, motor_drivers
from drivers.types import DriverState

EXAMPLES = {name: driver.example for name, driver in motor_drivers().items()}
"""The fields that a driver has in [link] of a robot of its kind."""
ROOT = Path(__file__).parents[3]
WOMBOT = ROOT / "disco_hw/robots/wombot.toml"


ROBOCLAW = 'driver = "roboclaw"\nkind = "serial"\ncounts_per_rev = 8192.0\nwatchdog_s = 0.2\n'
ODRIVE = 'driver = "odrive"\nvel_limit_turns_s = 10.0\n'
VESC = f'driver = "vesc"\n{EXAMPLES["vesc"]}\n'


def robot_toml(folder, link):
    file = folder / "robot.toml"
    text = WOMBOT.read_text(encoding="utf-8")
    file.write_text(re.sub(r"(?m)^\[link\]\n(.+\n)*", f"[link]\n{link}\n", text))
    return file


@pytest.mark.parametrize("name", motor_drivers())
def test_every_driver_is_found_and_made_by_its_name_and_robot_toml_may_name_it(tmp_path, name):
    driver = motor_drivers()[name]
    assert driver.name == name
    assert find_driver(name) is driver
    settings = msgspec.convert(tomllib.loads(EXAMPLES[name]), driver.settings)
    assert create_driver(name, settings).state is DriverState.DISCONNECTED
    link = f'driver = "{name}"\nkind = "{driver.kinds[0]}"\n{EXAMPLES[name]}'
    assert load_robot_config(robot_toml(tmp_path, link)).link.driver == name


def test_without_a_name_the_driver_is_the_default():
    assert find_driver(None) is motor_drivers()[DEFAULT]


def test_what_needs_one_driver_reads_no_other():
    """An e-stop is not to wait for five vendors' protocols."""
    code = (
        "import sys; from drivers.motor import find_driver; find_driver(None); find_driver('vesc')\n"
        "print(*sorted(name for name in sys.modules if name.startswith('drivers.motor.')))"
    )
    names = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert {"drivers.motor.reference", "drivers.motor.vesc"} <= set(names)
    assert not {"drivers.motor.odrive", "drivers.motor.roboclaw", "drivers.motor.agilex"} & set(names)


@pytest.mark.parametrize("name", ["oddrive", "wiring"], ids=["no module", "a module beside the drivers"])
def test_a_name_that_no_driver_has_is_refused_with_those_that_there_are(name):
    with pytest.raises(UnknownDriverError, match=f'no driver "{name}"; write one of {", ".join(motor_drivers())}$'):
        create_driver(name)


@pytest.mark.parametrize(
    ("link", "expected_error"),
    [
        ('driver = "oddrive"', r"robot\.toml: link\.driver: there is no driver"),
        (
            "nodes = [3, 5]",
            r'link\.nodes: belongs to the driver "odrive" or "vesc", but link\.driver is "reference"; '
            "write driver = one of those, or remove it",
        ),
        (f"{ODRIVE}nodes = [3, 5]", r"watchdog_s: missing; add it"),
        (
            f'driver = "agilex"\n{EXAMPLES["agilex"].replace("max_turn_rad_s = 2.5", "")}',
            r"robot\.toml: \[link\] max_turn_rad_s: missing; add it",
        ),
        (f"{ODRIVE}nodes = [3, 5]\nwatchdog_s = 0.0", r"link\.watchdog_s"),
        (f"{ODRIVE}nodes = [3, 3]\nwatchdog_s = 0.1", r"link\.nodes: .*twice"),
        (f"{ODRIVE}nodes = [3, 63]\nwatchdog_s = 0.1", r"link\.nodes: .*0 to 62"),
        (f'{ROBOCLAW}motors = ["127/1", "128/2"]', r'link\.motors: "127/1" is no motor; write'),
        (f'{ROBOCLAW}motors = ["128/1", "128/1"]', r"link\.motors: a motor is listed twice"),
        (f'{ROBOCLAW}motors = ["128/1", []]', r"link\.motors: a side has no motor"),
        (ROBOCLAW.replace("0.2", "0.25") + 'motors = ["128/1", "128/2"]', r"watchdog_s: 0\.25 is not a multiple"),
        (ROBOCLAW.replace("serial", "can") + 'motors = ["128/1", "128/2"]', r'roboclaw does not .*; write "serial"'),
        (f'{VESC}kind = "serial"', r"link\.uart_node: belongs to a serial line, .*add it"),
        (f"{VESC}uart_node = 23", r"link\.uart_node: belongs to a serial line, .*remove it"),
        (f'{VESC}kind = "serial"\nuart_node = 9', r"link\.uart_node: 9 is not in link\.nodes"),
        ("of_driver = 3", r"link\.of_driver: no such field"),
        ("gears = 3", r"gears: no such field"),
    ],
)
def test_a_field_that_is_not_the_drivers_or_is_wrong_is_refused_by_name(tmp_path, link, expected_error):
    with pytest.raises(InputError, match=expected_error) as refused:
        load_robot_config(robot_toml(tmp_path, link))
    assert "\n" not in str(refused.value)


def test_a_key_for_a_driver_that_does_not_authenticate_is_refused(tmp_path, monkeypatch):
    file = robot_toml(tmp_path, f'driver = "{DEFAULT}"\nkey_file = "robot.key"')
    assert load_robot_config(file).link.key_file == "robot.key"
    mute = replace(find_driver(None), authenticates=False)
    monkeypatch.setattr("disco_hw.config.robot_file.find_driver", lambda _name: mute)
    with pytest.raises(InputError, match=r"link\.key_file: .*no authenticated mode; remove it"):
        load_robot_config(file)


def test_no_other_file_names_a_driver():
    # A curve on the page is called "reference" too; no driver is meant there.
    files = [f for top in ("disco_hw", "drivers", "sim") for f in (ROOT / top).rglob("*.py") if "viewer" not in f.parts]
    assert len(files) > 200
    named = {name: [str(file.relative_to(ROOT)) for file in files if is_named(name, file)] for name in motor_drivers()}
    assert sorted(named.pop(DEFAULT)) == ["drivers/motor/__init__.py", f"drivers/motor/{DEFAULT}.py"]
    assert named == {name: [f"drivers/motor/{name}.py"] for name in motor_drivers() if name != DEFAULT}


def is_named(name, file):
    return re.search(rf"""["']{name}["']""", file.read_text(encoding="utf-8")) is not None
