"""Web server of the viewer: viser behind a guard, so that only the operator reaches the page.

By itself viser listens to the whole network, takes another port when its own is in use, lets any web page open in the
operator's browser press its buttons, and opens a public tunnel for any client that asks for one.
"""

from __future__ import annotations

import errno
import functools
import gzip
import hmac
import http
import io
import logging
import secrets
import socket
from collections.abc import Awaitable, Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext, redirect_stdout
from dataclasses import dataclass
from http.cookies import CookieError, SimpleCookie
from importlib.resources import files
from typing import Any
from urllib.parse import parse_qs, urlsplit

import viser
import websockets.asyncio.server
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from disco_hw.errors import InputError
from disco_hw.viewer import DEFAULT_PORT, LOOPBACK, page_address, page_token
from disco_hw.viewer.admission import (
    ACCEPTED_PER_TURN,
    REQUEST_TIMEOUT_S,
    Admission,
    PacedListener,
    RateLimit,
    counted_connections,
)
from disco_hw.viewer.operator_controls import Desk

_LOOPBACK_NAMES = frozenset({"127.0.0.1", "localhost"})
_COOKIE = "disco-hw-token"
_DESK_PATH = "/desk"
_INSTANCE_PATH = "/instance"
# Chosen: a flood waits in the kernel's queue, and the operator's browser behind it, rather than be refused.
_WAITING_CONNECTIONS = 256
Respond = Callable[[Any, Request], Response | None]
Handler = Callable[[Any], Awaitable[None]]


@dataclass(slots=True)
class Guard:
    """Decides which requests reach the page.

    Every request must carry the `token`, in its query or in the cookie that the first one gets. `local`: the name asked
    for must moreover be a loopback one, which defeats a foreign name that resolves to it. A WebSocket must come from a
    page of this same server. `open` is False until the page is whole; its `port` distinguishes its cookie from another
    page's, as a browser keeps the cookies of a host together. `alone`: no other program can listen on this port under
    the other name of this machine, so that the desk may hand the token on to that name.
    """

    token: str
    local: bool = False
    open: bool = False
    port: int = 0
    alone: bool = False

    def refusal(self, path: str, headers: Headers, upgrade: bool) -> Response | None:
        """Return the answer to a request that must not go on, or None."""
        if not self.open:
            return _respond(http.HTTPStatus.SERVICE_UNAVAILABLE, "the page is being prepared; load it again")
        host = headers.get("Host", "")
        if self.local and urlsplit(f"//{host}").hostname not in _LOOPBACK_NAMES:
            return _respond(http.HTTPStatus.FORBIDDEN, "this page is for this machine only")
        if upgrade and headers.get("Origin") not in {f"http://{host}", f"https://{host}"}:
            return _respond(http.HTTPStatus.FORBIDDEN, "only this server's own page may connect")
        address = urlsplit(path)
        # Says nothing but which server this is, and is asked for under a name for which the browser has no cookie.
        if self._same(_cookie(headers, self._cookie_name)) or (address.path == _INSTANCE_PATH and not upgrade):
            return None
        if self._same(parse_qs(address.query).get("token", [""])[0]):
            if upgrade or address.path != "/":
                return None
            cookie = f"{self._cookie_name}={self.token}; HttpOnly; SameSite=Strict; Path=/"
            return _respond(http.HTTPStatus.SEE_OTHER, "welcome", {"Location": "/", "Set-Cookie": cookie})
        return _respond(
            http.HTTPStatus.FORBIDDEN, "open the address with its token, as printed where the page was started"
        )

    @property
    def _cookie_name(self) -> str:
        """Name of the cookie that holds the token, one per port."""
        return f"{_COOKIE}-{self.port}"

    def _same(self, offered: str) -> bool:
        return hmac.compare_digest(offered.encode(), self.token.encode())


@dataclass(frozen=True, slots=True)
class Page:
    """A running server and the address to open."""

    server: viser.ViserServer
    url: str


@contextmanager
def serving(label: str, host: str = LOOPBACK, port: int = DEFAULT_PORT, desk: Desk | None = None) -> Iterator[Page]:
    """Serve the page until the block ends; port 0 takes a free one. A `desk` (operator controls) frames the scene.

    The address carries the page's token. Raises InputError if the port is taken, the host is none of this machine's, or
    the token of the environment is none.
    """
    guard = Guard(page_token(), local=host == LOOPBACK)
    admission = Admission()
    listener = PacedListener(_listen(host, port), admission)
    with _guarded(guard, desk, listener, admission), redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host=host, port=port, label=label, verbose=False)
    # What waits to be accepted may be many, though the event loop takes few at a turn.
    listener.listen(_WAITING_CONNECTIONS)
    try:
        elsewhere = _bound_on_ipv6(server.get_port()) if guard.local else None
        # Looked up when a client asks for it, so this is enough to keep the tunnel shut.
        server.request_share_url = lambda verbose=True: None  # type: ignore[method-assign]
        actual_port = server.get_port()
        server.gui.configure_theme(show_share_button=False, show_logo=False, dark_mode=False)
        guard.port = actual_port
        guard.alone = elsewhere is not None
        guard.open = True
        with elsewhere or nullcontext():
            yield Page(server, page_address(host, actual_port, guard.token))
    finally:
        with redirect_stdout(io.StringIO()):
            server.stop()


