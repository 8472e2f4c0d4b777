"""The server over real sockets: what it sends, to whom, whom it refuses, what pages may say."""

from __future__ import annotations

import json
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack
from socket import create_connection
from typing import Any

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin

from slamfusion.errors import ConfigError
from slamfusion.web.scene import Scene
from slamfusion.web.server import (
    MESSAGE_BYTES,
    MOST_VIEWERS,
    PageMessage,
    PageMessageError,
    PageServer,
    may_ask,
    parse_message,
)
from tests.web.maps import noise, painted, texts, tiles


@pytest.fixture
def scene() -> Scene:
    return Scene("test", is_live=True)


@pytest.fixture
def server(scene: Scene) -> Iterator[PageServer]:
    def command(name: str) -> tuple[bool, str]:
        return name == "save", f"{name} was asked"

    found = PageServer(scene, command=command)
    yield found
    found.close()


def socket(server: PageServer, **headers: Any) -> ClientConnection:
    headers = {"origin": f"http://127.0.0.1:{server.port}", **headers}
    return connect(f"ws://127.0.0.1:{server.port}/ws", max_size=None, **headers)


def say(page: ClientConnection, **message: Any) -> None:
    page.send(json.dumps(message))


def batch(page: ClientConnection) -> list[Any]:
    """Return the messages up to the next ``end``, and say that they were taken."""
    messages: list[Any] = []
    while not messages or not isinstance(messages[-1], str) or '"type":"end"' not in messages[-1]:
        messages.append(page.recv(10.0))
    say(page, type="seen", seq=texts(messages, "end")[-1]["seq"])
    return messages


def token(server: PageServer) -> str:
    return server.url.partition("#token=")[2]


def status_of(server: PageServer, path: str, **headers: str) -> int:
    address = f"http://127.0.0.1:{server.port}{path}"
    request = urllib.request.Request(address, headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=10.0) as answer:  # noqa: S310 - http
            return int(answer.status)
    except urllib.error.HTTPError as error:
        return error.code


def test_a_page_is_told_what_there_is_and_what_comes(scene: Scene, server: PageServer) -> None:
    grid = noise(200, 150)
    scene.put_map("fused", grid, "fused")
    with socket(server) as page:
        say(page, type="hello", token="", scene="", seq=0)
        messages = batch(page)
        while not tiles(messages, "fused"):
            messages += batch(page)
        assert np.array_equal(painted(tiles(messages, "fused"), 200, 150, (0, 0)), grid.cells)
        assert texts(messages, "hello")[0]["may_command"] is False
        seq = texts(messages, "end")[-1]["seq"]
    scene.put_event("warn", "while nobody looked")
    with socket(server) as page:  # it goes on where it was
        say(page, type="hello", scene=scene.id, seq=seq)
        messages = batch(page)
        assert not tiles(messages, "fused")
        assert [item["text"] for item in texts(messages, "event")] == ["while nobody looked"]
    with socket(server) as page:  # another scene's numbers mean nothing
        say(page, type="hello", scene="another", seq=seq)
        assert tiles(batch(page), "fused")


def test_commands_need_the_token(server: PageServer) -> None:
    for given, success in ((token(server), True), ("wrong", False), ("", False)):
        with socket(server) as page:
            say(page, type="hello", token=given)
            assert texts(batch(page), "hello")[0]["may_command"] is success
            for name in ("save", "reset"):
                say(page, type="command", id=7, name=name)
            answers = [json.loads(page.recv(10.0)) for _ in range(2)]
            assert {item["type"] for item in answers} == {"answer"}
            assert answers[0]["success"] is success
            assert answers[1]["success"] is False
            assert ("was asked" in answers[1]["message"]) is success


@pytest.mark.parametrize(
    "headers",
    [{"origin": "http://evil.example"}, {"origin": None}, {"origin": "http://localhost:1"}],
)
def test_strangers_get_no_socket(server: PageServer, headers: dict[str, Any]) -> None:
    with pytest.raises(InvalidStatus, match="403"), socket(server, **headers):
        pass


def test_a_name_that_was_made_to_lead_here_gets_none(server: PageServer) -> None:
    evil = f"evil.example:{server.port}"
    with (
        create_connection(("127.0.0.1", server.port)) as sock,
        pytest.raises(InvalidStatus, match="403"),
        connect(f"ws://{evil}/ws", sock=sock, origin=Origin(f"http://{evil}")),
    ):
        pass


