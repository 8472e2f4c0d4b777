"""Bad input: exit 1, one line that names the file and the mend, nothing written."""

from __future__ import annotations

import os
import resource
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from slamfusion.io import load_map, save_map
from tests.cli.command import INSTALLED, MAPS, TRUTH, assert_one_line_failure, json_of, run, tree

pytestmark = pytest.mark.once

YAML = """image: map.pgm
resolution: 0.05
origin: [0.0, 0.0, 0.0]
negate: 0
occupied_thresh: 0.65
free_thresh: 0.196
"""
SIZE = 40
PIXELS = bytes(205 for _ in range(SIZE * SIZE))


def bad_map(folder: Path, text: str = YAML, image: bytes | None = None) -> Path:
    """Write map.yaml and map.pgm; without ``image`` a plain unknown one."""
    (folder / "map.yaml").write_text(text, encoding="utf-8")
    if image is None:
        image = b"P5\n%d %d\n255\n" % (SIZE, SIZE) + PIXELS
    (folder / "map.pgm").write_bytes(image)
    return folder / "map.yaml"


def with_line(key: str, value: str) -> Callable[[Path], Path]:
    """Return a case whose YAML has another value (or, empty, no line) for a key."""

    def make(folder: Path) -> Path:
        lines = [line for line in YAML.splitlines() if not line.startswith(f"{key}:")]
        if value:
            lines.append(f"{key}: {value}")
        return bad_map(folder, "\n".join(lines) + "\n")

    return make


def with_image(image: bytes) -> Callable[[Path], Path]:
    """Return a case whose picture has these bytes."""
    return lambda folder: bad_map(folder, image=image)


def folder_as_map(folder: Path) -> Path:
    (folder / "map.yaml").mkdir()
    return folder / "map.yaml"


def bare_image(folder: Path) -> Path:
    bad_map(folder)
    return folder / "map.pgm"


def swapped_thresholds(folder: Path) -> Path:
    text = YAML.replace("0.65", "0.1").replace("0.196", "0.9")
    return bad_map(folder, text)


CASES: dict[str, tuple[Callable[[Path], Path], tuple[str, ...]]] = {
    "missing file": (lambda folder: folder / "map.yaml", ("map.yaml", "no such file")),
    "missing key": (with_line("resolution", ""), ("map.yaml", "resolution")),
    "nan resolution": (with_line("resolution", ".nan"), ("map.yaml", "resolution")),
    "negative resolution": (with_line("resolution", "-0.05"), ("map.yaml", "resolution")),
    "missing image": (with_line("image", "absent.pgm"), ("absent.pgm",)),
    "empty image": (with_image(b""), ("map.pgm", "starts with")),
    "truncated PGM": (with_image(b"P5\n40 40\n255\n" + PIXELS[:-7]), ("map.pgm",)),
    "image of 0 x n": (with_image(b"P5\n0 40\n255\n"), ("map.pgm", "0")),
    "text in place of an image": (with_image(b"hello, I am a map\n"), ("map.pgm",)),
    "all-unknown map": (bad_map, ("map", "unknown")),
    "a folder": (folder_as_map, ("map.yaml",)),
    "thresholds swapped": (swapped_thresholds, ("map.yaml", "free_thresh", "occupied_thresh")),
    "unknown mode": (with_line("mode", "quadrinary"), ("map.yaml", "quadrinary", "trinary")),
    "origin of two numbers": (with_line("origin", "[1.0, 2.0]"), ("map.yaml", "origin")),
    "nan origin": (with_line("origin", "[1.0, .nan, 0.0]"), ("map.yaml", "origin")),
    "tiny cells": (with_line("resolution", "0.00001"), ("map.yaml", "0.0001 to 100", "1e-05")),
    "far origin": (with_line("origin", "[0.0, 1.0e+12, 0.0]"), ("map.yaml", "origin", "1e+12")),
    "yaw in degrees": (with_line("origin", "[0.0, 0.0, 90.0]"), ("map.yaml", "yaw", "degrees")),
    "bare image": (bare_image, ("map.pgm", "--resolution")),
    "not YAML": (lambda folder: bad_map(folder, "image: [\n"), ("map.yaml",)),
}


@pytest.mark.parametrize("case", CASES)
def test_bad_map_is_one_line_and_nothing_is_written(tmp_path: Path, case: str) -> None:
    make, words = CASES[case]
    (tmp_path / "in").mkdir()
    bad = make(tmp_path / "in")
    before = tree(tmp_path)
    done = run("fuse", MAPS[0], bad, "-o", tmp_path / "out", "--device", "numpy", "--json")
    assert_one_line_failure(done, *words)
    assert "error" in json_of(done)
    assert tree(tmp_path) == before


