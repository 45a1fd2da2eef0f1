"""The guard in front of the page, with a real server and real requests."""

import http.client
import socket
import time
from contextlib import closing
from pathlib import Path
from urllib.parse import urlsplit

import msgspec
import pytest
import viser
import websockets.asyncio.server
from websockets.datastructures import Headers
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from disco_hw.errors import InputError
from disco_hw.viewer.operator_controls import Desk
from disco_hw.viewer.server import Guard, serving

SUBPROTOCOL = f"viser-v{viser.__version__}"


@pytest.fixture(scope="module")
def page():
    with serving("test", port=0) as served:
        yield served


def cookie_of(page):
    """Return the cookie that a browser sends once it has opened the printed address."""
    return {"Cookie": f"disco-hw-token-{port_of(page)}={token_of(page)}"}


def get(port, path="/", host=None, **headers):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
    connection.request("GET", path, headers={"Host": host or f"127.0.0.1:{port}", **headers})
    response = connection.getresponse()
    body = response.read()
    connection.close()
    return response, body


def upgrade(port, origin, headers=None, path="/"):
    address = f"ws://127.0.0.1:{port}{path}"
    return connect(address, origin=origin, subprotocols=[SUBPROTOCOL], additional_headers=headers, open_timeout=60)


def assert_no_upgrade(port, origin, headers=None, path="/"):
    with pytest.raises(InvalidStatus) as refused, upgrade(port, origin, headers, path):
        pass
    assert refused.value.response.status_code == 403


def token_of(page):
    return urlsplit(page.url).query.removeprefix("token=")


def port_of(page):
    return urlsplit(page.url).port


def test_the_own_page_is_served_and_may_connect(page):
    port = port_of(page)
    response, body = get(port, **cookie_of(page))
    assert response.status == 200
    assert b"<html" in body
    for name in ("127.0.0.1", "localhost"):
        assert get(port, host=f"{name}:{port}", **cookie_of(page))[0].status == 200
    with upgrade(port, f"http://127.0.0.1:{port}", cookie_of(page)) as client:
        assert client.recv(timeout=60)


@pytest.mark.parametrize("path", ["/", "/index.html", "/desk", "/?token=", "/?token=wrong", "/instance/../"])
def test_another_user_of_this_machine_gets_nothing_without_the_token(page, path):
    # Who he is cannot be seen on a loopback address; he has no token.
    port = port_of(page)
    response, body = get(port, path)
    assert response.status == 403
    assert b"open the address with its token" in body
    for headers in ({}, {"Cookie": f"disco-hw-token-{port}=wrong"}):
        assert_no_upgrade(port, f"http://127.0.0.1:{port}", headers, path)


def test_the_printed_address_lets_in_and_the_cookie_keeps(page):
    port, query = port_of(page), urlsplit(page.url).query
    assert len(query.removeprefix("token=")) >= 16
    welcome, _ = get(port, f"/?{query}")
    assert (welcome.status, welcome.getheader("Location")) == (303, "/")
    assert welcome.getheader("Referrer-Policy") == "no-referrer"
    assert welcome.getheader("Set-Cookie").startswith(cookie_of(page)["Cookie"])
    assert get(port, **cookie_of(page))[0].status == 200


def test_the_scene_gets_in_by_its_address_as_its_name_has_no_cookie(page):
    port, query = port_of(page), urlsplit(page.url).query
    assert get(port, f"/index.html?{query}", host=f"localhost:{port}")[0].status == 200
    with upgrade(port, f"http://127.0.0.1:{port}", path=f"/?{query}") as client:
        assert client.recv(timeout=60)


def test_nobody_else_can_listen_where_a_browser_looks_for_localhost_first(page):
    with socket.socket(socket.AF_INET6) as stranger:
        stranger.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        with pytest.raises(OSError, match="in use"):
            stranger.bind(("::1", port_of(page)))


def test_where_somebody_listens_there_already_the_token_is_not_handed_on(tmp_path):
    desk = Desk(tmp_path / "none.sock", tmp_path / "none.toml")
    with closing(desk), socket.socket(socket.AF_INET6) as stranger:
        stranger.bind(("::1", 0))
        stranger.listen(1)
        port = stranger.getsockname()[1]
        with serving("test", port=port, desk=desk) as served:
            assert token_of(served).encode() not in get(port, **cookie_of(served))[1]
    with (
        closing(Desk(tmp_path / "none.sock", tmp_path / "none.toml")) as other,
        serving("t", port=0, desk=other) as alone,
    ):
        assert token_of(alone).encode() in get(port_of(alone), **cookie_of(alone))[1]


def test_the_token_of_the_environment_is_taken_and_a_short_one_refused(monkeypatch):
    monkeypatch.setenv("DISCO_HW_PAGE_TOKEN", "of-my-own-and-long_enough")
    with serving("test", port=0) as served:
        assert served.url.endswith("?token=of-my-own-and-long_enough")
    for bad in ("short", "with a blank in the middle", "ö" * 20):
        monkeypatch.setenv("DISCO_HW_PAGE_TOKEN", bad)
        with pytest.raises(InputError, match="DISCO_HW_PAGE_TOKEN"), serving("test", port=0):
            pass


