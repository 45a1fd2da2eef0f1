"""The verbs of the command line."""

import subprocess
import sys

from typer.testing import CliRunner

from disco_hw.cli import app


def call(*arguments):
    """Return what a verb prints that ends well."""
    done = CliRunner().invoke(app(), [*map(str, arguments)], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done.stdout


def refusal_of_import(path, robot, timeout=None):
    """Return what `disco-hw import`, as a process of its own, says of a file that it refuses."""
    out = robot.with_name("refused.mcap")
    command = [sys.executable, "-m", "disco_hw", "import", str(path), "--robot", str(robot), "-o", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=timeout)
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    assert not out.exists()
    return done.stderr
