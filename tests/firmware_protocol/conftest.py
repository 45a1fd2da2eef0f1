import pytest

from tests.firmware_protocol.bench import Bench


@pytest.fixture
def bench():
    """A controller that has just started."""
    return Bench()
