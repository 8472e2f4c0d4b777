"""What page and server say to each other beside the scene: JSON texts.

Server to page come the messages of ``slamfusion.viewer.messages`` and, ``type`` of the JSON text:

- ``hello``: ``scene`` (of this server's life), ``may_command``, ``title``, ``is_live``.
- ``end``: all of this batch was sent; ``seq`` of the newest thing in it.
- ``answer``: to a command, ``id``, ``success``, ``message``.

Page to server: ``hello`` with ``token`` (may be empty), ``scene`` and ``seq`` of what it has; then
``seen`` with ``seq`` after each ``end``, before which nothing more is sent, so that a slow page
gets the newest state and never all that came between; and ``command`` with ``id`` and ``name``.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from slamfusion.errors import SlamFusionError

COMMANDS = ("save", "reset")
# A page says no more than this at once.
MESSAGE_BYTES = 4096


class PageMessageError(SlamFusionError):
    """Something that no page of ours says."""


@dataclass(frozen=True)
class Hello:
    """The first message of a page.

    Attributes:
        token: what lets it command; empty for a page that only looks.
        scene, seq: what it has from a connection before; empty and 0 for nothing.
    """

    token: str
    scene: str
    seq: int


@dataclass(frozen=True)
class Seen:
    """The page has taken everything up to ``seq``."""

    seq: int


@dataclass(frozen=True)
class Command:
    """The page asks for something; ``id`` comes back with the answer."""

    id: int
    name: str


def parse_message(text: str) -> Hello | Seen | Command:
    """Return what a page says.

    Raises:
        PageMessageError: it is nothing of the protocol.
    """
    try:
        found = json.loads(text)
    except (ValueError, RecursionError):
        message = "no JSON"
        raise PageMessageError(message) from None
    if not isinstance(found, dict):
        message = "no JSON object"
        raise PageMessageError(message)
    kind = found.get("type")
    if kind == "hello":
        return Hello(_text(found, "token"), _text(found, "scene"), _count(found, "seq"))
    if kind == "seen":
        return Seen(_count(found, "seq"))
    if kind == "command" and found.get("name") in COMMANDS:
        return Command(_count(found, "id"), _text(found, "name"))
    message = "an unknown message"
    raise PageMessageError(message)


def _text(found: Mapping[str, Any], key: str) -> str:
    value = found.get(key, "")
    if not isinstance(value, str):
        message = f"{key} is no text"
        raise PageMessageError(message)
    return value


def _count(found: Mapping[str, Any], key: str) -> int:
    value = found.get(key, 0)
    if type(value) is not int or not 0 <= value < 2**53:
        message = f"{key} is no count"
        raise PageMessageError(message)
    return value
