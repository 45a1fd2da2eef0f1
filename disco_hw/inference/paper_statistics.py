"""The paper's summary statistics (section V-B): mean x, mean y, mean step in x, mean step in y."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from disco_hw.inference.excitation import Excitation

Array = NDArray[np.float64]

STATISTICS = ("mean x", "mean y", "mean dx", "mean dy")


@dataclass(frozen=True, slots=True)
class PaperStatistics:
    """Call it with poses (n, P, 3) for the statistics (n, 4), in metres; steps across runs do not count."""

    starts: NDArray[np.bool_]

    def __call__(self, poses: Array) -> Array:
        """Means over all poses of the log."""
        steps = np.diff(poses[:, :, :2], axis=1)[:, ~self.starts[1:]]
        return np.column_stack([poses[:, :, :2].mean(axis=1), steps.mean(axis=1)])


def paper_statistics(drive: Excitation) -> PaperStatistics:
    """The statistics of a drive."""
    return PaperStatistics(drive.starts)
