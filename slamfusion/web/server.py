"""``PageServer``: serve the front end's files and its sockets in one thread.

The server sends the messages of ``slamfusion.web.scene`` and, ``type`` of the JSON text:

- ``hello``: ``scene`` (its id), ``may_command``, ``title``, ``is_live``, ``has_report``.
- ``end``: all of this batch was sent; ``seq`` of the newest thing in it.
- ``answer``: to a command, ``id``, ``success``, ``message``.

A page sends ``hello`` with ``token`` (may be empty), ``scene`` and ``seq`` of what it has; ``seen``
with ``seq`` after each ``end``, before which nothing more is sent, so that a slow page gets the
newest state only; and ``command`` with ``id`` and ``name``.

Any website that a user visits can open a socket to localhost. The browser sends the name it asks
for (Host) and the asking page (Origin). A foreign name that resolves to here (DNS rebinding) is no
address, so checking for addresses and the bound name suffices.
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import ipaddress
import json
import secrets
import socket
import threading
from collections.abc import Callable
from dataclasses import MISSING, dataclass
from pathlib import Path, PurePath
from typing import Literal

from slamfusion.config import Checked, from_mapping, option
from slamfusion.errors import ConfigError, SlamFusionError, extra_needed
from slamfusion.web import front_end
from slamfusion.web.scene import Scene, to_text

with extra_needed("page", "the page needs"):
    import uvicorn
    from starlette.applications import Starlette
    from starlette.requests import HTTPConnection, Request
    from starlette.responses import FileResponse, PlainTextResponse, Response
    from starlette.routing import Route, WebSocketRoute
    from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

# Whether a command was carried out, and what to say.
Answer = tuple[bool, str]

MOST_VIEWERS = 16
# A page says hello this soon, and has taken a batch this soon, or is cut off; seconds.
HELLO_S, SEEN_S = 10.0, 60.0
# Between two batches to one page; and when nothing is new, a sign of life, seconds.
PAUSE_S, ALIVE_S = 0.1, 2.0
COMMAND_S = 20.0
# Answers of a page that wait; ours answers once a batch.
MOST_TAKEN = 16
END_S = 5.0

# Codes of closed sockets (RFC 6455): refused by policy; come again later.
REFUSED, BUSY = 1008, 1013
# Largest message of a page.
MESSAGE_BYTES = 4096

TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
}
HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
        "connect-src 'self' ws://{host}; base-uri 'none'; form-action 'none'; "
        "frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cache-Control": "no-store",
}


class PageMessageError(SlamFusionError):
    """Something that no page of ours says."""


@dataclass(frozen=True)
class PageMessage(Checked):
    """A message of a page; see the module."""

    type: Literal["hello", "seen", "command"] = option(MISSING, "what is said")
    token: str = ""
    scene: str = ""
    seq: int = option(0, "newest number that the page has", low=0)
    name: Literal["", "save", "reset"] = option("", "what to do")
    id: int = option(0, "of the question", low=0)


def parse_message(text: str) -> PageMessage:
    """Return a page's message; ``PageMessageError`` if it is not of the protocol."""
    try:
        said = from_mapping(PageMessage, json.loads(text))
    except (ValueError, TypeError, AttributeError, LookupError, RecursionError, ConfigError):
        raise PageMessageError("no message of our page") from None
    if said.type == "command" and not said.name:
        raise PageMessageError("a command without a name")
    return said


def may_ask(host: str, bound: str) -> bool:
    """Whether a server bound to an address answers for a Host header; any port, for tunnels."""
    if host.startswith("["):
        name = host[1:].partition("]")[0].lower()
    else:
        name = host.partition(":")[0].lower() if host.count(":") <= 1 else ""
    if _is_loopback(name):
        return True
    return not _is_loopback(bound) and (name == bound.lower() or _address(name) is not None)


def _is_loopback(name: str) -> bool:
    address = _address(name)
    return name == "localhost" or (address is not None and address.is_loopback)


