"""A serial device made of a pseudo-terminal: a fixed name, and somebody at the far end who can pull the cable out."""

import os
import tempfile
import threading
import tty
from pathlib import Path


class PseudoTerminal:
    """`path` is what the driver opens; what it writes is gathered in `received`."""

    def __init__(self):
        self._directory = tempfile.TemporaryDirectory()
        self.path = Path(self._directory.name) / "ttyTEST"
        self.received = bytearray()
        self._master = -1
        self._reading = threading.Event()
        self._reader = None
        self.plug()

    @property
    def lines(self):
        """Return what was received, cut at carriage returns."""
        return bytes(self.received).split(b"\r")[:-1]

    def plug(self):
        """Appear, as a new device under the same name."""
        self._master, slave = os.openpty()
        tty.setraw(slave)
        self.path.symlink_to(os.ttyname(slave))
        self.received.clear()
        self._start_reading(slave)

    def unplug(self):
        """Vanish: the name and the line."""
        self.stop_reading()
        self.path.unlink()
        os.close(self._master)

    def close(self):
        """Vanish for good."""
        self.unplug()
        self._directory.cleanup()

    def write(self, data):
        """Send to the driver."""
        os.write(self._master, data)

    def stop_reading(self):
        """Take nothing more from the line, as a device that hangs."""
        self._reading.clear()
        self._reader.join()

    def read_on(self):
        """Take from the line again."""
        self._start_reading(None)

    def _start_reading(self, slave):
        self._reading.set()
        self._reader = threading.Thread(target=self._read, args=(self._master, slave), daemon=True)
        self._reader.start()

    def _read(self, master, slave):
        os.set_blocking(master, False)
        pause = threading.Event()
        while self._reading.is_set():
            try:
                self.received.extend(os.read(master, 4096))
            except OSError:  # nothing to read, or nobody has the line open
                pause.wait(0.002)
        if slave is not None:
            # Held until now, so that the line exists before the driver has opened it.
            os.close(slave)
