"""The options `--robot ROBOT.toml`, `--allow-motion` and `--allow-restart` of pytest.

pyproject.toml loads them before any conftest.py.

Were they a conftest's, pytest would take the file for a test. One outside this project needs the form `--robot=FILE`,
because pytest looks for its settings beside every file that it is given.
"""

from typing import Any


def pytest_addoption(parser: Any) -> None:
    """Add the options for tests against a robot."""
    group = parser.getgroup("disco-hw")
    group.addoption("--robot", metavar="ROBOT.toml", help="test only that whatever answers on this link conforms")
    group.addoption("--allow-motion", action="store_true", help="with --robot: turn the wheels; lift them first")
    group.addoption(
        "--allow-restart",
        metavar="COMMAND",
        nargs="?",
        const="",
        help="with --robot: restart its controller with this command; without one, ask at the terminal for it",
    )
