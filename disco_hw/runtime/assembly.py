"""Puts the daemon's parts together from robot.toml and the model; the tests and the harness assemble the same way."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import msgspec

from disco_hw import control
from disco_hw.adaptation import GeometryAdaptation, NoAdaptation
from disco_hw.adaptation.fast import FastAdaptation
from disco_hw.adaptation.guard import (
    REQUESTED_BY_FILE,
    Geometry,
    believed_geometry,
    check_adaptable,
    possible_range,
    with_geometry,
)
from disco_hw.config import PoseInput, RobotConfig
from disco_hw.control.baselines import LAWS, WithFallback
from disco_hw.control.parameter_points import mean_point
from disco_hw.control.past_motion import DriveMeans
from disco_hw.control.plan import Law, LawController
from disco_hw.control.surroundings import Surroundings
from disco_hw.errors import InputError, WorkError
from disco_hw.estimation import PoseFusion
from disco_hw.estimation.filter import TAKE_OVER_TIMEOUTS
from disco_hw.estimation.heading_watch import HeadingWatch
from disco_hw.estimation.odometry import OdometryParameters
from disco_hw.fence import Fence
from disco_hw.fence.clearance import Boundaries
from disco_hw.files import KEY, read_bytes
from disco_hw.log.recorder import Recorder
from disco_hw.model import Model
from disco_hw.model.model import BASE_PARAMETERS
from disco_hw.runtime.core import DaemonCore
from disco_hw.runtime.fence_guard import FenceGuard, StoppingSettings
from disco_hw.runtime.obstacles import obstacle_source_of
from disco_hw.runtime.pipeline import Governor, Pipeline, Planner, WheelLimits
from disco_hw.runtime.preflight import Level, check_firmware_limits, check_task
from disco_hw.runtime.robot_setup import Setup, config_for_tasks, geometry
from disco_hw.runtime.supervisor import Supervisor, SupervisorSettings
from drivers.motor import create_driver, find_driver, rewired
from drivers.pose import PoseSourceError, SeveralPoses, converted, create_pose_source
from drivers.private_files import KeyFileError, key_of_file
from drivers.transport import ReconnectingTransport, TransportSettingsError, create_transport
from drivers.types import Driver, PoseSource, Transport

# Chosen: one loads the code; more cost start-up time alone.
_REHEARSALS = 5
# Chosen: a model without a delay would promise the fence guard an instant response; larger stops the robot earlier.
_LEAST_RESPONSE_S = 0.05


def create_planner(config: RobotConfig, model: Model) -> control.Disco:
    """DISCO for this robot's task, compiled and warmed up: takes seconds."""
    task = config.task.planned(config.control.mode)
    _, _, x_icr_m = mean_point(model)[0, : len(BASE_PARAMETERS)].tolist()
    settings = control.DiscoSettings.from_config(config.control, config.task.speed_m_s, x_icr_m)
    planner = control.Disco(
        model,
        task,
        settings,
        control.CommandLimits.of_robot(config.robot),
        config.control.seed,
        create_surroundings(config, settings),
    )
    planner.warm_up()
    return planner


def planner_of(setup: Setup, law: Law | None) -> Planner:
    """Return the planner of this robot's task: DISCO, or a control law of the user's in its place."""
    if law is None:
        return create_planner(setup.config, setup.model)
    return LawController(law, setup.model, setup.config.task.planned(setup.config.control.mode))


def create_surroundings(config: RobotConfig, settings: control.DiscoSettings) -> Surroundings | None:
    """Create the surroundings that DISCO avoids; None without [fence], where the guard alone minds obstacles."""
    if config.fence == Fence():
        return None
    around = Surroundings(
        config.robot.footprint,
        settings.step_s,
        settings.sampler.horizon,
        config.task.speed_m_s,
        config.turned_rad,
    )
    around.set_line(config.task.course().outline_m())
    around.look_around(Boundaries(config.robot.footprint, config.fence), 0.0)
    return around


def create_pipeline(config: RobotConfig, model: Model, planner: Planner) -> Pipeline:
    """Estimator, planner and governor with the limits of robot.toml; the planner with the fallback that it names."""
    if isinstance(planner, control.Disco) and config.control.fallback != "ramp":
        largest = control.CommandLimits.of_robot(config.robot)
        planner = WithFallback(planner, LAWS[config.control.fallback], planner.task, largest)
    limits = WheelLimits(
        max_speed_rad_s=config.robot.max_wheel_speed_rad_s,
        max_acceleration_rad_s2=config.robot.max_wheel_acceleration_rad_s2,
        max_deceleration_rad_s2=config.robot.max_wheel_acceleration_rad_s2,
        max_difference_rad_s=config.largest_wheel_difference_rad_s,
    )
    return Pipeline(
        fusion=PoseFusion(
            config.estimation, odometry_parameters(model), config.control.telemetry_zero_s, config.pose.labels()
        ),
        planner=planner,
        governor=Governor(limits, 1.0 / config.control.rate_hz),
        plan_tail_s=config.control.plan_tail_s,
        means=DriveMeans.of(model),
        headings=HeadingWatch(config.pose.labels(), [one.offset for one in config.pose.every()]),
        guard=create_guard(config, model),
    )


def create_guard(config: RobotConfig, model: Model) -> FenceGuard:
    """Return the guard of robot.toml's fence; it does nothing until there is a fence or an obstacle.

    The wheels respond as late as the model says, and 50 ms at least.
    """
    card = find_driver(config.link.driver).safety_card(config.link.settings())
    names, mean = model.parameter_names, model.point()
    delay_columns = [
        f"{one.name}.{one.effect.delayed_by}" for one in model.effects if one.effect.delayed_by is not None
    ]
    response_s = max(_LEAST_RESPONSE_S, sum(float(mean[names.index(name)]) for name in delay_columns if name in names))
    settings = StoppingSettings(
        response_s, card.reaction_s, config.robot.max_wheel_acceleration_rad_s2, 1.0 / config.control.rate_hz
    )
    return FenceGuard(Boundaries(config.robot.footprint, config.fence), settings, config.fence.margin_m)


