import os
import re
import shutil
import socket
import subprocess
import sys
from contextlib import suppress
from importlib.resources import files
from pathlib import Path

import pytest

from disco_hw.daemon.process import Notifier

UNIT = files("disco_hw") / "daemon" / "systemd" / "disco-hw@.service"
PAGE = Path(__file__).parents[2] / "docs" / "service.md"
SECOND_NS = 1_000_000_000


@pytest.fixture(params=["path", "abstract"])
def manager(request, tmp_path):
    """A service manager's end: a real datagram socket and the environment that names it."""
    name = str(tmp_path / "notify") if request.param == "path" else f"@disco-hw-test-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(name.replace("@", "\0"))
        listener.settimeout(5.0)
        yield listener, {"NOTIFY_SOCKET": name}


def received(listener):
    listener.setblocking(False)
    messages = []
    with suppress(BlockingIOError):
        while True:
            messages.append(listener.recv(4096).decode())
    return messages


def test_messages_arrive_over_path_and_abstract_sockets(manager):
    listener, environment = manager
    notifier = Notifier(environment)
    notifier.ready()
    notifier.status("ARMED:\ncommanding zero speed")
    notifier.stopping()
    assert received(listener) == ["READY=1", "STATUS=ARMED: commanding zero speed", "STOPPING=1"]


def test_the_watchdog_is_fed_at_half_its_interval(manager):
    listener, environment = manager
    notifier = Notifier({**environment, "WATCHDOG_USEC": "1000000", "WATCHDOG_PID": str(os.getpid())})
    fed_at_s = []
    for tick in range(101):
        notifier.watchdog(tick * SECOND_NS // 50)
        if received(listener) == ["WATCHDOG=1"]:
            fed_at_s.append(tick / 50)
    assert fed_at_s == [0.0, 0.5, 1.0, 1.5, 2.0]


@pytest.mark.parametrize(
    "variables",
    [
        {},
        {"WATCHDOG_USEC": "1000000", "WATCHDOG_PID": "1"},
        {"WATCHDOG_USEC": "0"},
        {"WATCHDOG_USEC": "soon"},
        {"WATCHDOG_USEC": "1000000", "WATCHDOG_PID": "me"},
    ],
)
def test_no_watchdog_is_fed_that_is_off_or_another_process_s(manager, variables):
    listener, environment = manager
    notifier = Notifier({**environment, **variables})
    notifier.watchdog(0)
    assert received(listener) == []


@pytest.mark.parametrize("environment", [{}, {"NOTIFY_SOCKET": ""}, {"NOTIFY_SOCKET": "vsock:2:1"}])
def test_without_a_service_manager_nothing_happens(environment):
    notifier = Notifier(environment)
    notifier.ready()
    notifier.watchdog(0)


def test_a_manager_that_has_gone_or_does_not_read_is_never_waited_for(tmp_path):
    environment = {"NOTIFY_SOCKET": str(tmp_path / "notify")}
    Notifier(environment).ready()
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(environment["NOTIFY_SOCKET"])
        deaf = Notifier(environment)
        for _ in range(2000):
            deaf.status("x" * 500)


def test_a_process_started_like_a_service_reports_ready(tmp_path):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(tmp_path / "notify"))
        listener.settimeout(10.0)
        script = "from disco_hw.daemon.process import Notifier\nNotifier().ready()"
        environment = {**os.environ, "NOTIFY_SOCKET": str(tmp_path / "notify")}
        subprocess.run([sys.executable, "-c", script], env=environment, check=True)
        assert listener.recv(64) == b"READY=1"


def settings():
    lines = [line for line in UNIT.read_text(encoding="utf-8").splitlines() if "=" in line and line[0] != "#"]
    return [tuple(line.split("=", 1)) for line in lines]


def test_the_unit_restarts_watches_stops_and_does_not_arm():
    unit = settings()
    for expected in (
        ("Type", "notify"),
        ("WatchdogSec", "1"),
        ("Restart", "on-failure"),
        ("RestartPreventExitStatus", "2"),
        # Poses and obstacles may come in by an address that is up only then.
        ("Wants", "network-online.target"),
        ("After", "network-online.target"),
        ("ExecStart", "/opt/disco-hw/.venv/bin/disco-hw run /etc/disco-hw/%i.toml"),
        ("ExecStopPost", "/opt/disco-hw/.venv/bin/disco-hw estop /etc/disco-hw/%i.toml"),
        ("LimitRTPRIO", "99"),
        ("LimitMEMLOCK", "infinity"),
    ):
        assert expected in unit
    commands = [value for key, value in unit if key.startswith("Exec")]
    assert not any(verb in command for command in commands for verb in (" arm", " ctl ", " start"))


def test_the_unit_leaves_a_stranger_little_to_take_over(tmp_path):
    analyse = shutil.which("systemd-analyze")
    if analyse is None:
        pytest.skip("systemd-analyze is not installed: apt-get install systemd")
    unit = tmp_path / "disco-hw@wombot.service"
    unit.write_text(UNIT.read_text(encoding="utf-8"), encoding="utf-8")
    command = [analyse, "security", "--offline=true", "--no-pager", str(unit)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    exposure = re.search(r"Overall exposure level .*: ([0-9.]+)", done.stdout)
    assert exposure, done.stderr
    assert float(exposure[1]) <= 3.0


def test_the_unit_keeps_what_driving_needs():
    unit = dict(settings())
    assert "RestrictRealtime" not in unit
    assert "MemoryDenyWriteExecute" not in unit
    assert not unit.keys() & {"PrivateDevices", "DevicePolicy", "DeviceAllow", "PrivateNetwork", "PrivateUsers"}
    # libusb, which a gs_usb adapter needs, waits for devices over AF_NETLINK.
    assert {"AF_CAN", "AF_UNIX", "AF_NETLINK"} <= set(unit["RestrictAddressFamilies"].split())
    assert unit["SupplementaryGroups"] == "dialout"
    filters = [value for key, value in settings() if key == "SystemCallFilter"]
    # @resources has sched_setscheduler, @memlock has mlockall; both are in @system-service.
    assert filters == ["@system-service", "~@privileged"]


def test_the_page_gives_key_files_to_the_units_user():
    """A copy by root keeps mode 600 and is root's, so that the daemon could not read it."""
    user = dict(settings())["User"]
    assert re.search(rf"^sudo install -o {user} -m 600 KEY_FILE ", PAGE.read_text(encoding="utf-8"), re.MULTILINE)


def test_each_measure_of_the_unit_says_what_it_is_for():
    lines = UNIT.read_text(encoding="utf-8").split("# What it may not do")[1].splitlines()[1:]
    explained = False
    for line in lines:
        explained = line.startswith("#") or (explained and bool(line))
        assert explained or not line or line.startswith(("[", "WantedBy")), line
