"""Where the page is unless its owner says otherwise: on this host alone."""

LOOPBACK = "127.0.0.1"
DEFAULT_PORT = 8080
