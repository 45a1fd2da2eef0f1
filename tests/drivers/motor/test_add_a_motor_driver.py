"""The driver of docs/add-a-motor-driver.md passes the suite, and robot.toml takes its name."""

import math
import struct
from pathlib import Path
from types import ModuleType

import pytest
from msgspec.structs import replace

import drivers.motor
from disco_hw.config import load_robot_config
from disco_hw.errors import InputError
from disco_hw.runtime.assembly import preflight
from drivers.motor import create_driver, motor_drivers
from drivers.types import DriverState, Frame
from tests.drivers.motor.bench import Bench
from tests.drivers.motor.conformance import DriverConformance
from tests.drivers.motor.test_motor_drivers import robot_toml

EXAMPLE = Path(__file__).parents[3] / "docs/examples/toy.py"
CODE = EXAMPLE.read_text(encoding="utf-8")
toy = ModuleType("toy")
exec(compile(CODE, str(EXAMPLE), "exec"), toy.__dict__)

TICKS_PER_REV = 1000
WATCHDOG_NS = 100_000_000
PERIOD_NS = 10_000_000


class ToyController:
    """The other end: checks session and checksum, keeps the watchdog, latches. Its wheels follow at once."""

    def __init__(self, first_ticks=(0, 0)):
        self.first_ticks = first_ticks
        self.angle, self.speed, self.setpoint = [0.0, 0.0], [0.0, 0.0], (0.0, 0.0)
        self.state, self.session, self.cause = toy.IDLE, 255, 0
        self.broken = self.pressed = False
        self._deadline_ns = self._last_ns = self._sent_ns = 0
        self._request = 0
        self._outgoing = []

    @property
    def armed(self):
        return self.state == toy.ARMED

    @property
    def speed_rad_s(self):
        return max(abs(speed) for speed in self.speed)

    def receive(self, now_ns, frame):
        if frame.can_id == toy.STOP_ID:
            self.state = toy.ESTOP
        data = frame.data
        if frame.can_id != toy.COMMAND_ID or len(data) != 8 or data[0] != toy.checksum(frame.can_id, data[1:]):
            return
        request, session, valid_ms, left, right = struct.unpack("<BBBhh", data[1:])
        # One reset for each time that it is asked for: a request held since before the cause was gone counts no more.
        is_new, self._request = request != self._request, request
        if request == 3 and is_new and self.state in (toy.FAULT, toy.ESTOP) and not (self.broken or self.pressed):
            self.state = toy.IDLE
        if request == 2 and self.state == toy.IDLE and session != self.session and (left, right) == (0, 0):
            self.state, self.session = toy.ARMED, session
        if self.state == toy.ARMED and session == self.session:
            if request != 2:
                self.state, self.cause = toy.IDLE, 1
            self.setpoint = (left * 1e-3, right * 1e-3)
            self._deadline_ns = now_ns + min(WATCHDOG_NS, valid_ms * 1_000_000)

    def step(self, now_ns):
        self.angle = [a + v * (now_ns - self._last_ns) * 1e-9 for a, v in zip(self.angle, self.speed, strict=True)]
        self._last_ns = now_ns
        if self.armed and now_ns > self._deadline_ns:
            self.state, self.cause = toy.IDLE, 2
        self.state = toy.ESTOP if self.pressed else toy.FAULT if self.broken else self.state
        self.speed = list(self.setpoint) if self.armed else [0.0, 0.0]
        if now_ns - self._sent_ns >= PERIOD_NS:
            self._sent_ns = now_ns
            per_tick = 2 * math.pi / TICKS_PER_REV
            ticks = [
                (first + math.floor(a / per_tick)) % 4096 for first, a in zip(self.first_ticks, self.angle, strict=True)
            ]
            self._send(toy.STATE_ID, struct.pack("<BBBHH", self.state, self.session, self.cause, TICKS_PER_REV, 8000))
            speeds = struct.pack("<hh", *(round(1e3 * speed) for speed in self.speed))
            self._send(toy.WHEELS_ID, speeds + (ticks[0] << 12 | ticks[1]).to_bytes(3))

    def _send(self, can_id, payload):
        self._outgoing.append(Frame(can_id, bytes([toy.checksum(can_id, payload)]) + payload))

    def drain(self):
        outgoing, self._outgoing = self._outgoing, []
        return outgoing

    def press_estop(self, pressed):
        self.pressed = pressed

    def break_down(self, broken):
        self.broken = broken


class TestToyDriver(DriverConformance):
    frame_ids = range(0x210, 0x213)
    estop_id = toy.STOP_ID

    def create_driver(self):
        return toy.DRIVER.make(None, None)

    def create_robot(self, first_ticks=(0, 0)):
        return ToyController(first_ticks)

    def near_the_wrap(self):
        return (4096 - 300, 300)


@pytest.mark.parametrize(("max_speed_rad_s", "refused"), [(8.0, False), (8.1, True)])
def test_robot_toml_may_not_ask_for_more_than_its_limits(tmp_path, max_speed_rad_s, refused):
    file = robot_toml(tmp_path, 'kind = "can"')
    robot = load_robot_config(file)
    ours = replace(robot.robot, max_wheel_speed_rad_s=max_speed_rad_s, ticks_per_rev=TICKS_PER_REV)
    bench = Bench(toy.DRIVER.make(None, None), ToyController())
    bench.run_until(DriverState.STANDBY)
    errors = preflight(replace(robot, robot=ours), bench.driver, with_task=False)
    assert [error.partition(":")[0] for error in errors] == ["robot.max_wheel_speed_rad_s"] * refused


@pytest.fixture
def in_the_folder(tmp_path, monkeypatch):
    """The example as if it lay in drivers/motor."""
    (tmp_path / "toy.py").write_text(CODE, encoding="utf-8")
    monkeypatch.setattr(drivers.motor, "__path__", [*drivers.motor.__path__, str(tmp_path)])
    motor_drivers.cache_clear()
    yield
    motor_drivers.cache_clear()


@pytest.mark.usefixtures("in_the_folder")
def test_robot_toml_takes_its_name_and_no_key(tmp_path):
    assert load_robot_config(robot_toml(tmp_path, 'driver = "toy"')).link.driver == "toy"
    assert create_driver("toy").state is DriverState.DISCONNECTED
    with pytest.raises(InputError, match=r"link\.key_file: the driver toy has no authenticated mode; remove it"):
        load_robot_config(robot_toml(tmp_path, 'driver = "toy"\nkey_file = "robot.key"'))


def test_without_the_file_its_name_is_refused(tmp_path):
    with pytest.raises(InputError, match="no driver"):
        load_robot_config(robot_toml(tmp_path, 'driver = "toy"'))
