from contextlib import closing

import pytest

from tests.drivers.transport.pseudo_terminal import PseudoTerminal


@pytest.fixture
def terminal():
    with closing(PseudoTerminal()) as made:
        yield made
