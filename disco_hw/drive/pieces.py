"""The pieces that scripts are made of: held or played shares of the largest wheel speed, and rests."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from disco_hw.drive.script import Manoeuvre

Profile = Callable[[float], tuple[float, float]]
REST_S = 0.6


def rest(duration_s: float = REST_S, purpose: str = "separates what comes before from what comes after") -> Manoeuvre:
    """Stand still."""
    return Manoeuvre("rest", purpose, duration_s, lambda _t_s: (0.0, 0.0))


@dataclass(frozen=True, slots=True)
class Pieces:
    """Manoeuvres as shares of `top_rad_s`: (forward, turn to the left)."""

    top_rad_s: float

    def play(self, name: str, purpose: str, duration_s: float, profile: Profile) -> Manoeuvre:
        """Shares as a function of the time since its start (s)."""

        def wheels(t_s: float) -> tuple[float, float]:
            forward, turn = profile(t_s)
            return (forward - turn) * self.top_rad_s, (forward + turn) * self.top_rad_s

        return Manoeuvre(name, purpose, duration_s, wheels)

    def hold(self, name: str, purpose: str, duration_s: float, forward: float, turn: float) -> Manoeuvre:
        """Constant shares."""
        return self.play(name, purpose, duration_s, lambda _t_s: (forward, turn))

    def each(self, purpose: str, *held: tuple[str, float, float, float]) -> list[Manoeuvre]:
        """Several held ones (name, duration, forward, turn), each followed by a rest."""
        return [part for one in held for part in (self.hold(one[0], purpose, *one[1:]), self.rest())]

    @staticmethod
    def rest(duration_s: float = REST_S) -> Manoeuvre:
        """Stand still."""
        return rest(duration_s)
