"""The operator's desk around the live page: e-stop, buttons, the task, the pad for driving by hand.

A page of its own with a connection of its own, and the drawn scene in a frame: what is busy drawing, here or in the
browser, does not stand in the way of the e-stop. Every word goes to the daemon's control socket, which decides.
"""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Awaitable, Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from importlib.resources import files
from pathlib import Path
from typing import Any

import msgspec
from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

from disco_hw.daemon import connect, send_request
from disco_hw.daemon.emergency import read_robot_toml, stop_robot
from disco_hw.daemon.kept_connection import KeptConnection
from disco_hw.errors import InputError, WorkError
from disco_hw.processes import DescriptorReserve
from disco_hw.runtime import advice, is_estop, next_step, status_headline

REQUESTS = ("arm", "start", "stop", "disarm", "reset", "task")
# These slow or stop the robot, so they are done however late they come.
_ALWAYS = ("stop", "disarm")
# Chosen: as long as the page takes to show NO CONNECTION.
_OLDEST_STATUS_S = 1.5
# Chosen: the buttons follow the robot's state within it.
STATUS_S = 0.25
# Chosen: the daemon answers within a tick; an operator must see soon that it does not.
_STATUS_TIMEOUT_S = 0.5
_REQUEST_TIMEOUT_S = 1.0
_ESTOP_TIMEOUT_S = 0.5
_DRIVE_TIMEOUT_S = 0.5
# Chosen: for the connections of an e-stop when a flood has taken all others.
_RESERVED_DESCRIPTORS = 16
# Above any message of the page.
_MOST_BYTES = 4096

_OPEN = {"do": "drive", "forward": 0, "left": 0, "held": False, "stamp": "0"}

Send = Callable[[Mapping[str, Any]], Awaitable[None]]


