import socket
from contextlib import ExitStack, closing

import pytest

from drivers.pose import create_pose_source
from tests.drivers.waiting import free_port


@pytest.fixture
def port():
    return free_port(socket.SOCK_DGRAM)


@pytest.fixture
def create_source():
    """Create a pose source, which is closed at the end of the test."""
    with ExitStack() as sources:
        yield lambda name, **fields: sources.enter_context(closing(create_pose_source(name, **fields)))
