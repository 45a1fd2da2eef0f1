"""Control stack for skid-steer robots on hardware: estimation, control, daemon, logging and tools (DISCO).

The names below are the public interface for programs (docs/python.md); each is loaded when it is first used, so that
`import disco_hw` itself loads nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from disco_hw.config import Robot, RobotConfig
    from disco_hw.config import load_robot_config as load_robot
    from disco_hw.control import Disco
    from disco_hw.control.black_box import BlackBoxDisco
    from disco_hw.control.parameter_points import sigma_points
    from disco_hw.daemon.run import run_robot
    from disco_hw.experiments.simulated_time import drive_virtual
    from disco_hw.gap import find_gap
    from disco_hw.inference.infer import infer
    from disco_hw.log.load import load_drive as read_log
    from disco_hw.model import Model, load_model, save_model
    from disco_hw.model.step import simulate

    __version__: str

_PUBLIC = {
    "BlackBoxDisco": ("disco_hw.control.black_box", "BlackBoxDisco"),
    "Disco": ("disco_hw.control", "Disco"),
    "Model": ("disco_hw.model", "Model"),
    "Robot": ("disco_hw.config", "Robot"),
    "RobotConfig": ("disco_hw.config", "RobotConfig"),
    "drive_virtual": ("disco_hw.experiments.simulated_time", "drive_virtual"),
    "find_gap": ("disco_hw.gap", "find_gap"),
    "infer": ("disco_hw.inference.infer", "infer"),
    "load_model": ("disco_hw.model", "load_model"),
    "load_robot": ("disco_hw.config", "load_robot_config"),
    "read_log": ("disco_hw.log.load", "load_drive"),
    "run_robot": ("disco_hw.daemon.run", "run_robot"),
    "save_model": ("disco_hw.model", "save_model"),
    "sigma_points": ("disco_hw.control.parameter_points", "sigma_points"),
    "simulate": ("disco_hw.model.step", "simulate"),
}

__all__ = [
    "BlackBoxDisco",
    "Disco",
    "Model",
    "Robot",
    "RobotConfig",
    "__version__",
    "drive_virtual",
    "find_gap",
    "infer",
    "load_model",
    "load_robot",
    "read_log",
    "run_robot",
    "save_model",
    "sigma_points",
    "simulate",
]


def __getattr__(name: str) -> Any:
    """Load a public name; raises AttributeError for any other."""
    from importlib import import_module, metadata  # noqa: PLC0415

    if name == "__version__":
        return metadata.version("disco-hw")
    if name not in _PUBLIC:
        raise AttributeError(f"module 'disco_hw' has no attribute {name!r}")
    module, attribute = _PUBLIC[name]
    return getattr(import_module(module), attribute)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
