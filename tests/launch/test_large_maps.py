"""Maps of 16 MB get through: with our Fast DDS profile, without shared memory, with too little."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="rclpy is absent: install the extra ros, or source a ROS")

from tests.cli.command import ROOT
from tests.launch.big_map import CELLS, big_grid, digest
from tests.ros.live import Processes

pytestmark = pytest.mark.ros

PROFILE = ROOT / "launch_scripts" / "fastdds-large-maps.xml"
WITH_PROFILE = {"FASTRTPS_DEFAULT_PROFILES_FILE": str(PROFILE)}
# What the profile says, read from it.
SEGMENT = int(PROFILE.read_text(encoding="utf-8").split("<segment_size>")[1].split("<")[0])


def heard(processes: Processes, env: dict[str, str], *before: str) -> tuple[dict[str, Any], str]:
    """Send a map from one process to another; return what the latter told, and both outputs."""
    command = [sys.executable, "-m", "tests.launch.big_map"]
    env = {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]), **env}
    if before:  # both on one side of it, e.g. in one container
        both = " ".join(f"'{word}'" for word in command)
        script = f"{both} send & {both} hear; code=$?; wait; exit $code"
        listener = processes.start("both", [*before, script], env)
    else:
        processes.start("sender", [*command, "send"], env)
        listener = processes.start("listener", [*command, "hear"], env)
    assert listener.wait(50.0) == 0
    (document,) = (line for line in listener.text().splitlines() if line.startswith("{"))
    return json.loads(document), listener.text()


def private(kind: str, prepare: str) -> tuple[str, ...]:
    """The words before a shell script that runs it in a namespace of its own; may skip.

    Args:
        kind: option of unshare.
        prepare: command that makes the namespace ready.
    """
    unshare = ("unshare", f"-r{kind.removeprefix('-')}", "sh", "-c")
    if subprocess.run([*unshare, prepare], capture_output=True, check=False).returncode:
        pytest.skip(f"this machine does not let a process have its own: {prepare}")
    return (*unshare, f'{prepare} && eval "$1"', "sh")


def is_whole(told: dict[str, Any]) -> bool:
    return told["shape"] == [CELLS, CELLS] and told["digest"] == digest(big_grid())


def test_with_the_profile_a_whole_map_fits_into_shared_memory(processes: Processes):
    assert SEGMENT > CELLS * CELLS
    told, said = heard(processes, WITH_PROFILE)
    assert is_whole(told)
    assert told["shared_memory"] >= SEGMENT, "the profile was not used"
    assert "Error" not in said


@pytest.mark.full
@pytest.mark.parametrize("transports", ["UDPv4", "LARGE_DATA"])
def test_over_the_transports_of_a_network_a_map_comes_whole(transports: str, processes: Processes):
    """In a network of their own, since rmw adds shared memory where discovery is for this host."""
    before = private("-n", "ip link set lo up multicast on")
    env = {"FASTDDS_BUILTIN_TRANSPORTS": transports, "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}
    told, said = heard(processes, env, *before)
    assert is_whole(told)
    if transports == "UDPv4":
        assert told["shared_memory"] == 0
        assert "Error" not in said


@pytest.mark.full
def test_where_shared_memory_does_not_suffice_a_map_goes_over_udp(processes: Processes):
    """As in a container with little ``/dev/shm``: here a mount that only these processes see."""
    before = private("-m", "mount -t tmpfs -o size=8m tmpfs /dev/shm")
    told, said = heard(processes, WITH_PROFILE, *before)
    assert is_whole(told)
    assert told["shared_memory"] < SEGMENT
    assert "RTPS_TRANSPORT_SHM" in said
