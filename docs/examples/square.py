"""Follow a square round and round, counter-clockwise."""

from typing import ClassVar

import msgspec
import numpy as np

from disco_hw.tasks import Editable, Positive, straight_fastest_m_s
from disco_hw.tasks.line import PathTable
from disco_hw.tasks.line.cost import PathCost
from disco_hw.tasks.line.course import PathProgress, line_course, speed_range, straight_too_fast


class SquareTask(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Sides of `side_m` from the origin on, at `speed_m_s`."""

    implied_by: ClassVar = None
    read_fields: ClassVar = ()
    file: ClassVar = None

    side_m: Positive = 1.5
    speed_m_s: Positive = 0.2

    reference_speed_m_s = property(lambda self: self.speed_m_s)

    def fault(self):
        return None

    def fastest_m_s(self, robot):
        return straight_fastest_m_s(robot)

    def beyond_robot(self, robot):
        return straight_too_fast(self.speed_m_s, robot)

    def editable(self, robot):
        return {"side_m": Editable(0.5, 50.0, "Side (m)"), **speed_range(robot)}

    def editing_note(self, robot):
        return f"At most {self.fastest_m_s(robot):.3f} m/s."

    def describe(self):
        return f"square of {self.side_m:g} m at {self.speed_m_s:g} m/s"

    def points(self):
        s = self.side_m
        return ((0.0, 0.0), (s, 0.0), (s, s), (0.0, s), (0.0, 0.0))

    def course(self):
        return line_course(self.points(), "square")

    def progress(self):
        return PathProgress(PathTable(np.array(self.points())))

    def planned(self, mode):
        return PathCost(PathTable(np.array(self.points())), self.speed_m_s)


TASK = SquareTask
