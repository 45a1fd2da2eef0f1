"""Command `python -m sim`, which runs the virtual robot alone."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from firmware_protocol.firmware_core import FirmwareConfig
from sim.app import VirtualRobotOptions, run_virtual_robot
from sim.body_dynamics import BodyPose
from sim.effects import HiddenEffectError, effects_table, parse_hidden_effects
from sim.fault_player import COMMANDS
from sim.plant_parameters import PlantParameters


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the virtual robot until SIGTERM or SIGINT; return the exit code."""
    given = _parser().parse_args(arguments)
    try:
        options = _options(given)
    except (ValueError, HiddenEffectError) as error:
        print(error, file=sys.stderr)
        return 2
    return run_virtual_robot(options)


def _parser() -> argparse.ArgumentParser:
    defaults, plant = VirtualRobotOptions(), PlantParameters()
    parser = argparse.ArgumentParser(
        prog="python -m sim",
        description="A skid-steer robot with the reference firmware, behind a CAN bus or a serial line.",
        epilog=f"hidden effects:\n{effects_table()}\n\ncommands for --inject:\n{COMMANDS}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("--kind", choices=("can", "serial"), default=defaults.kind)
    add("--interface", default=defaults.interface, help="unixcan serves a bus, any other python-can bus is joined")
    add("--channel", default=defaults.channel, help="socket of the bus, or the interface's channel")
    add("--bitrate", type=int, default=defaults.bitrate, help="bit/s")
    add("--no-pacing", action="store_true", help="frames take no time on the wire")
    add("--port", help="symbolic link to make to the serial port")
    add("--baud", type=int, default=defaults.baud)
    add("--start", type=float, nargs=3, metavar=("X_M", "Y_M", "YAW_RAD"), default=(0.0, 0.0, 0.0))
    add("--seed", type=int, default=defaults.seed)
    add("--hide", action="append", default=[], metavar="EFFECT=VALUE", help="a hidden effect; may be repeated")
    for name, help_text in (
        ("wheel_radius_m", "wheel radius"),
        ("axial_distance_m", "distance between left and right wheels"),
        ("x_icr_m", "how far the tracked point is behind the line of the instantaneous centre of rotation"),
        ("pose_rate_hz", "rate of the pose sensor"),
        ("pose_delay_s", "latency of the pose sensor"),
        ("pose_position_std_m", "noise of its position"),
        ("pose_yaw_std_rad", "noise of its heading"),
    ):
        add(f"--{name.replace('_', '-')}", type=float, default=getattr(plant, name), help=help_text)
    add("--ticks-per-rev", type=int, default=plant.ticks_per_rev, help="encoder ticks per turn of the wheel")
    add("--max-wheel-speed-rad-s", type=float, default=8.0, help="limit in the firmware")
    add("--max-wheel-acceleration-rad-s2", type=float, default=20.0, help="limit in the firmware")
    add("--truth", type=Path, metavar="CSV", help="record what truly happens")
    add("--bus-log", type=Path, metavar="FILE", help="record every frame on the served bus, as candump -L does")
    add("--inject", type=Path, metavar="SOCKET", help="take commands, see below")
    add("--ready-fd", type=int, metavar="N", help="also write the ready line to this descriptor")
    add("--realtime-priority", type=int, default=defaults.realtime_priority, help="SCHED_FIFO, 0 for none")
    return parser


def _options(given: argparse.Namespace) -> VirtualRobotOptions:
    plant = PlantParameters(
        wheel_radius_m=given.wheel_radius_m,
        axial_distance_m=given.axial_distance_m,
        x_icr_m=given.x_icr_m,
        pose_rate_hz=given.pose_rate_hz,
        pose_delay_s=given.pose_delay_s,
        pose_position_std_m=given.pose_position_std_m,
        pose_yaw_std_rad=given.pose_yaw_std_rad,
        ticks_per_rev=given.ticks_per_rev,
    )
    return VirtualRobotOptions(
        kind=given.kind,
        interface=given.interface,
        channel=given.channel,
        bitrate=given.bitrate,
        pacing=not given.no_pacing,
        port=given.port,
        baud=given.baud,
        start=BodyPose(*given.start),
        plant=plant,
        effects=dict(parse_hidden_effects(given.hide).items),
        seed=given.seed,
        firmware=FirmwareConfig(
            ticks_per_rev=given.ticks_per_rev,
            max_wheel_speed_rad_s=given.max_wheel_speed_rad_s,
            max_wheel_acceleration_rad_s2=given.max_wheel_acceleration_rad_s2,
        ),
        truth_file=given.truth,
        bus_log=given.bus_log,
        inject=given.inject,
        ready_fd=given.ready_fd,
        realtime_priority=given.realtime_priority,
    )


if __name__ == "__main__":
    raise SystemExit(main())
