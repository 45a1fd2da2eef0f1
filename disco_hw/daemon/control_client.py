"""The other end of the daemon's control socket, for commands and scripts."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from disco_hw.daemon.socket_place import connect
from disco_hw.errors import WorkError

_MAX_REPLY_BYTES = 1 << 20


def send_request(path: Path, request: Mapping[str, Any], timeout_s: float = 2.0) -> dict[str, Any]:
    """Send one request, as `{"do": "arm"}`, to the daemon at `path` and return its reply.

    Raises WorkError in one line if no daemon listens there, it is none of a believed user's (`socket_place`), it does
    not answer within `timeout_s`, or it hangs up.
    """
    deadline_s = time.monotonic() + timeout_s
    try:
        with connect(path, timeout_s) as connection:
            connection.sendall(json.dumps(dict(request)).encode() + b"\n")
            line = bytearray()
            while not line.endswith(b"\n"):
                connection.settimeout(max(1e-3, deadline_s - time.monotonic()))
                data = connection.recv(65536)
                if not data or len(line) > _MAX_REPLY_BYTES:
                    raise WorkError(f"{path}: the daemon hung up without an answer; see its output")
                line += data
    except TimeoutError:
        raise WorkError(f"{path}: no answer from the daemon within {timeout_s:g} s; see its output") from None
    except (FileNotFoundError, ConnectionRefusedError):
        raise WorkError(f"{path}: no daemon listens there; start it with `disco-hw run`") from None
    except OSError as error:
        raise WorkError(f"{path}: {error.strerror or error}") from None
    try:
        reply = json.loads(line)
    except ValueError:
        reply = None
    if not isinstance(reply, dict):
        raise WorkError(f"{path}: what listens there is not a disco-hw daemon")
    return reply
