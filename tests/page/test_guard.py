"""Who is let in: names of this machine, pages of this server, the token; and what pages may say."""

from __future__ import annotations

import json

import pytest

from slamfusion.page.protocol import (
    Command,
    Hello,
    PageMessageError,
    Seen,
    is_own_origin,
    may_ask,
    may_command,
    parse_message,
)

pytestmark = pytest.mark.once

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
    ("origin", "own"),
    [
        ("http://localhost:8642", True),
        ("http://localhost:3000", False),
        ("http://127.0.0.1:8642", False),  # another name is another site to a browser
        ("https://evil.example", False),
        ("null", False),
        ("", False),
    ],
)
def test_origins(origin: str, own: bool) -> None:
    assert is_own_origin(origin, "localhost:8642") == own


def test_no_host_has_no_origin_of_its_own() -> None:
    assert not is_own_origin("http://", "")


def test_tokens() -> None:
    assert may_command("abc", "abc")
    for token in ("", "ab", "abcd", "äbc", "\ud800"):
        assert not may_command(token, "abc")


@pytest.mark.parametrize(
    ("said", "wanted"),
    [
        ({"type": "hello", "token": "t", "scene": "s", "seq": 4}, Hello("t", "s", 4)),
        ({"type": "hello"}, Hello("", "", 0)),
        ({"type": "seen", "seq": 9}, Seen(9)),
        ({"type": "command", "id": 1, "name": "save"}, Command("save", 1)),
    ],
)
def test_pages_say(said: dict[str, object], wanted: object) -> None:
    assert parse_message(json.dumps(said)) == wanted


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
    ],
)
def test_nothing_else_is_understood(text: str) -> None:
    with pytest.raises(PageMessageError):
        parse_message(text)
