"""``colcon build`` of a workspace with a checkout: what ``ros2 run`` and ``ros2 launch`` find."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING
from xml.dom import minidom

import pytest

from slamfusion import __version__
from slamfusion.ros.interface import NODES
from tests.cli.command import ROOT

if TYPE_CHECKING:
    from tests.ros.live import Observer, Processes

pytestmark = pytest.mark.once

# Files of the package that are no modules.
PLACES = ("report/templates", "web/static")
EXECUTABLES = {f"{name}_node" for name in NODES} | {"slamfusion"}


def sourced(workspace: Path, command: str) -> str:
    """Run a command after ``source install/setup.bash``, with the Python of the tests."""
    path = os.pathsep.join([str(Path(sys.executable).parent), "/usr/bin", "/bin"])
    done = subprocess.run(
        ["bash", "-c", f"source install/setup.bash && cd / && {command}"],
        cwd=workspace,
        env={**os.environ, "PATH": path},
        capture_output=True,
        text=True,
        check=False,
        timeout=60.0,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.mark.full
def test_the_executables_are_where_ros2_run_looks(workspace: Path):
    folder = workspace / "install" / "slamfusion" / "lib" / "slamfusion"
    assert {item.name for item in folder.iterdir()} == EXECUTABLES
    assert all(os.access(item, os.X_OK) for item in folder.iterdir())
    if "copied" in workspace.name:
        first = (folder / "fusion_node").read_text().splitlines()[0]
        assert first == "#!/usr/bin/env python3"


@pytest.mark.full
def test_the_files_are_where_ros2_launch_looks(workspace: Path):
    share = workspace / "install" / "slamfusion" / "share"
    marker = share / "ament_index" / "resource_index" / "packages" / "slamfusion"
    assert marker.is_file()
    scripts = ROOT / "launch_scripts"
    for folder, pattern in (("launch", "*.launch.py"), ("config", "slamfusion.yaml")):
        for path in scripts.glob(pattern):
            installed = share / "slamfusion" / folder / path.name
            assert installed.read_bytes() == path.read_bytes()
    installed = {item.name for item in (share / "slamfusion" / "config").iterdir()}
    assert installed == {item.name for item in (scripts / "ament" / "config").iterdir()}


@pytest.mark.full
def test_the_library_of_the_workspace_is_used_with_all_its_files(workspace: Path):
    code = (
        "import slamfusion.report, pathlib; from slamfusion.compute.opencl import kernel_folder; "
        "from slamfusion.jobs.records import load_schema; from importlib.metadata import version; "
        "folder = pathlib.Path(slamfusion.__file__).parent; "
        "print(version('slamfusion'), load_schema('fuse')['$ref'], folder, kernel_folder(), "
        f"*(item for place in {PLACES} for item in (folder / place).iterdir()), sep='\\n')"
    ).replace("$", r"\$")
    found = sourced(workspace, f'python3 -c "{code}"').splitlines()
    number, document, package, kernels, *files = found
    assert number == __version__
    assert document == "#/$defs/fuse"
    assert str(workspace) in package
    assert str(workspace) in kernels
    assert {"/".join(Path(item).parts[-3:]) for item in files} == {
        f"{place}/{item.name}"
        for place in PLACES
        for item in (ROOT / "slamfusion" / place).iterdir()
    }


@pytest.mark.full
def test_an_installed_program_runs(workspace: Path):
    # A linked one begins with the Python that colcon ran with, which has no NumPy here.
    folder = workspace / "install" / "slamfusion" / "lib" / "slamfusion"
    said = sourced(workspace, f"python3 {folder}/slamfusion --version")
    assert f"version {__version__}" in said
    assert "Usage: slamfusion node" in sourced(workspace, f"python3 {folder}/fusion_node --help")


@pytest.mark.full
@pytest.mark.ros
def test_an_installed_node_is_found_and_runs_as_ros2_run_starts_it(
    workspace: Path, request: pytest.FixtureRequest
):
    pytest.importorskip("rclpy", reason="rclpy is absent: install the extra ros, or source a ROS")
    from ament_index_python.packages import get_package_prefix  # noqa: PLC0415

    processes: Processes = request.getfixturevalue("processes")
    observer: Observer = request.getfixturevalue("observer")
    prefix = workspace / "install" / "slamfusion"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AMENT_PREFIX_PATH", str(prefix))
        assert get_package_prefix("slamfusion") == str(prefix)

    share = prefix / "share" / "slamfusion"
    command = (
        f"source {workspace}/install/setup.bash && "
        f"exec python3 {prefix}/lib/slamfusion/fusion_node --ros-args -r __ns:=/robot1 "
        f"--params-file {share}/config/slamfusion.yaml"
    )
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    node = processes.start("fusion_node", ["bash", "-c", command], {"PATH": path})
    status = observer.wait_status("robot1/fusion: fusion", "nothing is fused", timeout_s=40.0)
    assert status.hardware_id == "fusion"
    assert node.interrupt() == 0


def test_the_manifests_say_the_same():
    ament = ROOT / "launch_scripts" / "ament"
    manifest = minidom.parseString((ament / "package.xml").read_text())  # noqa: S318  (our own)

    def said(tag: str) -> list[str]:
        return [item.firstChild.data for item in manifest.getElementsByTagName(tag)]

    assert said("name") == ["slamfusion"]
    assert said("version") == [__version__]
    project = (ROOT / "pyproject.toml").read_text()
    assert re.search(r'^description = "(.*)"$', project, re.MULTILINE)[1] == said("description")[0]
    # Every message package that the nodes import.
    source = "\n".join(path.read_text() for path in (ROOT / "slamfusion" / "ros").glob("*.py"))
    imported = set(re.findall(r"^\s*from (\w+)\.(?:msg|srv) import", source, re.MULTILINE))
    assert imported | {"rclpy"} <= set(said("exec_depend"))
