"""The messages of page and server other than the scene: JSON texts.

Server to page come the messages of ``slamfusion.viewer.messages`` and, ``type`` of the JSON text:

- ``hello``: ``scene`` (of this server's life), ``may_command``, ``title``, ``is_live``,
  ``has_report``.
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
from dataclasses import MISSING, dataclass
from typing import Literal

from slamfusion.config import Checked, from_mapping, option
from slamfusion.errors import ConfigError, SlamFusionError

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
        bound: the address that the server listens on.
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
    """Whether a token is the right one, in constant time."""
    return hmac.compare_digest(token.encode("utf-8", "replace"), wanted.encode())


def _address(name: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(name)
    except ValueError:
        return None


# A page says no more than this at once.
MESSAGE_BYTES = 4096


class PageMessageError(SlamFusionError):
    """Something that no page of ours says."""


@dataclass(frozen=True)
class Hello(Checked):
    """The first message of a page.

    Attributes:
        token: what lets it command; empty for a page that only looks.
        scene, seq: what it has from a connection before; empty and 0 for nothing.
    """

    token: str = ""
    scene: str = ""
    seq: int = option(0, "newest number that the page has", low=0)


@dataclass(frozen=True)
class Seen(Checked):
    """The page has taken everything up to ``seq``."""

    seq: int = option(0, "newest number that the page has", low=0)


@dataclass(frozen=True)
class Command(Checked):
    """The page asks for something; ``id`` comes back with the answer."""

    name: Literal["save", "reset"] = option(MISSING, "what to do")
    id: int = option(0, "of the question", low=0)


KINDS: Mapping[str, type[Hello | Seen | Command]] = {
    "hello": Hello,
    "seen": Seen,
    "command": Command,
}


def parse_message(text: str) -> Hello | Seen | Command:
    """Return what a page says.

    Raises:
        PageMessageError: it is nothing of the protocol.
    """
    try:
        found = json.loads(text)
        return from_mapping(KINDS[found.pop("type")], found)
    except (ValueError, TypeError, AttributeError, LookupError, RecursionError, ConfigError):
        raise PageMessageError("no message of our page") from None