def _address(name: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(name)
    except ValueError:
        return None


class PageServer:
    """Serves a scene until it is closed.

    Args:
        port: 0 takes a free one.
        command: carries out a command of a page that has the token, in some thread.
        token: lets a page command; empty: a new one.
        report: folder of a report, served with the page.

    Attributes:
        url: with the token, if there are commands, in its fragment, which no browser sends.

    Raises:
        ConfigError: it cannot listen there.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        host: str = "127.0.0.1",
        port: int = 0,
        command: Callable[[str], Answer] | None = None,
        token: str = "",
        report: Path | None = None,
    ) -> None:
        self._scene = scene
        self._report = report
        self._host = host
        self._command = command
        self._token = token or secrets.token_urlsafe(24)
        # Only these files and the report are served.
        self._files = {
            name: (text.encode(), TYPES[PurePath(name).suffix])
            for name, text in front_end().items()
            if PurePath(name).suffix in TYPES
        }
        self._viewers = 0
        self._socket = _listen(host, port)
        self.port = int(self._socket.getsockname()[1])
        shown = f"[{host}]" if ":" in host else host
        fragment = "" if command is None else f"#token={self._token}"
        self.url = f"http://{shown}:{self.port}/{fragment}"
        app = Starlette(
            routes=[
                Route("/{name:path}", self._file, methods=["GET", "HEAD"]),
                WebSocketRoute("/ws", self._look),
            ]
        )
        self._server = uvicorn.Server(
            uvicorn.Config(
                app,
                log_config=None,
                access_log=False,
                server_header=False,
                ws_max_size=MESSAGE_BYTES,
                # Tiles are small already.
                ws_per_message_deflate=False,
                lifespan="off",
                timeout_graceful_shutdown=1,
            )
        )
        self._thread = threading.Thread(
            target=self._server.run, args=([self._socket],), name="page server", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Cut everybody off and end the threads."""
        self._server.should_exit = True
        self._thread.join(END_S)
        self._socket.close()

    # -- in the server's thread -------------------------------------------------------------------

    def _may_ask(self, connection: HTTPConnection) -> bool:
        return may_ask(connection.headers.get("host", ""), self._host)

    async def _file(self, request: Request) -> Response:
        """Answer with a file of the front end."""
        host = request.headers.get("host", "")
        if not self._may_ask(request):
            return PlainTextResponse("this page answers for its own address alone\n", 403)
        path = request.path_params["name"] or "index.html"
        headers = {name: value.replace("{host}", host) for name, value in HEADERS.items()}
        if self._report is not None and path.startswith("report/"):
            files = {item.name: item for item in self._report.iterdir() if item.is_file()}
            if (file := files.get(path.removeprefix("report/"))) is not None:
                del headers["Content-Security-Policy"]  # the report has its own
                return FileResponse(file, headers=headers)
        found = self._files.get(path)
        if found is None:
            return PlainTextResponse("there is no such page\n", 404)
        content, kind = found
        return Response(content, headers=headers, media_type=kind)

    async def _look(self, ws: WebSocket) -> None:
        """Show the scene to one page until it goes."""
        origin, host = ws.headers.get("origin", ""), ws.headers.get("host", "")
        # A request without Origin is not from a browser.
        if not host or not self._may_ask(ws) or origin != f"http://{host}":
            await ws.close(REFUSED)  # before it is accepted: HTTP 403
            return
        await ws.accept()
        if self._viewers >= MOST_VIEWERS:
            await ws.close(BUSY, f"{MOST_VIEWERS} pages look already")
            return
        self._viewers += 1
        try:
            await self._serve(ws)
        except (WebSocketDisconnect, asyncio.TimeoutError, PageMessageError, KeyError):
            pass  # it went, fell silent, or is no page of ours
        finally:
            self._viewers -= 1
            if ws.application_state is not WebSocketState.DISCONNECTED:
                with contextlib.suppress(RuntimeError, WebSocketDisconnect):
                    await ws.close(REFUSED)

    async def _serve(self, ws: WebSocket) -> None:
        hello = parse_message(await asyncio.wait_for(ws.receive_text(), HELLO_S))
        if hello.type != "hello":
            return
        may = self._command is not None and hmac.compare_digest(
            hello.token.encode("utf-8", "replace"), self._token.encode()
        )
        scene = self._scene
        taken: asyncio.Queue[int] = asyncio.Queue(MOST_TAKEN)
        greeting = {"scene": scene.id, "title": scene.title, "is_live": scene.is_live}
        greeting |= {"may_command": may, "has_report": self._report is not None}
        await ws.send_text(to_text("hello", greeting))
        tasks = [
            asyncio.create_task(self._send(ws, hello.seq if hello.scene == scene.id else 0, taken)),
            asyncio.create_task(self._hear(ws, taken, may_command=may)),
        ]
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def _send(self, ws: WebSocket, seen: int, taken: asyncio.Queue[int]) -> None:
        """Send what is newer than a number, wait until the page has taken it, and go on."""
        while True:
            messages, seq = await asyncio.to_thread(self._scene.since, seen)
            for message in messages:
                await (
                    ws.send_text(message) if isinstance(message, str) else ws.send_bytes(message)
                )
            await ws.send_text(to_text("end", {"seq": seq}))
            while (seen := await asyncio.wait_for(taken.get(), SEEN_S)) < seq:
                pass
            for _ in range(round(ALIVE_S / PAUSE_S)):
                await asyncio.sleep(PAUSE_S)
                if self._scene.has_news(seen):
                    break

    async def _hear(self, ws: WebSocket, taken: asyncio.Queue[int], *, may_command: bool) -> None:
        """Take what the page says."""
        while True:
            said = parse_message(await ws.receive_text())
            if said.type == "seen":
                await taken.put(said.seq)
            elif said.type == "command":
                success, text = await self._obey(said, may_command=may_command)
                answer = {"id": said.id, "success": success, "message": text}
                await ws.send_text(to_text("answer", answer))

    async def _obey(self, said: PageMessage, *, may_command: bool) -> Answer:
        """Carry out a command, where the page may command."""
        if not may_command or self._command is None:
            return False, "this page may only look: open the address with its token"
        try:
            return await asyncio.wait_for(asyncio.to_thread(self._command, said.name), COMMAND_S)
        except asyncio.TimeoutError:
            return False, f"no answer in {COMMAND_S:g} s"


def _listen(host: str, port: int) -> socket.socket:
    """Return a listening socket; ``ConfigError`` for a foreign address or a used port."""
    try:
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listening = socket.socket(family)
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind(address)
        listening.listen()
    except OSError as error:
        text = f"page: cannot listen on {host} port {port}: {error.strerror}; choose another port"
        raise ConfigError(text) from error
    return listening
