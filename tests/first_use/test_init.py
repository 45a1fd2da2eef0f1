"""`disco-hw init`: what is heard on a link that is only listened to, and a robot.toml that the other verbs take."""

from __future__ import annotations

import os
import select
import termios
import threading
import time
import tty
from collections import deque
from contextlib import contextmanager
from pathlib import Path

import pytest

from disco_hw.adaptation.guard import choose_adaptation
from disco_hw.config import load_robot_config
from disco_hw.errors import InputError
from disco_hw.first_use import InitOptions, recognised, run_init
from disco_hw.runtime.robot_setup import load_setup
from drivers.motor import motor_drivers
from drivers.motor.roboclaw_protocol import FIRST_ADDRESS, GETTERS, LAST_ADDRESS
from drivers.types import Frame
from sim.devices.roboclaw import Roboclaw
from sim.plant_parameters import PlantParameters
from tests.first_use.miswired import MiswiredRobot, Miswiring, robot_file
from tests.hil.stack import disco_here, virtual_robot
from tools.stack import write_robot_file

OUTPUT_SPEED = 5
"""In what `termios.tcgetattr` gives."""
SIMULATED = {"reference": {}, "odrive": {"nodes": [3, 5]}, "vesc": {"nodes": [23, 51]}, "agilex": {}}


def init(tmp_path, prompt_user=None, name="robot.toml", **options):
    return run_init(InitOptions(tmp_path / name, **options), prompt_user, lambda _text: None)


@pytest.mark.parametrize("driver", SIMULATED)
def test_a_controller_is_known_by_what_it_sends_unasked(tmp_path, driver):
    robot = MiswiredRobot(load_setup(robot_file(tmp_path, driver)), PlantParameters(), Miswiring())
    robot.advance(2_000_000)
    frames = [received.frame for received in robot.host.receive()]
    robot.close()
    assert [(one.driver, one.fields) for one in recognised(frames)] == [(driver, SIMULATED[driver])]


def test_foreign_frames_are_nobodys():
    assert recognised([Frame(can_id, bytes(8)) for can_id in range(0x800)]) == ()


@pytest.mark.parametrize("driver", motor_drivers())
def test_what_is_written_for_any_driver_is_accepted(tmp_path, driver):
    out = init(tmp_path, driver=driver)
    assert load_robot_config(out).link.driver == driver
    assert "disco-hw commission" in out.read_text(encoding="utf-8")


def test_the_robot_learns_its_geometry_while_it_drives(tmp_path):
    setup = load_setup(init(tmp_path, driver="reference"))
    assert choose_adaptation(setup.config.control, setup.config.pose, setup.model).kind == "fast"


def test_what_a_person_answers_stands_in_the_file(tmp_path):
    answers = iter(["0.1", "", "nonsense", "4096", ""])
    robot = load_robot_config(init(tmp_path, lambda _prompt: next(answers), driver="reference")).robot
    assert (robot.wheel_radius_m, robot.axial_distance_m, robot.ticks_per_rev) == (0.1, 0.31, 4096)


def test_a_file_that_is_there_stays_unless_told_otherwise(tmp_path):
    out = tmp_path / "robot.toml"
    out.write_text("mine")
    with pytest.raises(InputError, match="is there already"):
        init(tmp_path, driver="reference")
    assert out.read_text() == "mine"
    init(tmp_path, driver="reference", overwrite=True)
    assert "[robot]" in out.read_text(encoding="utf-8")


UNFIT = {
    "a directory": (lambda path: path, "is a directory"),
    "under a file": (lambda path: Path(__file__) / "robot.toml", "is not a directory"),
    "a name that is too long": (lambda path: path / ("x" * 300), r"cannot be written \(File name too long\)"),
    "a file system of the kernel": (lambda path: Path("/proc/self/robot.toml"), "cannot be written"),
}


@pytest.mark.parametrize(("place", "expected_error"), UNFIT.values(), ids=UNFIT)
@pytest.mark.parametrize("overwrite", [False, True])
def test_what_cannot_be_written_is_refused_in_one_line_and_nothing_is_left(tmp_path, place, expected_error, overwrite):
    out = place(tmp_path)
    with pytest.raises(InputError, match=expected_error) as refused:
        init(out.parent, name=out.name, driver="reference", overwrite=overwrite)
    assert str(refused.value).startswith(f"{out}: ")
    assert "\n" not in str(refused.value)
    assert not list(tmp_path.iterdir())


def test_without_a_controller_it_says_what_to_name(tmp_path):
    with pytest.raises(InputError, match=r"--driver with one of .*odrive"):
        init(tmp_path)


def test_what_no_robot_is_like_is_refused_and_nothing_is_left(tmp_path):
    with pytest.raises(InputError, match=r"robot.wheel_radius_m"):
        init(tmp_path, driver="odrive", measures=(("wheel_radius_m", 9.0),))
    assert not list(tmp_path.iterdir())