def test_no_scheduler_and_a_store_that_exists_are_one_line(tmp_path: Path) -> None:
    fuse = ("fuse", *MAPS[:2], "--device", "numpy", "-o")
    done = run(*fuse, tmp_path / "out", "--scheduler", "localhost:8786")
    assert (done.returncode, done.stdout) == (2, "")
    assert (
        "tcp://HOST:PORT or tls://HOST:PORT as a scheduler, found 'localhost:8786'" in done.stderr
    )
    assert len(done.stderr.splitlines()) == 1
    both = run(*fuse, tmp_path / "out", "--scheduler", "local", "--processes", "2")
    assert (both.returncode, both.stdout) == (2, "")
    assert "give one of them" in both.stderr
    pytest.importorskip("zarr", reason="Zarr comes with the fleet extra")
    (tmp_path / "out.zarr").mkdir()
    assert_one_line_failure(run(*fuse, tmp_path / "out.zarr"), "out.zarr exists", "remove it")
    assert run(*fuse, tmp_path / "new.zarr", "--report", tmp_path / "page").returncode == 2
    assert [item.name for item in tmp_path.iterdir()] == ["out.zarr"]


@pytest.mark.parametrize("command", ["align", "evaluate"])
def test_other_commands_say_the_same(tmp_path: Path, command: str) -> None:
    bad = with_line("resolution", "-1")(tmp_path)
    arguments = [MAPS[0], bad] if command == "align" else [MAPS[0], "--truth", bad]
    done = run(command, *arguments, "--device", "numpy")
    assert_one_line_failure(done, "map.yaml", "resolution")
    assert done.stdout == ""


IN_MEMORY = ("map_a: ", "at 0.0001 m", "the cell size of map,", "is brought", "GiB of memory")
IN_UNITS = ("500 times finer than those of the others (0.05 m)", "in other units than metres?")


@pytest.mark.parametrize(
    ("command", "words"), [("align", IN_MEMORY), ("evaluate", IN_MEMORY), ("fuse", IN_UNITS)]
)
def test_cell_sizes_that_differ_too_much_are_refused(
    tmp_path: Path, command: str, words: tuple[str, ...]
) -> None:
    """The finest cell decides: another map of 15 m would have 2e10 cells."""
    fine = with_line("resolution", "0.0001")(tmp_path)
    (tmp_path / "map.pgm").write_bytes(b"P5\n40 40\n255\n" + bytes(20 * [0, 254]) * SIZE)
    arguments = {
        "align": [MAPS[0], fine],
        "evaluate": [MAPS[0], "--truth", fine],
        "fuse": [MAPS[0], fine, "-o", tmp_path / "out"],
    }
    limits = {resource.RLIMIT_AS: 4 * 2**30}
    done = run(command, *arguments[command], "--device", "numpy", limits=limits)
    assert_one_line_failure(done, *words)
    assert not (tmp_path / "out.yaml").exists()


def test_unknown_that_reads_as_free_is_told_and_mended(tmp_path: Path) -> None:
    grid = load_map(MAPS[0])
    yaml_path, _ = save_map(grid, tmp_path / "map")
    text = yaml_path.read_text(encoding="utf-8").replace("0.196", "0.25")
    yaml_path.write_text(text, encoding="utf-8")
    unknown = int((grid.cells == -1).sum())
    options = ("evaluate", yaml_path, "--truth", MAPS[0], "--no-align", "--json")
    told, mended = run(*options), run(*options, "--legacy-unknown")
    assert told.returncode == mended.returncode == 0
    assert f"map.yaml: {unknown} cells of grey 205" in told.stderr
    assert len(told.stderr.splitlines()) == 1
    assert json_of(told)["maps"][0]["error"] > 0.0
    assert mended.stderr == ""
    assert json_of(mended)["maps"][0]["error"] == 0.0


def test_one_map_alone(tmp_path: Path) -> None:
    done = run("fuse", MAPS[0], "-o", tmp_path / "out")
    assert_one_line_failure(done, "map_a.yaml", "at least two")
    assert not tree(tmp_path)


def test_maps_without_overlap_are_both_named(tmp_path: Path) -> None:
    """A strip of corridor and a lone square have nothing in common."""
    for name, filled in (("strip", range(18, 22)), ("square", range(5, 35))):
        pixels = bytearray(PIXELS)
        for row in filled:
            for col in range(5, 35):
                edge = row in {filled[0], filled[-1]} or (name == "square" and col in {5, 34})
                pixels[row * SIZE + col] = 0 if edge else 254
        text = YAML.replace("map.pgm", f"{name}.pgm")
        (tmp_path / f"{name}.yaml").write_text(text, encoding="utf-8")
        (tmp_path / f"{name}.pgm").write_bytes(b"P5\n40 40\n255\n" + bytes(pixels))
    before = tree(tmp_path)
    maps = (tmp_path / "strip.yaml", tmp_path / "square.yaml")
    done = run("fuse", *maps, "-o", tmp_path / "out", "--json")
    assert_one_line_failure(done, "strip", "square")
    document = json_of(done)
    assert document["fused"] is None
    assert [item["accepted"] for item in document["inputs"]] == [False, False]
    assert tree(tmp_path) == before


