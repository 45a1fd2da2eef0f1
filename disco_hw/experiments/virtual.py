"""Virtual robot of `disco-hw sim`, with true parameters from the model of robot.toml and from what the user hides."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

from disco_hw.errors import InputError
from disco_hw.files import FAULTS_TOML, read_toml
from disco_hw.runtime.robot_setup import Setup, geometry, link_key, load_setup
from drivers.motor import DEFAULT, find_driver
from drivers.pose.udp import SOURCE as UDP_POSES
from firmware_protocol.firmware_core import FirmwareConfig
from sim.app import VirtualRobotOptions, run_virtual_robot
from sim.body_dynamics import BodyPose
from sim.devices import find_controller
from sim.effects import HiddenEffectError, parse_hidden_effects
from sim.fault_schedule import FaultFileError, schedule_of
from sim.plant_parameters import DrawError, PlantParameters, draw_plant_parameters

# A board that slews no faster than the host makes a ramp of every step of a command, which is half a period of delay.
_FIRMWARE_MARGIN = 10.0
_MOST_ACCELERATION_RAD_S2 = 655.0


def run_sim(
    robot: Path,
    *,
    model: Path | None = None,
    link: str | None = None,
    hide: tuple[str, ...] = (),
    plant_seed: int | None = None,
    start: tuple[float, float, float] | None = None,
    truth: Path | None = None,
    inject: Path | None = None,
    bus_log: Path | None = None,
    faults: Path | None = None,
    seed: int = 1,
    board: str | None = None,
) -> int:
    """Run the virtual robot until SIGTERM or SIGINT; returns the exit code. Raises InputError for wrong options.

    The arguments are the options of `disco-hw sim`; `start` is x, y (m) and yaw (rad), the task's start if None.
    """
    setup = load_setup(robot, model, link)
    config = setup.config
    try:
        effects = dict(parse_hidden_effects(hide).items)
    except HiddenEffectError as error:
        raise InputError(f"--hide: {error}") from None
    try:
        schedule = None if faults is None else schedule_of(read_toml(faults, FAULTS_TOML), str(faults))
    except FaultFileError as error:
        raise InputError(str(error)) from None
    if start is not None and not all(map(math.isfinite, start)):
        raise InputError(f"--start: {' '.join(map(str, start))} is not a pose; write finite numbers")
    ticks_per_rev = _tick_count(setup)
    driver = find_driver(config.link.driver)
    create_controller = None if driver.name == DEFAULT else find_controller(driver.name)
    if not driver.name == DEFAULT and create_controller is None:
        raise InputError(f"{setup.robot_file}: link.driver: there is no simulator of {driver.name}")
    if board is not None and not driver.name == DEFAULT:
        raise InputError(
            f"--board: {setup.robot_file} has link.driver {driver.name}; a board needs the driver reference"
        )
    if board is not None and bus_log is not None:
        raise InputError("--bus-log: cannot be used with --board, which has its own link; leave one of them out")
    controller = (
        None if create_controller is None else partial(create_controller, config.link.settings(), ticks_per_rev)
    )
    x_m, y_m, yaw_rad = start or config.task_start
    # The robot that a model without effects describes; what its motors should lack is hidden by the user.
    plant, key = true_parameters(setup, plant_seed).with_ideal_motors(), link_key(setup)
    print(
        f"true wheel radius {plant.wheel_radius_m:.4f} m, axial distance {plant.axial_distance_m:.4f} m, "
        f"x_icr {plant.x_icr_m:.4f} m" + "".join(f", hidden {name} {values}" for name, values in effects.items()),
        file=sys.stderr,
        flush=True,
    )
    return run_virtual_robot(
        VirtualRobotOptions(
            kind=config.link.kind,
            interface=config.link.interface,
            channel=config.link.channel,
            bitrate=config.link.bitrate,
            port=config.link.port,
            baud=config.link.baud,
            board=board,
            start=BodyPose(x_m, y_m, yaw_rad),
            plant=plant,
            effects=effects,
            seed=seed,
            firmware=FirmwareConfig(
                ticks_per_rev=ticks_per_rev,
                max_wheel_speed_rad_s=config.robot.max_wheel_speed_rad_s,
                max_wheel_acceleration_rad_s2=min(
                    _FIRMWARE_MARGIN * config.robot.max_wheel_acceleration_rad_s2, _MOST_ACCELERATION_RAD_S2
                ),
                key=key or b"",
            ),
            controller=controller,
            pose_address=None
            if (by_datagram := config.pose.of(UDP_POSES)) is None
            else (by_datagram.address, by_datagram.port),
            truth_file=truth,
            bus_log=bus_log,
            inject=inject,
            faults=schedule,
        )
    )


def true_parameters(setup: Setup, plant_seed: int | None) -> PlantParameters:
    """Return the plant at the model's mean, or drawn from the model's belief with this seed."""
    mean, covariance = geometry(setup.model)
    radius, axial, x_icr = mean
    base = PlantParameters(ticks_per_rev=_tick_count(setup))
    if plant_seed is None:
        return replace(base, wheel_radius_m=radius, axial_distance_m=axial, x_icr_m=x_icr)
    order = (2, 0, 1)
    try:
        return draw_plant_parameters(
            [mean[i] for i in order], [[covariance[i][j] for j in order] for i in order], plant_seed, base
        )
    except DrawError as error:
        raise InputError(f"{setup.model_file or setup.robot_file}: {error}") from None


def _tick_count(setup: Setup) -> int:
    """Ticks of the virtual robot's encoder, which counts whole ones as its firmware's LIMITS message does."""
    ticks = setup.config.robot.ticks_per_rev
    if ticks != round(ticks):
        raise InputError(
            f"{setup.robot_file}: robot.ticks_per_rev: {ticks} is not a whole number; the virtual robot needs one"
        )
    return round(ticks)