def create_fast_adaptation(setup: Setup, pipeline: Pipeline) -> FastAdaptation:
    """Return the filter that learns the geometry.

    `pipeline` has taken no step yet. Raises InputError where the model does not allow it.
    """
    check_adaptable(setup.model, setup.config.control.uncertainty, REQUESTED_BY_FILE)
    return FastAdaptation(
        _rehearsed(setup, pipeline),
        *possible_range(setup.config.prior),
        lambda geometry: apply_geometry(pipeline, setup.model, geometry),
    )


def _rehearsed(setup: Setup, pipeline: Pipeline) -> Geometry:
    """Return the model's geometry, after it was put in force and taken back some times.

    What runs for the first time loads code: three times as long as later, in a tick that then must not be late.
    """
    believed = believed_geometry(setup.model)
    for _ in range(_REHEARSALS):
        apply_geometry(pipeline, setup.model, believed)
        apply_geometry(pipeline, setup.model, None)
    return believed


def apply_geometry(pipeline: Pipeline, model: Model, geometry: Geometry | None) -> None:
    """Plan and estimate with this geometry, or with the model file's for None; raises ValueError if that cannot be."""
    adapted = model if geometry is None else with_geometry(model, geometry)
    if adapted.belief is None:
        raise ValueError("the model has no belief")
    beside = () if geometry is None else (geometry.drift_m_s, geometry.lateral_lag_s)
    pipeline.set_belief(adapted.belief, odometry_parameters(adapted), *beside)


def odometry_parameters(model: Model) -> OdometryParameters:
    """Mean and covariance of the geometry, as the estimator wants them."""
    (wheel_radius_m, axial_distance_m, x_icr_m), covariance = geometry(model)
    return OdometryParameters(wheel_radius_m, axial_distance_m, x_icr_m, covariance)


def assemble_core(
    config: RobotConfig,
    transport: Transport,
    driver: Driver,
    pipeline: Pipeline,
    recorder: Recorder,
    needs_pose: bool = True,
    adaptation: GeometryAdaptation | None = None,
) -> DaemonCore:
    """Return the daemon's tick over these parts.

    Without `needs_pose` motion needs no pose, whatever robot.toml says.
    """
    supervisor = Supervisor(
        SupervisorSettings(
            telemetry_zero_s=config.control.telemetry_zero_s,
            telemetry_disarm_s=config.control.telemetry_disarm_s,
            pose_required=needs_pose and config.estimation.pose_required,
            heading_required=needs_pose,
        )
    )
    # Who drives by hand, and so without a pose, does not do the task.
    check = partial(preflight, config_for_tasks(config, pipeline.fusion.parameters.x_icr_m), with_task=needs_pose)
    sources = pose_source_of(config), obstacle_source_of(config)
    adapting = adaptation or NoAdaptation()
    return DaemonCore(config, transport, driver, supervisor, pipeline, recorder, check, adapting, *sources)


def pose_source_of(config: RobotConfig) -> PoseSource:
    """Return the pose source that robot.toml names, or those.

    Raises InputError for one that cannot be had, WorkError where the system refuses its port, address or device now.
    """
    opened: list[PoseSource] = []
    # By then the task has stopped for want of poses: another sender never takes over while it runs.
    silence_s = TAKE_OVER_TIMEOUTS * config.estimation.pose_timeout_s
    for label, named in zip(config.pose.labels(), config.pose.every(), strict=True):
        try:
            source = create_pose_source(
                **msgspec.structs.asdict(named.in_source_units()), key=_pose_key(named), sender_silence_s=silence_s
            )
        except (InputError, KeyFileError, PoseSourceError) as error:
            for one in opened:
                one.close()
            which = "" if named is config.pose else f" {label}"
            text = f"robot.toml: pose.source{which}: {error}"
            # What the system refuses while the network comes up it may grant at the next start.
            is_refused_now = isinstance(error, PoseSourceError) and isinstance(error.__context__, OSError)
            raise (WorkError if is_refused_now else InputError)(text) from None
        opened.append(converted(source, named.convention()))
    return opened[0] if len(opened) == 1 else SeveralPoses(opened, config.pose.labels())


def _pose_key(named: PoseInput) -> bytes | None:
    """Return the key that each datagram must be proven with; None where none is named."""
    if named.key_file is None:
        return None
    path = Path(named.key_file)
    return key_of_file(path, *read_bytes(path, KEY))


def driver_of(config: RobotConfig, key: bytes | None = None) -> Driver:
    """Return the driver that robot.toml names, for wheels that are wired as it says."""
    return rewired(create_driver(config.link.driver, config.link.settings(), key), config.wheels)


def preflight(config: RobotConfig, driver: Driver, with_task: bool = True) -> tuple[str, ...]:
    """Return, in words, what robot.toml requests beyond the limits of firmware or wheels; empty if they agree."""
    if driver.limits is None:
        return ()
    checks = check_firmware_limits(config.robot, driver.limits)
    if with_task:
        checks.append(check_task(config))
    return tuple(check.text for check in checks if check.level is Level.FAIL)


def create_link(setup: Setup) -> ReconnectingTransport:
    """Return the link that robot.toml names, not yet opened. Raises InputError for what no device could satisfy."""
    try:
        return create_transport(**setup.config.link.medium_fields())
    except TransportSettingsError as error:
        raise InputError(f"{setup.robot_file}: {error}") from None
