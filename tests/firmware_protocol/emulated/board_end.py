"""The emulated board as the conformance suite meets it."""

import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

from drivers.transport import serial
from tests.firmware_protocol.other_end import LinkEnd
from tools.emulated_board import build_board, running_board


class BoardEnd(LinkEnd):
    """A board that runs until `close`, on its serial line; `bench` is its test bench."""

    def __init__(self, processor, **settings):
        with ExitStack() as stack:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            image = build_board(processor, folder)
            self.board = stack.enter_context(running_board(image, processor, **settings))
            self.bench = self.board.bench
            transport = serial.make_transport(port=self.board.port)
            transport.open()
            stack.callback(transport.close)
            super().__init__(transport, self.press_reset)
            self._stack = stack.pop_all()

    def press_reset(self):
        number = self.bench.latest().start + 1
        self.bench.do("r")
        self.wait_for_start(number)

    def wait_for_start(self, number, within_s=10.0):
        """Wait until the controller has started so often since the emulator was."""
        deadline = time.monotonic() + within_s
        while self.bench.latest().start < number:
            assert time.monotonic() < deadline, f"start {self.bench.rows[-1].start} is still the last"

    def close(self):
        super().close()
        self._stack.close()
