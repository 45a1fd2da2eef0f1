"""The files of one robot, read and checked together: robot.toml, the model and the path that it names."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import msgspec

from disco_hw.config import CircleTask, PathTask, Point, Robot, RobotConfig, TimedPathTask, load_robot_config
from disco_hw.config.input_file import KEY, read_bytes
from disco_hw.config.link_option import link_fields
from disco_hw.errors import InputError
from disco_hw.model import Model, load_model
from disco_hw.waypoints import Waypoints, way_points_to_follow, way_points_to_meet
from drivers.key_file import KeyFileError, key_of_file

Matrix3 = tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]


@dataclass(frozen=True, slots=True)
class Setup:
    """The files of one robot, read and checked; `model_file`, `path_file` are None where robot.toml names none."""

    robot_file: Path
    model_file: Path | None
    path_file: Path | None
    config: RobotConfig
    model: Model


def load_setup(robot: Path, model: Path | None = None, link: str | None = None, path_file: Path | None = None) -> Setup:
    """Read robot.toml, the model and the task's path; the other arguments override what robot.toml says.

    A `path_file` that is given was driven before, and is not judged for hairpins. Raises InputError.
    """
    config = load_robot_config(robot)
    if isinstance(config.task, CircleTask):
        path_file = None
    else:
        task = config.task
        task = _with_way_points(task, path_file or robot.parent / task.path, config.robot, path_file is None)
        path_file = path_file or robot.parent / task.path
        config = msgspec.structs.replace(config, task=task)
    if link is not None:
        config = msgspec.structs.replace(config, link=msgspec.structs.replace(config.link, **link_fields(link)))
    model_file = model
    if model_file is None and config.model.file is not None:
        model_file = robot.parent / config.model.file
    loaded = Model.nominal(config.robot, config.prior) if model_file is None else load_model(model_file)
    return Setup(robot, model_file, path_file, config, loaded)


def _with_way_points(
    task: PathTask | TimedPathTask, path_file: Path, robot: Robot, judged: bool
) -> PathTask | TimedPathTask:
    """The task with the way-points of a CSV; raises InputError naming file, line and remedy."""
    if isinstance(task, PathTask):
        followed = way_points_to_follow(path_file)
        if judged:
            # Loaded for paths alone: it brings the planner with it.
            from disco_hw.hairpins import refuse_hairpins  # noqa: PLC0415

            refuse_hairpins(path_file, followed)
        return msgspec.structs.replace(task, points=_points(followed))
    found = way_points_to_meet(path_file, robot.max_wheel_speed_rad_s * robot.wheel_radius_m)
    assert found.times_s is not None, "they are refused without"
    return msgspec.structs.replace(task, points=_points(found), times_s=tuple(found.times_s.tolist()))


def _points(waypoints: Waypoints) -> tuple[Point, ...]:
    return tuple((float(x), float(y)) for x, y in waypoints.places_m.tolist())


def refuse_missing_effects(setup: Setup) -> None:
    """Raise InputError if the model is marked as one whose parameters may have absorbed an effect it lacks."""
    if setup.model.missing_effects:
        raise InputError(
            f"{setup.model_file}: missing_effects: the model lacks {', '.join(setup.model.missing_effects)}, which its "
            "parameters may have absorbed; write it with `disco-hw gap`, or give --accept-missing-effects"
        )


def link_key(setup: Setup) -> bytes | None:
    """The key of authenticated mode from the file that robot.toml names, None if it names none. Raises InputError."""
    name = setup.config.link.key_file
    if name is None:
        return None
    path = setup.robot_file.parent / name
    try:
        return key_of_file(path, *read_bytes(path, KEY))
    except (KeyFileError, InputError) as error:
        raise InputError(f"{setup.robot_file}: link.key_file: {error}") from None


def geometry(model: Model) -> tuple[tuple[float, float, float], Matrix3]:
    """Mean (m) and covariance (m^2) of (wheel_radius_m, axial_distance_m, x_icr_m); zero where a value is exact."""
    names = ("wheel_radius_m", "axial_distance_m", "x_icr_m")
    mean = dict(zip(model.parameter_names, model.point().tolist(), strict=True))
    covariance = {(a, b): 0.0 for a in names for b in names}
    belief = model.belief
    if belief is not None:
        mean |= dict(zip(belief.names, belief.mean().tolist(), strict=True))
        for row, values in zip(belief.names, belief.covariance().tolist(), strict=True):
            covariance |= {(row, column): value for column, value in zip(belief.names, values, strict=True)}
    r, a, x = names
    return (mean[r], mean[a], mean[x]), (
        (covariance[r, r], covariance[r, a], covariance[r, x]),
        (covariance[a, r], covariance[a, a], covariance[a, x]),
        (covariance[x, r], covariance[x, a], covariance[x, x]),
    )