@contextmanager
def _guarded(guard: Guard, desk: Desk | None, listener: socket.socket, admission: Admission) -> Iterator[None]:
    """Put the guard before every request of the server made inside the block, and the desk beside its page.

    The server accepts on `listener`, in place of a port of its own, and no more connections than the admission allows.
    """
    serve = websockets.asyncio.server.serve
    instance = secrets.token_hex(8)
    logger = logging.getLogger("websockets.server")
    limit = RateLimit()
    for repeating in (logger, logging.getLogger("asyncio")):
        repeating.addFilter(limit)

    def guarded_serve(handler: Handler, _host: str, _port: int, process_request: Respond, **options: Any) -> Any:
        @functools.wraps(process_request)
        def process(connection: Any, request: Request) -> Response | None:
            upgrade = request.headers.get("Upgrade", "").lower() == "websocket"
            response = guard.refusal(request.path, request.headers, upgrade)
            if response is None and urlsplit(request.path).path != _INSTANCE_PATH:
                admission.prove(connection.transport)
            if response is None and desk is not None and not upgrade:
                response = _desk_response(desk, instance, guard, request)
            if response is None:
                response = process_request(connection, request)
                if response is not None and not upgrade and urlsplit(request.path).path in {"/", "/index.html"}:
                    response.body = _completed(bytes(response.body), response.headers.get("Content-Encoding") == "gzip")
                    del response.headers["Content-Length"]
                    response.headers["Content-Length"] = str(len(response.body))
            if response is not None:
                response.headers["Referrer-Policy"] = "no-referrer"
                response.headers["Content-Security-Policy"] = f"frame-ancestors {_framers(request)}"
            return response

        async def handle(connection: Any) -> None:
            if desk is not None and urlsplit(connection.request.path).path == _DESK_PATH:
                await desk.serve(connection)
            else:
                await handler(connection)

        return serve(
            handle,
            process_request=process,
            # A factory serves as well as a class, says the documentation of websockets.
            create_connection=counted_connections(admission),  # type: ignore[arg-type]
            open_timeout=REQUEST_TIMEOUT_S,
            backlog=ACCEPTED_PER_TURN,
            sock=listener,
            **options,
        )

    websockets.asyncio.server.serve = guarded_serve  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve  # type: ignore[misc]


@functools.lru_cache(maxsize=2)
def _completed(page: bytes, zipped: bool) -> bytes:
    """Return viser's page with ours added to its head."""
    addition = files("disco_hw.viewer").joinpath("scene_page.html").read_bytes()
    plain = (gzip.decompress(page) if zipped else page).replace(b"</head>", addition + b"</head>", 1)
    return gzip.compress(plain) if zipped else plain


def _desk_response(desk: Desk, instance: str, guard: Guard, request: Request) -> Response | None:
    """Return the page of the operator controls, or the server's instance name; None for requests of the scene."""
    path = urlsplit(request.path).path
    if path == "/":
        return _respond(
            http.HTTPStatus.OK,
            "",
            {"Cache-Control": "no-store"},
            desk.page(instance, guard.token if guard.alone else ""),
        )
    if path == _INSTANCE_PATH:
        origin = request.headers.get("Origin", "")
        is_local = urlsplit(origin).hostname in _LOOPBACK_NAMES
        return _respond(http.HTTPStatus.OK, instance, {"Access-Control-Allow-Origin": origin} if is_local else {})
    return None


def _framers(request: Request) -> str:
    """Return the CSP `frame-ancestors`: this machine for the scene, which the desk frames; none for all other pages."""
    if urlsplit(request.path).path != "/index.html":
        return "'none'"
    port = urlsplit(f"//{request.headers.get('Host', '')}").port
    return "'self' " + " ".join(f"http://{name}:{port}" for name in sorted(_LOOPBACK_NAMES))


def _bound_on_ipv6(port: int) -> socket.socket | None:
    """Keep other users from listening at [::1], where a browser looks for "localhost" first; None if one does already.

    The scene is asked for under that name with the token in its address.
    """
    try:
        listener = socket.socket(socket.AF_INET6, socket.SOCK_STREAM)
    except OSError:
        # A machine without IPv6 has nobody there.
        return socket.socket()
    try:
        # Bound and not listening: the browser is refused there, and goes on to 127.0.0.1.
        listener.bind(("::1", port))
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            listener.close()
            return None
    return listener


def _listen(host: str, port: int) -> socket.socket:
    try:
        return socket.create_server((host, port), reuse_port=False)
    except OSError as error:
        raise InputError(f"--host {host} --port {port}: cannot listen there ({error.strerror}); give another") from None


def _cookie(headers: Headers, name: str) -> str:
    try:
        jar = SimpleCookie("; ".join(headers.get_all("Cookie")))
    except CookieError:
        return ""
    return jar[name].value if name in jar else ""


def _respond(
    status: http.HTTPStatus, text: str, extra: Mapping[str, str] | None = None, page: bytes | None = None
) -> Response:
    """Build a response with `extra` headers: the HTML `page` if given, otherwise `text` as plain text."""
    body = (text + "\n").encode() if page is None else page
    kind = "text/plain" if page is None else "text/html"
    headers = Headers(
        {
            "Content-Type": f"{kind}; charset=utf-8",
            "Content-Length": str(len(body)),
            "Connection": "close",
            **(extra or {}),
        }
    )
    return Response(status.value, status.phrase, headers, body)
