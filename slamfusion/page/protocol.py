"""What page and server say to each other beside the scene: JSON texts.

Server to page come the messages of ``slamfusion.viewer.messages`` and, ``type`` of the JSON text:

- ``hello``: ``scene`` (of this server's life), ``may_command``, ``title``, ``is_live``.
- ``end``: all of this batch was sent; ``seq`` of the newest thing in it.
- ``answer``: to a command, ``id``, ``success``, ``message``.

Page to server: ``hello`` with ``token`` (may be empty), ``scene`` and ``seq`` of what it has; then
``seen`` with ``seq`` after each ``end``, before which nothing more is sent, so that a slow page
gets the newest state and never all that came between; and ``command`` with ``id`` and ``name``.

Any website that a user visits can open a socket to localhost. The browser says for which name it
asks (Host) and which page asks (Origin). A name that a stranger made lead here (DNS rebinding) is
no address, so that addresses and the names asked for suffice.
"""

from __future__ import annotations

import hmac
import ipaddress
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from slamfusion.errors import SlamFusionError

LOOPBACK_NAMES = frozenset(("localhost",))


def host_name(host: str) -> str:
    """Return the name or address of a Host header, without port and brackets; empty for none."""
    if host.startswith("["):
        return host[1:].partition("]")[0].lower()
    return host.partition(":")[0].lower() if host.count(":") <= 1 else ""


def is_loopback(name: str) -> bool:
    """Whether a name or address is that of this machine alone."""
    if name in LOOPBACK_NAMES:
        return True
    address = _address(name)
    return address is not None and address.is_loopback


def may_ask(host: str, bound: str) -> bool:
    """Whether a server answers for what a Host header names.

    Args:
        host: the header; a port may be any, as a tunnel has another one.
        bound: what the server was told to listen on.
    """
    name = host_name(host)
    if is_loopback(name):
        return True
    if is_loopback(bound):
        return False
    return name == bound.lower() or _address(name) is not None


def is_own_origin(origin: str, host: str) -> bool:
    """Whether a socket is opened by a page of this server; without Origin it is no browser's."""
    return bool(host) and origin == f"http://{host}"


def may_command(token: str, wanted: str) -> bool:
    """Whether a token is the right one, in a time that tells nothing of it."""
    return hmac.compare_digest(token.encode("utf-8", "replace"), wanted.encode())


def _address(name: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(name)
    except ValueError:
        return None


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