def test_huge_map_says_how_much_memory_it_needs(tmp_path: Path) -> None:
    text = YAML.replace("map.pgm", "huge.pgm")
    (tmp_path / "huge.yaml").write_text(text, encoding="utf-8")
    (tmp_path / "huge.pgm").write_bytes(b"P5\n2000000 2000000\n255\n")
    maps = (MAPS[0], tmp_path / "huge.yaml")
    done = run("fuse", *maps, "-o", tmp_path / "out", "--device", "numpy")
    assert_one_line_failure(done, "huge.pgm", "2000000 x 2000000", "TiB of memory")


@pytest.mark.parametrize("place", ["/proc", "/dev/null"])
def test_impossible_place_is_refused(place: str) -> None:
    done = run("fuse", *MAPS[:2], "-o", f"{place}/fused")
    assert_one_line_failure(done, place, "cannot write")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_read_only_folder_is_refused_before_any_work(tmp_path: Path) -> None:
    tmp_path.chmod(0o555)
    done = run("fuse", *MAPS[:2], "-o", tmp_path / "out")
    tmp_path.chmod(0o755)
    assert_one_line_failure(done, str(tmp_path), "cannot write")
    assert not tree(tmp_path)


@pytest.fixture
def tiny_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 64 kB: room for no fused map."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(disk)]
    if subprocess.run(mount, check=False, capture_output=True).returncode != 0:
        pytest.skip("mounting a tmpfs needs root")
    yield disk
    subprocess.run(["umount", str(disk)], check=True)


def test_full_disk_leaves_nothing_behind(tiny_disk: Path) -> None:
    done = run("fuse", *MAPS, "-o", tiny_disk / "out")
    assert_one_line_failure(done, str(tiny_disk / "out"), "No space left")
    assert not tree(tiny_disk)


def test_full_standard_output_is_a_failure(tmp_path: Path) -> None:
    command = f"exec {INSTALLED} devices > /dev/full"
    done = subprocess.run(
        ["bash", "-c", command], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert_one_line_failure(done, "standard output: No space left")


def test_a_closed_pipe_is_silent(tmp_path: Path) -> None:
    command = f"{INSTALLED} fuse --help | true; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(
        ["bash", "-c", command], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode in {0, 141}
    assert done.stderr == ""


def test_misspelt_config_key_names_the_nearest(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text("fusion: {aline: {candidates: 6}}\n", encoding="utf-8")
    config = tmp_path / "config.yaml"
    done = run("fuse", *MAPS, "-o", tmp_path / "out", "--config", config)
    assert_one_line_failure(done, "config.yaml", "'aline'", "'align'")


def test_unknown_device_names_itself(tmp_path: Path) -> None:
    done = run("fuse", *MAPS, "-o", tmp_path / "out", "--device", "abacus")
    assert_one_line_failure(done, "abacus")


def test_debug_shows_the_traceback(tmp_path: Path) -> None:
    done = run("align", MAPS[0], tmp_path / "absent.yaml", "--debug")
    assert done.returncode == 1
    assert "Traceback" in done.stderr


def test_control_characters_in_a_name_stay_on_one_line(tmp_path: Path) -> None:
    done = run("align", TRUTH, tmp_path / "two\nlines\x1b[31m.yaml")
    assert_one_line_failure(done)
    assert "\x1b" not in done.stderr


USAGE = {
    "no maps": ["fuse"],
    "no output": ["fuse", *MAPS],
    "unknown command": ["merge"],
    "unknown option": ["fuse", *MAPS, "-o", "x", "--shout"],
    "output is a folder": ["fuse", *MAPS, "-o", "."],
    "nothing to evaluate against": ["evaluate", MAPS[0]],
    "three maps to align": ["align", *MAPS],
}


BAD_VALUES = {
    "--occupied-percent 120": "'--occupied-percent': must lie in [0, 100] %, found 120.0",
    "--window-m nan": "'--window-m': must lie in [0, inf] m, found nan",
    "--window-m soon": "'--window-m': 'soon' is not a valid float.",
    "--fused-resolution 0": "'--fused-resolution': must lie in [0.0001, inf] m, found 0.0",
    "--free-percent 80": "free_percent (80) must be below occupied_percent (65); swap them",
    "--mode loudest": "'consensus', 'majority', 'drawn'.",
}


@pytest.mark.parametrize("given", BAD_VALUES)
def test_a_bad_value_is_one_line_that_names_the_option(tmp_path: Path, given: str) -> None:
    done = run("fuse", *MAPS, "-o", "x", *given.split(), cwd=tmp_path)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith("slamfusion: error: Invalid value")
    assert line.endswith(BAD_VALUES[given])
    assert done.stdout == ""
    assert not tree(tmp_path)


@pytest.mark.parametrize("case", USAGE)
def test_wrong_usage_exits_with_two(tmp_path: Path, case: str) -> None:
    done = run(*USAGE[case], cwd=tmp_path)
    assert done.returncode == 2
    assert "Usage:" in done.stderr
    assert done.stdout == ""
    assert not tree(tmp_path)
