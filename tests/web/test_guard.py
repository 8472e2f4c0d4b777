"""Who is let in: the names of this machine; and what pages may say."""

from __future__ import annotations

import json
from typing import Any

import pytest

from slamfusion.web.server import PageMessage, PageMessageError, may_ask, parse_message

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