@pytest.mark.parametrize("origin", ["http://evil.example", "http://127.0.0.1:1", "null", None])
def test_a_foreign_page_may_not_connect(page, origin):
    assert_no_upgrade(port_of(page), origin, cookie_of(page))


def test_a_foreign_name_for_this_machine_is_refused(page):
    response, body = get(port_of(page), host="evil.example", **cookie_of(page))
    assert response.status == 403
    assert b"this machine only" in body


def test_it_listens_on_the_loopback_alone(page):
    port = port_of(page)
    listening = [line.split() for line in Path("/proc/net/tcp").read_text(encoding="ascii").splitlines()[1:]]
    addresses = {row[1].split(":")[0] for row in listening if row[3] == "0A" and int(row[1].split(":")[1], 16) == port}
    assert addresses == {"0100007F"}


def test_a_client_that_asks_for_a_public_tunnel_gets_none(page, monkeypatch):
    dug = []
    monkeypatch.setattr(viser._viser, "ViserTunnel", lambda *arguments, **named: dug.append(arguments))
    port = port_of(page)
    with upgrade(port, f"http://127.0.0.1:{port}", cookie_of(page)) as client:
        client.recv(timeout=60)
        client.send(msgspec.msgpack.encode({"type": "ShareUrlRequest"}))
        # Whatever it makes of the request happens in a thread of its own.
        time.sleep(0.5)
    assert dug == []
    assert page.server._share_tunnel is None


def test_a_taken_port_is_an_error_and_not_the_next_one():
    with socket.create_server(("127.0.0.1", 0)) as occupied:
        port = occupied.getsockname()[1]
        with pytest.raises(InputError, match=f"--port {port}"), serving("test", port=port):
            pass


def test_a_host_of_another_machine_is_an_error():
    with pytest.raises(InputError, match=r"192\.0\.2\.1"), serving("test", host="192.0.2.1", port=0):
        pass


def test_the_library_is_left_as_it_was(page):
    assert websockets.asyncio.server.serve.__module__.startswith("websockets")


def test_another_address_needs_its_token():
    with serving("test", host="0.0.0.0", port=0) as served:
        port, token = port_of(served), token_of(served)
        assert len(token) >= 16
        assert get(port)[0].status == 403
        assert get(port, "/?token=wrong")[0].status == 403
        assert get(port, host=f"robot.local:{port}", path="/?token=" + token[:-1])[0].status == 403
        welcome, _ = get(port, f"/?token={token}")
        assert welcome.status == 303
        cookie = welcome.getheader("Set-Cookie")
        assert "HttpOnly" in cookie
        assert "SameSite=Strict" in cookie
        pair = cookie.split(";")[0]
        assert get(port, Cookie=pair)[0].status == 200
        page_origin = f"http://127.0.0.1:{port}"
        assert_no_upgrade(port, page_origin)
        assert_no_upgrade(port, "http://evil.example", {"Cookie": pair})
        with upgrade(port, page_origin, headers={"Cookie": pair}) as client:
            assert client.recv(timeout=60)


def test_two_pages_of_one_host_do_not_take_each_others_token():
    # A browser keeps the cookies of a host together, whatever the port: the desk of one robot must not lose its line,
    # and with that its e-stop, when that of another is opened.
    with serving("one", host="0.0.0.0", port=0) as one, serving("two", host="0.0.0.0", port=0) as two:
        jar = {}
        for page in (one, two):
            welcome, _ = get(port_of(page), f"/?{urlsplit(page.url).query}")
            name, _, value = welcome.getheader("Set-Cookie").split(";")[0].partition("=")
            jar[name] = value
        cookies = "; ".join(f"{name}={value}" for name, value in jar.items())
        assert [get(port_of(page), Cookie=cookies)[0].status for page in (one, two)] == [200, 200]


def test_a_page_in_the_making_answers_nobody():
    guard = Guard("secret")
    headers = Headers(
        {"Host": "127.0.0.1:8080", "Origin": "http://127.0.0.1:8080", "Cookie": "disco-hw-token-0=secret"}
    )
    assert guard.refusal("/", headers, upgrade=True).status_code == 503
    guard.open = True
    assert guard.refusal("/", headers, upgrade=True) is None


@pytest.mark.parametrize("cookie", ["disco-hw-token-0=", "disco-hw-token-0", "=;;=", '"', "disco-hw-token-0=ö"])
def test_odd_cookies_are_no_token(cookie):
    guard = Guard(token="secret", open=True)
    assert guard.refusal("/", Headers({"Host": "a", "Cookie": cookie}), upgrade=False).status_code == 403
    right = Headers({"Host": "a", "Cookie": "disco-hw-token-0=secret"})
    assert guard.refusal("/", right, upgrade=False) is None
