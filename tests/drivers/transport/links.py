"""Links that tests open over any medium, with short pauses between two attempts, and close again."""

from contextlib import closing, contextmanager

from drivers.transport.reconnecting import BackoffPolicy, ReconnectingTransport
from drivers.types import LinkState
from tests.drivers.waiting import wait_until

FAST = BackoffPolicy(first_s=0.01, longest_s=0.05, steady_s=0.1)


@contextmanager
def opened(medium, backoff=FAST, **options):
    with closing(ReconnectingTransport(medium, backoff=backoff, **options)) as transport:
        transport.open()
        yield transport


def up(transport, generation=1):
    """Wait until the link is up, for this time at least."""
    wait_until(lambda: transport.state is LinkState.UP and transport.generation >= generation)
