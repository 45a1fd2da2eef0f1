import socket

import pytest

from tests.drivers.waiting import free_port


@pytest.fixture
def port():
    return free_port(socket.SOCK_DGRAM)
