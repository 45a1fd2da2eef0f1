"""Where the page is unless its owner says otherwise, and the token without which it shows and does nothing."""

import os

LOOPBACK = "127.0.0.1"
DEFAULT_PORT = 8080
TOKEN_VARIABLE = "DISCO_HW_PAGE_TOKEN"
_SHORTEST = 16


def page_token() -> str:
    """The token of the page about to start: what $DISCO_HW_PAGE_TOKEN says, else one that nobody can guess.

    In a variable, and not in an argument, as other users can read the arguments of a process. Raises ValueError for
    one of less than 16 characters or with others than letters, digits, - and _.
    """
    given = os.environ.get(TOKEN_VARIABLE)
    if not given:
        import secrets  # noqa: PLC0415 - slow to import for whoever only asks for the port

        return secrets.token_urlsafe(16)
    if len(given) < _SHORTEST or not given.replace("-", "").replace("_", "").isalnum() or not given.isascii():
        raise ValueError(f"{TOKEN_VARIABLE}: give {_SHORTEST} or more letters, digits, - and _, or unset it")
    return given


def page_address(host: str, port: int, token: str) -> str:
    """What to open in a browser."""
    return f"http://{host}:{port}/?token={token}"
