"""Fixtures of the ROS tests: a domain of their own, processes that end with the test.

The legs without ROS collect this folder too, so its modules skip themselves by ``importorskip``,
and here everything of ROS is imported by the fixtures.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.ros import tf2

if TYPE_CHECKING:
    from tests.ros.live import Observer, Processes

tf2.use()


@pytest.fixture
def domain(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """A ROS_DOMAIN_ID that no other test on this machine has; discovery stays on this host."""
    from tests.ros.live import free_domain, ros_environment  # noqa: PLC0415

    with free_domain() as number:
        for name, value in ros_environment(number).items():
            monkeypatch.setenv(name, value)
        yield number


@pytest.fixture
def processes(domain: int, tmp_path: Path) -> Iterator[Processes]:
    """Starts nodes as processes; what still runs at the end of the test is ended."""
    from tests.ros.live import Processes, ros_environment  # noqa: PLC0415

    with Processes(ros_environment(domain), tmp_path) as running:
        yield running


@pytest.fixture
def observer(domain: int) -> Iterator[Observer]:
    """A node in this process, in the test's domain."""
    from tests.ros.live import Observer  # noqa: PLC0415

    with Observer(domain) as node:
        yield node