@contextmanager
def line_with(*boards, chatter=b"", late_s=0.0):
    """A serial port with these boards at its other end, at 115200 baud; its name, and all that they have heard.

    `late_s`: from a question to its reply.
    """
    robot, host = os.openpty()
    tty.setraw(host)
    received_bytes, ended = bytearray(), threading.Event()

    def serve():
        waiting = deque()
        while not ended.is_set():
            if chatter:
                os.write(robot, chatter)
            if select.select([robot], [], [], 0.002)[0]:
                received = os.read(robot, 4096)
                received_bytes.extend(received)
                # What is sent at another speed is noise to a board, and its replies are to this computer.
                if termios.tcgetattr(host)[OUTPUT_SPEED] == termios.B115200:
                    waiting.append((time.monotonic() + late_s, received))
            while waiting and waiting[0][0] <= time.monotonic():
                _, received = waiting.popleft()
                for board in boards:
                    os.write(robot, board.receive(0, received))

    served = threading.Thread(target=serve)
    served.start()
    try:
        yield os.ttyname(host), received_bytes
    finally:
        ended.set()
        served.join()
        os.close(host)
        os.close(robot)


def from_line(tmp_path, port, prompt_user=None, **options):
    return init(tmp_path, prompt_user, link=f"serial:{port}", listen_s=0.1, **options)


ONE, TWO = ["128/1", "128/2"], [["128/1", "128/2"], ["129/1", "129/2"]]


@pytest.mark.parametrize(("addresses", "motors"), [((0x80,), ONE), ((0x80, 0x81), TWO)])
def test_a_roboclaw_is_found_by_its_version_and_by_nothing_that_moves_or_writes(tmp_path, addresses, motors):
    boards = [Roboclaw(address) for address in addresses]
    with line_with(*boards) as (port, received_bytes):
        out = from_line(tmp_path, port, is_interactive=True)
    link = load_robot_config(out).link
    found = [list(side) if isinstance(side, tuple) else side for side in link.settings().motors]
    assert (link.driver, link.port, link.baud, found) == ("roboclaw", port, 115_200, motors)
    version = GETTERS["version"].command
    everyone = range(FIRST_ADDRESS, LAST_ADDRESS + 1)
    # All once; then again those who have not replied, and any whose reply came while this computer was held up.
    queried = [received_bytes[at] for at in range(0, len(received_bytes), 2)]
    assert queried[: len(everyone)] == list(everyone)
    assert {address for address in everyone if address not in addresses} <= set(queried[len(everyone) :])
    assert bytes(received_bytes) == b"".join(bytes((address, version)) for address in queried)
    assert not any(board.obeyed for board in boards)


def test_a_board_whose_replies_come_late_to_a_busy_computer_is_found_at_its_own_speed(tmp_path):
    """Later than in the protocol, as to a process that is not run for a while: the other speeds are not its own."""
    with line_with(Roboclaw(), late_s=0.06) as (port, _received):
        link = load_robot_config(from_line(tmp_path, port, is_interactive=True)).link
    assert (link.driver, link.baud) == ("roboclaw", 115_200)


def test_a_silent_line_is_asked_only_with_somebodys_leave(tmp_path):
    with line_with(Roboclaw()) as (port, received_bytes):
        for answers in (None, lambda _prompt: "n"):
            with pytest.raises(InputError, match=r"no controller was recognised; .* or give --ask"):
                from_line(tmp_path, port, answers)
        assert not received_bytes
        assert load_robot_config(from_line(tmp_path, port, lambda _prompt: "y" if "[y/n]" in _prompt else "")).link
        assert received_bytes


def test_who_names_the_controller_has_given_leave(tmp_path):
    with line_with(Roboclaw(0x83)) as (port, _received):
        link = load_robot_config(from_line(tmp_path, port, driver="roboclaw")).link
    assert link.settings().motors == ("131/1", "131/2")


def test_a_line_on_which_something_speaks_is_not_asked(tmp_path):
    with line_with(Roboclaw(), chatter=b"$GPGGA,1*00\r\n") as (port, received_bytes):
        with pytest.raises(InputError, match="no controller was recognised"):
            from_line(tmp_path, port, is_interactive=True)
        assert not received_bytes


@pytest.mark.hil
@pytest.mark.parametrize(
    ("device", "link", "shown", "is_checked"),
    [
        ("odrive", "can:unixcan:{}/bus", {"nodes": (3, 5)}, False),
        # A kernel to compile; tests/hil/test_check.py checks another robot in every `make test`.
        pytest.param("odrive", "can:unixcan:{}/bus", {"nodes": (3, 5)}, True, marks=pytest.mark.thorough),
        pytest.param("roboclaw", "serial:{}/tty", {"motors": ("128/1", "128/2")}, True, marks=pytest.mark.long),
    ],
)
def test_from_the_link_of_a_virtual_robot_to_a_file_that_check_accepts(tmp_path, device, link, shown, is_checked):
    robot = write_robot_file(tmp_path, device=device)
    out = tmp_path / "mine.toml"
    with virtual_robot(robot):
        options = ["-o", str(out), "--link", link.format(tmp_path), "--yes", "--ask", "--listen-s", "1"]
        code, output = disco_here("init", *options)
        assert code == 0, output
        config = load_robot_config(out)
        assert config.link.driver == device
        assert {name: getattr(config.link.settings(), name) for name in shown} == shown
        if is_checked:
            _, checked = disco_here("check", str(out))
            assert "FAIL  link" not in checked
            assert "FAIL  firmware" not in checked, checked
