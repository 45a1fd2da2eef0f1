"""Page that shows the robot, its task and why it does what it does, live from the daemon and from a recorded log.

Here the live page as a process of its own beside a daemon, where it is found, and the token that opens it.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from disco_hw.errors import InputError

LOOPBACK = "127.0.0.1"
# Chosen: the usual port of a web server that needs no rights.
DEFAULT_PORT = 8080
TOKEN_VARIABLE = "DISCO_HW_PAGE_TOKEN"
# Chosen: of a token that somebody makes; shorter ones can be guessed.
_SHORTEST = 16
# Chosen: longer than the page's process takes to end; then it is killed.
_END_TIMEOUT_S = 3.0
# Chosen: a page that cannot start must not take the processor.
_RESTART_PAUSE_S = 1.0


class PageProcess:
    """The page's process beside a daemon: started again when a signal has ended it, and reported either way.

    A thread waits for it. Make it before the process takes a real-time priority: the thread keeps the normal one, and
    so does a page that it starts again.
    """

    def __init__(self, command: Sequence[str]) -> None:
        self._command = list(command)
        # The same token again, so that an open page connects to the next process.
        self._environment = {**os.environ, TOKEN_VARIABLE: _token_or_given()}
        self._lock = threading.Lock()
        self._messages: list[str] = []
        self._ending = threading.Event()
        self._process = self._start()
        self._thread = threading.Thread(target=self._watch, name="page watch", daemon=True)
        self._thread.start()

    @property
    def pid(self) -> int:
        """The process id of the page that runs now, or ran last."""
        return self._process.pid

    @property
    def returncode(self) -> int | None:
        """Exit code of the page's process, negative for a signal; None while it runs."""
        return self._process.returncode

    def wait(self, timeout_s: float) -> int:
        """Wait until the page ends for good and return how; raises TimeoutError."""
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            raise TimeoutError(f"the page still runs after {timeout_s:g} s")
        return self._process.returncode

    def new_messages(self) -> tuple[str, ...]:
        """Return messages about the page's process since the last call."""
        with self._lock:
            messages, self._messages = tuple(self._messages), []
        return messages

    def close(self) -> None:
        """Stop the page's process; one that does not end in time is killed."""
        with self._lock:
            self._ending.set()
            process = self._process
        process.terminate()
        self._thread.join(_END_TIMEOUT_S)
        if self._thread.is_alive():
            process.kill()
            self._thread.join()

    def _start(self) -> subprocess.Popen[bytes]:
        # A session of its own keeps the terminal's Ctrl-C from it.
        return subprocess.Popen(self._command, stdin=subprocess.DEVNULL, start_new_session=True, env=self._environment)

    def _watch(self) -> None:
        while True:
            code = self._process.wait()
            if self._ending.is_set() or code >= 0:
                # What it says itself on standard error is the reason.
                self._report(f"the page ended with exit code {code}; start it again with `disco-hw view`")
                return
            self._report(f"the page was ended by {_signal_name(-code)}; it is started again")
            if self._ending.wait(_RESTART_PAUSE_S):
                return
            with self._lock:
                if self._ending.is_set():
                    return
                try:
                    self._process = self._start()
                except OSError as error:
                    self._messages.append(f"the page cannot be started again ({error.strerror}); use `disco-hw estop`")
                    return

    def _report(self, sentence: str) -> None:
        if not self._ending.is_set():
            with self._lock:
                self._messages.append(sentence)
            print(f"page: {sentence}", file=sys.stderr, flush=True)


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


@contextmanager
def page_in_background(
    robot: Path, model: Path | None, host: str, port: int, link: str | None = None
) -> Iterator[PageProcess]:
    """Run the live page of `robot` while the block does, and end it with the block or with this process.

    `link` overrides robot.toml's kind, as for the daemon. What the page says goes to standard error: standard output
    belongs to the block.

    Enter it before taking a real-time priority, which a child would inherit. What becomes of the page does not matter
    to the block: a page that cannot start says why on standard error and is missing.
    """
    # An empty argument is none.
    chosen = ["" if model is None else str(model), link or ""]
    command = [sys.executable, "-m", f"{__name__}.commands", str(os.getpid()), host, str(port), str(robot), *chosen]
    page = PageProcess(command)
    try:
        yield page
    finally:
        page.close()


def _token_or_given() -> str:
    """Return a token for the page; one that the environment gives wrongly stays as it is, and the page refuses it."""
    try:
        return page_token()
    except InputError:
        return os.environ[TOKEN_VARIABLE]


def page_token() -> str:
    """Return the token of the page about to start: what $DISCO_HW_PAGE_TOKEN says, else one that nobody can guess.

    In a variable, and not in an argument, as other users can read the arguments of a process. Raises InputError for
    one of less than 16 characters or with others than letters, digits, - and _.
    """
    given = os.environ.get(TOKEN_VARIABLE)
    if not given:
        import secrets  # noqa: PLC0415 - slow to import for whoever only asks for the port

        return secrets.token_urlsafe(16)
    if len(given) < _SHORTEST or not given.replace("-", "").replace("_", "").isalnum() or not given.isascii():
        raise InputError(f"{TOKEN_VARIABLE}: give {_SHORTEST} or more letters, digits, - and _, or unset it")
    return given


def page_address(host: str, port: int, token: str) -> str:
    """Return the address of the page for a browser, with its token."""
    return f"http://{host}:{port}/?token={token}"
