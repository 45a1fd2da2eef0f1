"""What is refused in one line."""

from contextlib import contextmanager

import pytest

from disco_hw.errors import LogError


@contextmanager
def refused(match=None, error=LogError):
    """Expect an error whose message matches and is one line; gives what `pytest.raises` gives."""
    with pytest.raises(error, match=match) as raised:
        yield raised
    assert "\n" not in str(raised.value)
