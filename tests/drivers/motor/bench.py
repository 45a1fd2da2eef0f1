"""A driver and a robot on one link in simulated time: the robot runs at 1 kHz, the host at its control rate."""

import heapq
import random

from drivers.transport.inprocess import connect_pair
from drivers.types import DriverState, Frame, LinkState, OutgoingFrame, Readings, Request, WheelCommand

MS = 1_000_000
START_NS = 50_000 * MS
FORWARD = (3.0, 2.0)
IDLE_STATES = (DriverState.STANDBY, DriverState.READY)


class Bench:
    """Steps everything; `robot` is what the conformance suite calls a robot simulator (see `ReferenceRobot`).

    `delay_ns(generator)` is how long each frame travels, `loses(generator)` whether it is lost on the way;
    `lag_ns(now_ns)` is how much longer it takes to the robot.
    """

    def __init__(self, driver, robot, *, rate_hz=50, delay_ns=None, loses=None, lag_ns=None, seed=1):
        self.driver = driver
        self.robot = robot
        self.period_ns = round(1e9 / rate_hz)
        self.now_ns = START_NS
        self.host_end, self.robot_end = connect_pair()
        self.random = random.Random(seed)
        self.delay_ns = delay_ns
        self.loses = loses
        self.lag_ns = lag_ns
        self.command = None
        self.host_runs = True
        self.readings = []
        self.largest_speed = 0.0
        self._due_ns = self.now_ns
        self._generation = 0
        self._under_way = []
        self._sequence = 0
        self.host_end.open()
        self.robot_end.open()

    @property
    def wheels(self):
        return [sample for readings in self.readings for sample in readings.wheels]

    @property
    def poses(self):
        return [sample for readings in self.readings for sample in readings.poses]

    @property
    def events(self):
        return [event for readings in self.readings for event in readings.events]

    def run(self, seconds, command=None):
        """Run for a time with a command (None: the one set before)."""
        if command is not None:
            self.command = WheelCommand(*command, 0.1)
        end_ns = self.now_ns + round(seconds * 1e9)
        while self.now_ns < end_ns:
            self.step()

    def run_until(self, *states, timeout_s=3.0):
        """Run until the driver is in one of the states; fails the test if that takes too long."""
        end_ns = self.now_ns + round(timeout_s * 1e9)
        while self.driver.state not in states:
            assert self.now_ns < end_ns, f"still {self.driver.state.value}: {self.driver.detail}"
            self.step()

    def arm(self):
        """Bring the robot from wherever it rests to ARMED; from then on the host sends zeros until it is given more."""
        self.command = self.command or WheelCommand(0.0, 0.0, 0.1)
        self.run_until(DriverState.STANDBY, DriverState.READY)
        self.driver.request(Request.ARM)
        assert self.driver.state is DriverState.ARMING
        self.run_until(DriverState.ARMED)

    def largest_speed_in(self, seconds, command=None):
        """Run as `run` does, and return the largest speed of a wheel meanwhile (rad/s)."""
        self.largest_speed = 0.0
        self.run(seconds, command)
        return self.largest_speed

    def request(self, request):
        """Ask the driver for a state; returns the bench itself."""
        self.driver.request(request)
        return self

    def drive(self, seconds, command=None):
        """Arm, and run for a time with a command (None: the one set before); returns the bench itself."""
        self.arm()
        self.run(seconds, command)
        return self

    def pause_host(self, seconds):
        """Run for a time in which the host does nothing."""
        self.host_runs = False
        self.run(seconds)
        self.host_runs = True

    def run_unread(self, seconds):
        """Run for a time in which the host does not read what comes; all of that waits for it afterwards."""
        receive, self.host_end.receive = self.host_end.receive, lambda: ()
        self.run(seconds)
        self.host_end.receive = receive

    def inject_to_host(self, can_id, data, extended=False):
        """A frame that somebody else sends; the driver sees it with its next batch."""
        self.robot_end.send(OutgoingFrame(Frame(can_id, data, extended), self.now_ns), self.now_ns)

    def inject_to_robot(self, can_id, data):
        self.robot.receive(self.now_ns, Frame(can_id, data))

    def step(self):
        """Advance everything by one millisecond."""
        self.now_ns += MS
        if self._under_way:
            self._deliver()
        robot = self.robot
        for received in self.robot_end.receive():
            robot.receive(self.now_ns, received.frame)
        robot.step(self.now_ns)
        for frame in robot.drain():
            self._send(self.robot_end, frame)
        self.largest_speed = max(self.largest_speed, robot.speed_rad_s)
        if self.now_ns >= self._due_ns:
            self._due_ns += self.period_ns
            if self.host_runs:
                self._host_tick()

    def _host_tick(self):
        if self.host_end.state is not LinkState.UP:
            if self._generation:
                self.driver.link_down(self.now_ns)
                self._generation = 0
        elif self.host_end.generation != self._generation:
            self._generation = self.host_end.generation
            self.driver.link_up(self.now_ns)
        readings = self.driver.receive(self.now_ns, self.host_end.receive())
        if readings != Readings():
            self.readings.append(readings)
        for outgoing in self.driver.transmit(self.now_ns, self.command):
            assert outgoing.deadline_ns >= self.now_ns
            self._send(self.host_end, outgoing.frame)

    def send_estop(self):
        for outgoing in self.driver.estop(self.now_ns):
            self._send(self.host_end, outgoing.frame)

    def _send(self, end, frame):
        if self.loses is not None and self.loses(self.random):
            return
        arrival_ns = self.now_ns + (round(self.delay_ns(self.random)) if self.delay_ns is not None else 0)
        if self.lag_ns is not None and end is self.host_end:
            arrival_ns += round(self.lag_ns(self.now_ns))
        self._sequence += 1
        heapq.heappush(self._under_way, (arrival_ns, self._sequence, end, frame))
        self._deliver()

    def _deliver(self):
        while self._under_way and self._under_way[0][0] <= self.now_ns:
            arrival_ns, _, end, frame = heapq.heappop(self._under_way)
            end.send(OutgoingFrame(frame, arrival_ns), arrival_ns)
