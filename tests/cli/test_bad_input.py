"""Bad input: exit 1, one line that names the file and the mend, nothing written."""

from __future__ import annotations

import importlib.util
import resource
from pathlib import Path

import pytest

from tests.cli.command import MAPS, TRUTH, assert_one_line_failure, run
from tests.io.pictures import pgm, write_map


def test_a_store_that_exists_is_one_line(tmp_path: Path) -> None:
    pytest.importorskip("zarr", reason="Zarr comes with the fleet extra")
    fuse = ("fuse", *MAPS[:2], "--device", "numpy", "-o")
    (tmp_path / "out.zarr").mkdir()
    assert_one_line_failure(run(*fuse, tmp_path / "out.zarr"), "out.zarr exists", "remove it")
    assert run(*fuse, tmp_path / "new.zarr", "--report", tmp_path / "page").returncode == 2
    assert [item.name for item in tmp_path.iterdir()] == ["out.zarr"]


@pytest.mark.parametrize("command", ["align", "evaluate", "fuse"])
def test_cell_sizes_that_differ_too_much_are_refused(tmp_path: Path, command: str) -> None:
    """The finest cell decides: another map of 15 m would have 2e10 cells."""
    fine = write_map(tmp_path, pgm([20 * [0, 254]] * 40), resolution="0.0001")
    arguments = {
        "align": [MAPS[0], fine],
        "evaluate": [MAPS[0], "--truth", fine],
        "fuse": [MAPS[0], fine, "-o", tmp_path / "out"],
    }
    limits = {resource.RLIMIT_AS: 4 * 2**30}
    done = run(command, *arguments[command], "--device", "numpy", limits=limits)
    assert_one_line_failure(done, "500 times ", "in other units than metres?")
    assert not (tmp_path / "out.yaml").exists()


def test_control_characters_in_a_name_stay_on_one_line(tmp_path: Path) -> None:
    done = run("align", TRUTH, tmp_path / "two\nlines\x1b[31m.yaml")
    assert_one_line_failure(done)
    assert "\x1b" not in done.stderr


@pytest.mark.parametrize(("truth", "is_used"), [(TRUTH, False), (f"{TRUTH[:-4]}pgm", True)])
def test_a_resolution_that_no_image_needs_is_named(truth: str, *, is_used: bool) -> None:
    done = run("align", MAPS[0], truth, "--resolution", "0.05")
    assert done.returncode == 0
    assert ("--resolution is not used: each map has a YAML" in done.stderr) == (not is_used)


@pytest.mark.skipif(importlib.util.find_spec("rclpy") is not None, reason="rclpy is here")
def test_without_ros_the_command_says_what_to_install():
    assert_one_line_failure(
        run("node", "tinyslam"), "rclpy cannot be imported", "pip install 'slamfusion[ros]'"
    )
