"""The version of the package, and of those that its results depend on."""

from __future__ import annotations

import platform
from functools import cache

__version__ = "0.1.0"

DISTRIBUTIONS = ("numpy", "scipy", "opencv-python-headless", "pyopencl", "PyYAML", "click", "rich")


def versions() -> dict[str, str | None]:
    """Return the versions that affect results; None for absent packages."""
    found: dict[str, str | None] = {"python": platform.python_version()}
    return found | {name: version_of(name) for name in ("slamfusion", *DISTRIBUTIONS)}


@cache
def version_of(distribution: str) -> str | None:
    """Return the version of an installed distribution; None if absent."""
    import importlib.metadata  # noqa: PLC0415  (loads slowly)

    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None
