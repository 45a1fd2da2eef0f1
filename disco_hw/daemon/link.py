"""The link to the robot, from robot.toml."""

from __future__ import annotations

from disco_hw.errors import InputError
from disco_hw.runtime.robot_setup import Setup
from drivers.transport import ReconnectingTransport, TransportSettingsError, make_transport


def make_link(setup: Setup) -> ReconnectingTransport:
    """Return the link that robot.toml names, not yet opened. Raises InputError for what no device could satisfy."""
    try:
        return make_transport(**setup.config.link.medium_fields())
    except TransportSettingsError as error:
        raise InputError(f"{setup.robot_file}: {error}") from None
