"""The paper's experiments as functions: each returns a result that writes its table, picture and CSV."""

from disco_hw.control.experiments.circle import CircleOptions, CircleResult, run_circle
from disco_hw.control.experiments.pendulum import PendulumOptions, PendulumResult, run_pendulum

__all__ = ["CircleOptions", "CircleResult", "PendulumOptions", "PendulumResult", "run_circle", "run_pendulum"]
