"""Where simulation and data disagree, which effect is missing, the amended model, and how far the gap shrinks."""

from disco_hw.gap.find import find_gap
from disco_hw.gap.report.findings import GapReport

__all__ = ["GapReport", "find_gap"]
