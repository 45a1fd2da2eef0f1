"""What an armed robot owes its host: its state at least every half second, and commands taken in time."""

from __future__ import annotations

from drivers.command_echo import CommandEcho

STATE_TIMEOUT_NS = 500_000_000
# Above the 100 ms after which the robot stops by itself, so that no pause of this host alone looks like a slow link.
LATE_NS = 150_000_000


class ArmedWatch:
    """Watches both; pure. `late` counts the times that commands were late, `silent` those without the state."""

    def __init__(self) -> None:
        self.late = 0
        self.silent = 0
        self._echo = CommandEcho()
        self._told_ns: int | None = None
        self._late_ns = 0

    def sent(self, number: int, now_ns: int) -> None:
        """Remember a wheel command, by its number since the driver was made."""
        self._echo.sent(number, now_ns)

    def rest(self) -> None:
        """Nothing is commanded: expect nothing."""
        self._echo.forget()
        self._told_ns = None
        self._late_ns = 0

    def told(self, last_command_counter: int, received_ns: int) -> None:
        """Take in SYSTEM_STATE."""
        self._told_ns = received_ns
        self._late_ns = self._echo.late_ns(last_command_counter, received_ns)

    def objection(self, now_ns: int) -> str | None:
        """Return why a robot that is armed must not stay so, None while all is well; counts each call that objects."""
        if self._late_ns > LATE_NS:
            self.late += 1
            return f"commands reach the robot over {self._late_ns * 1e-9:.2f} s late; see what holds up the link"
        if self._told_ns is not None and now_ns - self._told_ns > STATE_TIMEOUT_NS:
            self.silent += 1
            return f"the robot has not told its state for {STATE_TIMEOUT_NS * 1e-9:g} s"
        return None
