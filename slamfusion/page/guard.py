"""Who may talk to a page's server: any website that a user visits can open a socket to localhost.

The browser says for which name it asks (Host) and which page asks (Origin). A name that a stranger
made lead here (DNS rebinding) is no address, so that addresses and the names asked for suffice.
"""

from __future__ import annotations

import hmac
import ipaddress

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
