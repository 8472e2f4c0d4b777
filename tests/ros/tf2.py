"""The suite's own tf2_msgs and map_msgs, built by ``build_messages.sh``; never a user's.

A sourced ROS has its own, which are used then.
"""

from __future__ import annotations

import ctypes
import importlib.util
import os
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PREFIX = Path(os.environ.get("SLAMFUSION_TF2_PREFIX", ROOT / ".venv-tf2" / "prefix"))
VERSION = f"python{sys.version_info.major}.{sys.version_info.minor}"
PACKAGES = PREFIX / "lib" / VERSION / "site-packages"
IS_BUILT = (PACKAGES / "tf2_msgs").is_dir()

ABSENT = "{} is not built for this Python: launch_scripts/build_messages.sh builds it"


def environment() -> dict[str, str]:
    """Return what a process needs to find it; empty where it is not built or not needed."""
    if not IS_BUILT or "ROS_DISTRO" in os.environ:
        return {}
    added = {
        "PYTHONPATH": str(PACKAGES),
        "LD_LIBRARY_PATH": str(PREFIX / "lib"),
        "AMENT_PREFIX_PATH": str(PREFIX),
    }
    found = {name: [*os.environ.get(name, "").split(os.pathsep)] for name in added}
    return {
        name: os.pathsep.join([value, *(item for item in found[name] if item and item != value)])
        for name, value in added.items()
    }


def use() -> None:
    """Let this process import them, which has started without their libraries on the path."""
    if not IS_BUILT or importlib.util.find_spec("tf2_msgs") is not None:
        return
    sys.path.append(str(PACKAGES))
    # The generated code loads these by their bare names; those that are loaded are found.
    libraries = list((PREFIX / "lib").glob("lib*_msgs__*.so"))
    for _ in range(len(libraries)):
        for path in list(libraries):
            try:
                ctypes.CDLL(str(path), ctypes.RTLD_GLOBAL)
            except OSError:  # needs another one first
                continue
            libraries.remove(path)


def skip_without(package: str = "tf2_msgs") -> None:
    """Skip a test that is about messages of a package, those of ``/tf`` unless named."""
    if importlib.util.find_spec(package) is None:
        pytest.skip(ABSENT.format(package))