class Desk:
    """Serves any number of browsers on the event loop of the page's server; `status` is the newest of the daemon.

    `draft`: the fields of a task that is being edited and not yet asked for, None without one; the scene shows it, and
    gives back by `drag` what was pulled there. `dark`: for a room without light.

    `robot_file`, and `link` where that overrides its kind, are needed to stop the robot on its link when the daemon
    does not answer.
    """

    def __init__(self, socket: Path, robot_file: Path, link: str | None = None) -> None:
        self.status: dict[str, Any] | None = None
        self.dark = False
        self.draft: dict[str, float] | None = None
        self._drags = 0
        self.error = "not asked yet"
        self._socket = socket
        self._robot_file = robot_file
        self._link = link
        # The e-stop opens nothing new: descriptors may have run out when it is pressed.
        self._stop_line = KeptConnection(socket)
        self._status_line = KeptConnection(socket)
        self._reserve = DescriptorReserve(_RESERVED_DESCRIPTORS)
        self._robot_toml = read_robot_toml(robot_file)
        self._asking = ThreadPoolExecutor(4, "desk")
        # Of its own, so that no other request can be before it in a queue.
        self._stopping = ThreadPoolExecutor(2, "desk e-stop")
        self._watching = ThreadPoolExecutor(1, "desk status")
        self._watchers = 0
        self._watch: asyncio.Task[None] | None = None

    def page(self, instance: str, token: str = "") -> bytes:
        """Return the desk as HTML; `instance` is what this server says of itself under any of its names.

        `token` lets the scene in under this machine's other name; without it the scene stays under the desk's.
        """
        text = files("disco_hw.viewer").joinpath("operator_controls.html").read_text(encoding="utf-8")
        return text.replace("@@INSTANCE@@", instance).replace("@@TOKEN@@", token).encode()

    async def serve(self, connection: ServerConnection) -> None:
        """Serve one browser until it leaves."""

        async def send(message: Mapping[str, Any]) -> None:
            await connection.send(json.dumps(message))

        drive = _DriveLine(self._socket, send)
        sending = asyncio.create_task(self._send_status(send))
        self._begin_watching()
        replies: set[asyncio.Task[None]] = set()
        edits = False
        try:
            async for message in connection:
                request = _request(message)
                if request is None:
                    await connection.close(1003, 'not a request; send a JSON object with a "do"')
                elif request["do"] == "drive":
                    await drive.query(request)
                elif request["do"] == "draft":
                    self.draft = self._within_limits(request.get("values"))
                    edits = self.draft is not None
                else:
                    task = asyncio.create_task(self._forward_request(request, send))
                    replies.add(task)
                    task.add_done_callback(replies.discard)
        except ConnectionClosed:
            pass
        finally:
            # What was asked for, be it the last word, is asked all the same; only nobody waits for the answer any more.
            await asyncio.sleep(0)
            for task in (sending, *replies):
                task.cancel()
            self._end_watching()
            if edits:
                self.draft = None
            await drive.let_go()
            await asyncio.gather(sending, *replies, return_exceptions=True)

    def drag(self, values: Mapping[str, float]) -> None:
        """Take what was pulled in the scene into the draft, to the centimetre and within the daemon's limits."""
        draft, within = self.draft, self._within_limits(values)
        if draft is None or within is None:
            return
        self.draft = draft | {name: round(value, 2) for name, value in within.items()}
        self._drags += 1

    def _within_limits(self, values: object) -> dict[str, float] | None:
        """Return the numbers of a draft, each within its limits; None without any, or while no limits are known.

        This process sends the e-stop, too: what is drawn must not be larger than what the daemon accepts. The speed is
        left out: it is not drawn, and its limit is for the size in force.
        """
        status = self.status
        if not isinstance(values, Mapping) or status is None or not status.get("ok"):
            return None
        return {
            name: float(min(max(values[name], least), largest))
            for name, (least, largest) in status["task"]["limits"].items()
            if name != "speed_m_s" and isinstance(values.get(name), int | float)
        }

    def close(self) -> None:
        """Stop the desk's threads; safe to call twice."""
        for pool in (self._asking, self._stopping, self._watching):
            pool.shutdown(wait=False, cancel_futures=True)
        self._stop_line.close()
        self._status_line.close()
        self._reserve.close()

    async def _forward_request(self, request: dict[str, Any], send: Send) -> None:
        loop = asyncio.get_running_loop()
        if request["do"] == "estop":
            reply = await asyncio.shield(loop.run_in_executor(self._stopping, self.estop))
        elif request["do"] in REQUESTS:
            reply = await asyncio.shield(loop.run_in_executor(self._asking, self._request_in_time, request))
        else:
            reply = {"do": request["do"], "ok": False, "error": "this page has no such request"}
        try:
            await send({**reply, "kind": "reply"})
        except ConnectionClosed:
            return

    def _request_in_time(self, request: dict[str, Any]) -> dict[str, Any]:
        """Send a page's request to the daemon; what may move the robot only soon after the newest status it has seen.

        A stalled network delivers a click when it flows again, when nobody expects that the robot moves.
        """
        now_s, stamp_s = time.monotonic(), request.pop("stamp", None)
        is_prompt = isinstance(stamp_s, int | float) and now_s - _OLDEST_STATUS_S <= stamp_s <= now_s
        if not is_prompt and request["do"] not in _ALWAYS:
            error = (
                f"the page's status of the robot was over {_OLDEST_STATUS_S} s old when this arrived, so nothing was "
                "done; check the network, then press again"
            )
            return {"do": request["do"], "ok": False, "error": error}
        return self.request(request)

    def request(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """Send one request to the daemon; the answer says what went wrong, nothing is raised."""
        try:
            return send_request(self._socket, request, _REQUEST_TIMEOUT_S)
        except WorkError as error:
            return {"do": request["do"], "ok": False, "error": str(error)}

    def estop(self) -> dict[str, Any]:
        """Have the daemon stop; where it does not confirm that, stop the robot on its link as well. Never raises."""
        try:
            reply = self._stop_line.request({"do": "estop"}, _ESTOP_TIMEOUT_S)
            if reply.get("ok"):
                return reply
            refused = str(reply.get("error"))
        except WorkError as error:
            refused = str(error)
        try:
            with self._reserve.released():
                outcome = stop_robot(self._robot_file, self._link, self._robot_toml, daemon_failed=True)
        except InputError as error:
            return {"do": "estop", "ok": False, "error": f"{refused}; NOT SENT: {error}"}
        kind = "text" if outcome.confirmed else "error"
        return {"do": "estop", "ok": outcome.confirmed, kind: f"{refused}; {outcome.as_text()}"}

    def _begin_watching(self) -> None:
        self._watchers += 1
        if self._watch is None:
            self._watch = asyncio.create_task(self._keep_watching())

    def _end_watching(self) -> None:
        self._watchers -= 1
        if not self._watchers and self._watch is not None:
            self._watch.cancel()
            self._watch = None

    async def _keep_watching(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            self.status, self.error = await loop.run_in_executor(self._watching, self._request_status)
            await asyncio.sleep(STATUS_S)

    def _request_status(self) -> tuple[dict[str, Any] | None, str]:
        self._stop_line.ensure_connected()
        try:
            return self._status_line.request({"do": "status"}, _STATUS_TIMEOUT_S), ""
        except WorkError as error:
            return None, str(error)

    async def _send_status(self, send: Send) -> None:
        """Send the browser the status; also how it notices that nobody is here any more."""
        while True:
            try:
                drawing = {"stamp": time.monotonic(), "dark": self.dark, "draft": self.draft, "drags": self._drags}
                await send({**shown(self.status, self.error), **drawing})
            except ConnectionClosed:
                return
            await asyncio.sleep(STATUS_S)


def shown(status: Mapping[str, Any] | None, error: str) -> dict[str, Any]:
    """Return the part of a status that the desk shows; `error` says why there is none."""
    if status is None or not status.get("ok"):
        why = error or str((status or {}).get("error") or "the daemon is starting: its loop does not run yet")
        return {"kind": "status", "ok": False, "state": "NO DAEMON", "detail": why}
    drive = status.get("drive")
    head, detail = status_headline(status)
    return {
        "kind": "status",
        "ok": True,
        "state": status["state"],
        "head": head,
        "detail": detail,
        "running": status["running"],
        "estop": is_estop(status),
        "advice": (*advice(status), *_recording(status)),
        "next": next_step(status),
        "task": {name: status["task"][name] for name in ("asked", "limits", "labels", "note")},
        "drive": None if drive is None else {"by_page": drive["by_page"], "driving": drive["driving"]},
    }


def _recording(status: Mapping[str, Any]) -> tuple[str, ...]:
    """Describe the present fault of the recording; empty if there is none."""
    fault = status["recorder"]["fault"]
    return (f"RECORDING: {fault}.",) if fault else ()


class _DriveLine:
    """One page's line to the daemon for driving: made when first needed, and again after it broke."""

    def __init__(self, socket: Path, send: Send) -> None:
        self._socket = socket
        self._send = send
        self._writer: asyncio.StreamWriter | None = None
        self._reading: asyncio.Task[None] | None = None

    async def query(self, request: Mapping[str, Any]) -> None:
        """Pass on what the pad says; the answer goes to the browser when it comes."""
        try:
            if self._writer is None:
                connection = await asyncio.to_thread(connect, self._socket, _DRIVE_TIMEOUT_S)
                reader, self._writer = await asyncio.open_unix_connection(sock=connection)
                self._reading = asyncio.create_task(self._read(reader))
            self._writer.write(json.dumps(dict(request)).encode() + b"\n")
            async with asyncio.timeout(_DRIVE_TIMEOUT_S):
                await self._writer.drain()
        except (OSError, TimeoutError, WorkError):
            await self.close()
            await self._send(
                {
                    "kind": "drive",
                    "ok": False,
                    "error": "no daemon receives the pad; start `disco-hw drive ROBOT.toml --page`",
                }
            )

    async def let_go(self) -> None:
        """Open the pad of a page that has gone, and hang up."""
        if self._writer is not None:
            self._writer.write(json.dumps(_OPEN).encode() + b"\n")
        await self.close()

    async def close(self) -> None:
        """Close the line to the daemon; safe to call twice."""
        if self._reading is not None:
            self._reading.cancel()
        if self._writer is not None:
            self._writer.close()
        self._reading = self._writer = None

    async def _read(self, reader: asyncio.StreamReader) -> None:
        try:
            while line := await reader.readline():
                await self._send({**json.loads(line), "kind": "drive"})
        except (OSError, ValueError, ConnectionClosed):
            pass
        if self._writer is not None:
            self._writer.close()
            self._writer = None


def _request(message: str | bytes) -> dict[str, Any] | None:
    """Return a browser's message as a request, or None if it is none."""
    if len(message) > _MOST_BYTES:
        return None
    try:
        request = msgspec.json.decode(message, type=dict[str, Any])
    except (msgspec.DecodeError, RecursionError):
        return None
    return request if isinstance(request.get("do"), str) else None