def test_files_come_with_their_policy_and_only_those(server: PageServer) -> None:
    address = f"http://127.0.0.1:{server.port}/"
    with urllib.request.urlopen(address, timeout=10.0) as answer:
        policy = answer.headers["Content-Security-Policy"]
        text = answer.read().decode()
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    assert "set-cookie" not in answer.headers
    assert "<script " in text
    assert "<style" not in text
    for path in ("/main.js", "/view.js", "/page.css"):
        assert status_of(server, path) == 200
    for path in ("/../server.py", "/%2e%2e/server.py", "/__init__.py", "/none"):
        assert status_of(server, path) == 404
    assert status_of(server, "/", Host="evil.example") == 403
    assert token(server) not in text


@pytest.mark.parametrize("said", ["nonsense", "x" * (MESSAGE_BYTES + 1), '{"type": "seen"}'])
def test_who_says_something_else_is_cut_off(server: PageServer, said: str) -> None:
    with socket(server) as page:
        page.send(said)
        with pytest.raises(ConnectionClosed):
            page.recv(10.0)


def test_a_page_that_takes_nothing_keeps_nobody_waiting(scene: Scene, server: PageServer) -> None:
    """Its batch is the last that it gets; another page gets the newest."""
    with socket(server) as slow, socket(server) as quick:
        for page in (slow, quick):
            say(page, type="hello")
        first = slow.recv(10.0)
        assert '"type":"hello"' in str(first)
        batch(quick)
        began_s = time.monotonic()
        for seed in range(30):
            scene.put_map("a", noise(600, 600, seed=seed), "input")
        assert time.monotonic() - began_s < 5.0
        wanted = noise(600, 600, seed=29).cells
        messages: list[Any] = []
        while not np.array_equal(painted(tiles(messages, "a"), 60, 60, (0, 0)), wanted[:60, :60]):
            messages = batch(quick)
        ends = 0
        while True:
            try:
                ends += '"type":"end"' in str(slow.recv(0.3))
            except TimeoutError:
                break
        assert ends == 1


def test_more_pages_than_there_is_room_for_are_sent_away(server: PageServer) -> None:
    with ExitStack() as stack:
        for _ in range(MOST_VIEWERS):
            page = stack.enter_context(socket(server))
            say(page, type="hello")
            batch(page)
        late = stack.enter_context(socket(server))
        with pytest.raises(ConnectionClosed, match="pages look already"):
            late.recv(10.0)


def test_a_port_that_is_taken_is_named(scene: Scene, server: PageServer) -> None:
    with pytest.raises(ConfigError, match=f"port {server.port}: .*; choose another port"):
        PageServer(scene, port=server.port)


def test_it_ends(scene: Scene) -> None:
    before = threading.active_count()
    server = PageServer(scene)
    with socket(server) as page:
        say(page, type="hello")
        batch(page)
        server.close()
        with pytest.raises(ConnectionClosed):
            page.recv(10.0)
    assert threading.active_count() <= before + 1
    scene.put_event("ok", "nobody hears it")


HERE, EVERYWHERE = "127.0.0.1", "0.0.0.0"  # noqa: S104 - nothing is bound


@pytest.mark.parametrize(
    ("host", "bound", "allowed"),
    [
        ("127.0.0.1:8642", HERE, True),
        ("localhost:9000", HERE, True),  # a tunnel has a port of its own
        ("[::1]:8642", HERE, True),
        ("LOCALHOST", HERE, True),
        ("evil.example:8642", HERE, False),
        ("evil.example", EVERYWHERE, False),
        ("127.0.0.1.evil.example", HERE, False),
        ("localhost.evil.example", HERE, False),
        ("192.168.0.7:8642", HERE, False),
        ("192.168.0.7:8642", EVERYWHERE, True),
        ("robot:8642", "robot", True),
        ("other:8642", "robot", False),
        ("", HERE, False),
        ("a:b:c", HERE, False),
    ],
)
def test_hosts(host: str, bound: str, allowed: bool) -> None:
    assert may_ask(host, bound) == allowed


@pytest.mark.parametrize(
    "said",
    [
        {"type": "hello", "token": "t", "scene": "s", "seq": 4},
        {"type": "hello"},
        {"type": "seen", "seq": 9},
        {"type": "command", "id": 1, "name": "save"},
    ],
)
def test_pages_say(said: dict[str, Any]) -> None:
    assert parse_message(json.dumps(said)) == PageMessage(**said)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "nonsense",
        "[]",
        "null",
        "[" * 3000,
        '{"type": "hello", "token": 3}',
        '{"type": "hello", "seq": -1}',
        '{"type": "seen", "seq": true}',
        '{"type": "seen", "seq": 1e9}',
        '{"type": "command", "id": 1, "name": "rm"}',
        '{"type": "command", "id": 1, "name": ["save"]}',
        '{"type": "other"}',
        '{"type": "command", "id": 1}',
    ],
)
def test_nothing_else_is_understood(text: str) -> None:
    with pytest.raises(PageMessageError):
        parse_message(text)
