"""In processes of their own: signals are per process."""

import signal
import subprocess
import sys

import pytest

SCRIPT = """
import select, sys
from sim.stop_signal import StopSignal
stop = StopSignal()
assert not stop.requested and not select.select([stop.fileno()], [], [], 0)[0]
print("ready", flush=True)
select.select([stop.fileno()], [], [], 10)
sys.exit(7 if stop.requested else 1)
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signal_wakes_and_is_remembered(number):
    with subprocess.Popen([sys.executable, "-c", SCRIPT], stdout=subprocess.PIPE) as process:
        assert process.stdout.readline() == b"ready\n"
        process.send_signal(number)
        assert process.wait(10) == 7
