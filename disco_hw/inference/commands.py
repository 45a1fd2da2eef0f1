"""What `disco-hw infer` does."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from disco_hw.config import load_robot_config
from disco_hw.errors import WorkError
from disco_hw.inference.infer import Inference, InferOptions, infer
from disco_hw.inference.simulate import NAMES
from disco_hw.log.load import load_drive
from disco_hw.model import Model, save_model

_SHOWN = ("wheel_radius_m", "axial_distance_m", "x_icr_m")


@dataclass(frozen=True)
class InferResult:
    """The outcome for the user."""

    inference: Inference
    model_path: Path | None
    seconds: float

    def as_dict(self) -> dict[str, Any]:
        """For `--json`."""
        return {
            "posterior": posterior_figures(self.inference),
            "undetermined": [],
            "outside_simulated": False,
            "seconds": round(self.seconds, 3),
            "model": None if self.model_path is None else str(self.model_path),
        }

    def as_text(self) -> str:
        """For a person."""
        lines = []
        for name, figures in posterior_figures(self.inference).items():
            low, high = figures["ci90"]
            lines.append(f"{name:<18} {figures['mean']:.4f}   90 % between {low:.4f} and {high:.4f}")
        return "\n".join(lines)


def posterior_figures(inference: Inference) -> dict[str, dict[str, Any]]:
    """Mean, standard deviation and 90 % interval of every parameter, in metres."""
    figures = {}
    for name in _SHOWN:
        draws = inference.draws[:, NAMES.index(name)]
        low, high = np.quantile(draws, [0.05, 0.95]).tolist()
        figures[name] = {"mean": float(draws.mean()), "sd": float(draws.std()), "ci90": [low, high]}
    return figures


def infer_command(
    logs: Sequence[Path],
    robot: Path,
    out: Path | None,
    paper: bool = False,
    simulations: int | None = None,
    seed: int = 1,
    say: Callable[[str], None] = lambda _: None,
) -> InferResult:
    """Infer the geometry from logs and write the model to `out`; raises InputError for what the user can mend."""
    began = perf_counter()
    config = load_robot_config(robot)
    drive = load_drive(list(logs), config.robot.ticks_per_rev, config.robot.wheel_radius_m)
    result = infer(drive, config, InferOptions(paper, simulations, seed), say)
    if out is not None:
        try:
            save_model(result.model(Model.nominal(config.robot)), out)
        except OSError as error:
            raise WorkError(f"{out}: cannot be written ({error.strerror}); give another path") from None
    return InferResult(result, out, perf_counter() - began)
