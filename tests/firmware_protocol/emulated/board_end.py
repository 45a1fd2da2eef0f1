"""The emulated board as the conformance suite meets it."""

import contextlib
import os
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

import pytest

from drivers.transport import can, serial
from tests.firmware_protocol.other_end import LinkEnd
from tools.check.emulated_board import build_board, missing, running_board

EMULATED = (pytest.mark.long, pytest.mark.hil, pytest.mark.skipif(bool(missing()), reason=missing() or "all there"))
"""Marks of whatever needs the emulator."""


class BoardEnd(LinkEnd):
    """A board that runs until `close`, on its serial line; `bench` is its test bench.

    python-can's slcan wants a terminal.
    """

    def __init__(self, processor, *, slcan=False, terminal=False, **settings):
        with contextlib.suppress(OSError):
            # For the transport's threads, too: a host that is late looks to the robot like a host that is silent.
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(20))
        with ExitStack() as stack:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            image = build_board(processor, folder, slcan=slcan)
            self.board = stack.enter_context(running_board(image, processor, terminal=terminal or slcan, **settings))
            self.bench = self.board.bench
            self.slcan = slcan
            super().__init__(self.connected(), self.press_reset)
            self._stack = stack.pop_all()

    def connected(self):
        if self.slcan:
            transport = can.create_transport(
                interface="slcan", channel=self.board.port, options={"sleep_after_open": 0}
            )
        else:
            transport = serial.create_transport(port=self.board.port)
        transport.open()
        return transport

    def press_reset(self):
        number = self.bench.latest().start + 1
        self.bench.do("r")
        self.wait_for_start(number)
        if self.slcan:
            # Its channel is closed, as that of an adapter that was unplugged.
            self._transport.close()
            self._transport = self.connected()

    def wait_for_start(self, number, within_s=10.0):
        """Wait until the controller has started so often since the emulator was."""
        deadline = time.monotonic() + within_s
        while self.bench.latest().start < number:
            assert time.monotonic() < deadline, f"start {self.bench.rows[-1].start} is still the last"

    def close(self):
        super().close()
        self._stack.close()
