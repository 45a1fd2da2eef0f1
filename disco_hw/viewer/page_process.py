"""The live page as a process of its own beside a daemon that is about to start in this one."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from pathlib import Path

from disco_hw.errors import InputError

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
    command = [sys.executable, "-m", __name__, str(os.getpid()), host, str(port), str(robot), *chosen]
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


def main(arguments: list[str]) -> int:
    """Serve the page until told to stop or until the process with the first argument's number is not the parent."""
    from disco_hw.viewer.commands import view_live  # noqa: PLC0415

    parent, host, port, robot, model, link = arguments
    try:
        with redirect_stdout(sys.stderr):
            return view_live(
                Path(robot),
                Path(model) if model else None,
                host,
                int(port),
                lambda: os.getppid() != int(parent),
                link=link or None,
            )
    except InputError as error:
        print(f"page: {error}", file=sys.stderr, flush=True)
        return 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
