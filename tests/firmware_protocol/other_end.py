"""Whatever answers on the other end of the protocol, as the conformance suite meets it: frames to and fro, and time."""

import contextlib
import os
import time

from drivers.types import Frame, LinkState, OutgoingFrame

MS_NS = 1_000_000
_CONNECT_S = 5.0
_FRAME_LIFE_NS = 100 * MS_NS


class SimulatedEnd:
    """A robot simulator (see `tests.drivers.motor.reference_robot`) in simulated time, a millisecond a step."""

    slack_s = 0.012

    def __init__(self, robot, restarted=None):
        """`restarted(now_ns)` is the robot after a restart."""
        self.now_ns = MS_NS
        self._robot = robot
        self._restarted = restarted

    def restart(self):
        self._robot = self._restarted(self.now_ns)

    def send(self, can_id, data):
        self._robot.receive(self.now_ns, Frame(can_id, data))

    def step(self):
        """Let a millisecond pass; return the frames that came, as (time in ns, CAN id, data)."""
        self.now_ns += MS_NS
        self._robot.step(self.now_ns)
        return [(self.now_ns, frame.can_id, frame.data) for frame in self._robot.drain()]

    def wait_until_up(self):
        pass

    def close(self):
        pass


class LinkEnd:
    """Whoever is at the other end of a transport, in real time; `slack_s` is what a busy computer may add."""

    slack_s = 0.15

    def __init__(self, transport, restart=None):
        """`restart()` has the robot's controller restarted, and returns when that is done."""
        self._transport = transport
        self.restart = restart
        with contextlib.suppress(OSError):
            # A host that is late looks to the robot like a host that is silent.
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(20))
        self.wait_until_up()

    def wait_until_up(self):
        deadline, transport = time.monotonic() + _CONNECT_S, self._transport
        while transport.state is not LinkState.UP:
            assert time.monotonic() < deadline, f"{transport.name}: {transport.last_error or 'did not come up'}"
            time.sleep(0.01)

    @property
    def now_ns(self):
        return time.monotonic_ns()

    def send(self, can_id, data):
        now_ns = time.monotonic_ns()
        assert self._transport.send(OutgoingFrame(Frame(can_id, data), now_ns + _FRAME_LIFE_NS), now_ns), (
            f"{self._transport.name}: {self._transport.last_error}"
        )

    def step(self):
        time.sleep(0.001)
        return [(received.t_ns, received.frame.can_id, received.frame.data) for received in self._transport.receive()]

    def close(self):
        self._transport.close()
        with contextlib.suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
