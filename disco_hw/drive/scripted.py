"""A script as a source: its clock runs while the robot is driven, its deadman is somebody else's; pure."""

from __future__ import annotations

from disco_hw.drive.script import Manoeuvre, Script, Wheels
from disco_hw.drive.source import ManualInput, ManualSource, RobotView
from disco_hw.drive.wheel_limits import WheelLimits
from disco_hw.runtime.states import State

_LONGEST_TICK_NS = 100_000_000
_SETTLED_S = 0.8


class ScriptSource:
    """Plays a script while the deadman of another source is held.

    A manoeuvre that was broken off by disarming begins anew when driving goes on, so that each is recorded whole once.
    The wheels' limits are what they reach at the end of the manoeuvres that are to find them.
    """

    def __init__(self, script: Script, deadman: ManualSource) -> None:
        self._script = script
        self._deadman = deadman
        self._driven_ns = 0
        self._last_ns: int | None = None
        self._driven = False
        self._driving = False
        self._over = False
        self._limits = WheelLimits()

    @property
    def ended(self) -> str | None:
        """The end of the script or of the source of the deadman."""
        return f"script {self._script.name} completed" if self._over else self._deadman.ended

    @property
    def completed(self) -> bool:
        """Whether the script was played to its end."""
        return self._over

    @property
    def words(self) -> str:
        """How far it is; what to do where nothing moves."""
        progress = f"{self._driven_ns * 1e-9:.0f} of {self._script.duration_s:.0f} s"
        manoeuvre = self._manoeuvre
        name = "" if manoeuvre is None else f", {manoeuvre.name}"
        held = "" if self._driving else f"; {self._deadman.words}"
        return f"{progress}{name}{held}"

    @property
    def task(self) -> str:
        """The manoeuvre under way, or next, and the limits that it keeps where it is about them."""
        manoeuvre = self._manoeuvre
        if manoeuvre is None:
            return ""
        limits = f" ({self._limits.in_words()})" if manoeuvre.within_limits else ""
        return f"{manoeuvre.name}{limits}: {manoeuvre.purpose}"

    def poll(self, now_ns: int, robot: RobotView) -> ManualInput | None:
        """The script's wheel speeds with the other source's deadman and time."""
        held = self._deadman.poll(now_ns, robot)
        self._advance(now_ns, robot)
        if held is None:
            return None
        if self._over:
            return ManualInput(now_ns, 0.0, 0.0, deadman=False)
        left, right = self._wheels()
        return ManualInput(held.t_ns, left, right, held.deadman)

    def close(self) -> None:
        """Close the source of the deadman."""
        self._deadman.close()

    @property
    def _manoeuvre(self) -> Manoeuvre | None:
        place = self._script.place(self._driven_ns * 1e-9)
        return None if place is None else place[0]

    def _wheels(self) -> Wheels:
        wheels = self._script.at(self._driven_ns * 1e-9)
        manoeuvre = self._manoeuvre
        return self._limits.within(wheels) if manoeuvre is not None and manoeuvre.within_limits else wheels

    def _observe(self, measured: Wheels | None) -> None:
        """Learn what the wheels reach, from the end of a manoeuvre that is to find it."""
        t_s = self._driven_ns * 1e-9
        place = self._script.place(t_s)
        if measured is None or place is None or not place[0].finds_limits:
            return
        manoeuvre, began_s = place
        if t_s > began_s + manoeuvre.duration_s - _SETTLED_S:
            self._limits.observe(manoeuvre.name, manoeuvre.wheels(t_s - began_s), measured)

    def _advance(self, now_ns: int, robot: RobotView) -> None:
        if robot.driving and self._last_ns is not None:
            # A loop held up must not skip what was to be driven meanwhile.
            self._driven_ns += min(now_ns - self._last_ns, _LONGEST_TICK_NS)
            self._over = self._over or self._manoeuvre is None
            self._driven = True
            self._observe(robot.wheels)
        elif self._driven and robot.state is not State.ARMED and not self._over:
            place = self._script.place(self._driven_ns * 1e-9)
            self._driven_ns = 0 if place is None else round(place[1] * 1e9)
            self._driven = False
        self._driving = robot.driving
        self._last_ns = now_ns


class Unattended:
    """Holds the deadman by itself, once: for the virtual robot, and for tests.

    Pressed when the robot has become ready; if it does not drive within `driving_within_s`, then or after a hold while
    armed, or is disarmed by anybody, it is released for good.
    """

    def __init__(self, ready_within_s: float = 60.0, driving_within_s: float = 5.0) -> None:
        self._ready_within_ns = round(ready_within_s * 1e9)
        self._driving_within_ns = round(driving_within_s * 1e9)
        self._first_ns: int | None = None
        self._pressed_ns: int | None = None
        self._waiting_ns = 0
        self._driven = False
        self._ended: str | None = None

    @property
    def ended(self) -> str | None:
        """Why it was released."""
        return self._ended

    @property
    def completed(self) -> bool:
        """It never ends by itself as it should."""
        return False

    @property
    def words(self) -> str:
        """What it waits for."""
        return "unattended: waiting for the robot" if self._pressed_ns is None else "unattended: deadman held"

    @property
    def task(self) -> str:
        """Holding the deadman is all it does."""
        return ""

    def poll(self, now_ns: int, robot: RobotView) -> ManualInput | None:
        """The deadman; speeds are zero."""
        if self._first_ns is None:
            self._first_ns = now_ns
        held = self._pressed_ns is not None and self._ended is None
        if self._pressed_ns is None:
            if robot.state is State.READY:
                # Held from the next tick on: a deadman counts only after it was seen open.
                self._pressed_ns = self._waiting_ns = now_ns
            elif now_ns - self._first_ns > self._ready_within_ns:
                self._ended = f"the robot was not ready within {self._ready_within_ns * 1e-9:g} s"
        elif robot.driving:
            self._driven, self._waiting_ns = True, now_ns
        elif self._driven and robot.state is not State.ARMED:
            self._ended = self._ended or "the robot was disarmed before the script was over"
        elif now_ns - self._waiting_ns > self._driving_within_ns:
            hold = f"the robot held still for {self._driving_within_ns * 1e-9:g} s before the script was over"
            self._ended = self._ended or (hold if self._driven else "the robot did not start to drive")
        return ManualInput(now_ns, 0.0, 0.0, deadman=held)

    def close(self) -> None:
        """Nothing is held open."""
