"""The page: the robot, its task and why it does what it does, live from the daemon and from a recorded log.

Here the live page as a process of its own beside a daemon, where it is found, and the token that opens it.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

LOOPBACK = "127.0.0.1"
DEFAULT_PORT = 8080
TOKEN_VARIABLE = "DISCO_HW_PAGE_TOKEN"
_SHORTEST = 16
_END_TIMEOUT_S = 3.0


@contextmanager
def page_beside(
    robot: Path, model: Path | None, host: str, port: int, link: str | None = None
) -> Iterator[subprocess.Popen[bytes]]:
    """Run the live page of `robot` while the block does, and end it with the block or with this process.

    `link` overrides robot.toml's kind, as for the daemon. What the page says goes to standard error: standard output
    belongs to the block.

    Enter it before taking a real-time priority, which a child would inherit. What becomes of the page does not matter
    to the block: a page that cannot start says why on standard error and is missing.
    """
    # An empty argument is none.
    chosen = ["" if model is None else str(model), link or ""]
    command = [sys.executable, "-m", f"{__name__}.commands", str(os.getpid()), host, str(port), str(robot), *chosen]
    # A session of its own keeps the terminal's Ctrl-C from it.
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL, start_new_session=True)
    try:
        yield process
    finally:
        process.terminate()
        try:
            process.wait(_END_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def page_token() -> str:
    """The token of the page about to start: what $DISCO_HW_PAGE_TOKEN says, else one that nobody can guess.

    In a variable, and not in an argument, as other users can read the arguments of a process. Raises ValueError for
    one of less than 16 characters or with others than letters, digits, - and _.
    """
    given = os.environ.get(TOKEN_VARIABLE)
    if not given:
        import secrets  # noqa: PLC0415 - slow to import for whoever only asks for the port

        return secrets.token_urlsafe(16)
    if len(given) < _SHORTEST or not given.replace("-", "").replace("_", "").isalnum() or not given.isascii():
        raise ValueError(f"{TOKEN_VARIABLE}: give {_SHORTEST} or more letters, digits, - and _, or unset it")
    return given


def page_address(host: str, port: int, token: str) -> str:
    """What to open in a browser."""
    return f"http://{host}:{port}/?token={token}"
