"""``slamfusion simulate``, started as a user starts it."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from tests.cli.command import assert_one_line_failure, json_of, run, tree


def test_options_change_the_course(tmp_path: Path) -> None:
    options = ("--lidar", "rplidar", "--no-obstacle", "--people", "1", "--resolution", "0.1")
    done = run("simulate", "f16", "-o", tmp_path, *options, "--json")
    made = json_of(done)
    assert (made["beams"], made["world"]["resolution"]) == (360, 0.1)
    assert (made["world"]["people"], made["world"]["obstacles"]) == (1, 0)
    written = yaml.safe_load((tmp_path / "course.yaml").read_text(encoding="utf-8"))
    assert written["lidar"]["model"] == "rplidar"
    assert written["obstacles"] == []
    assert len(written["people"]) == 1


def test_a_seed_on_the_command_line_beats_the_files(tmp_path: Path) -> None:
    assert run("simulate", "f16", "--seed", "3", "-o", tmp_path / "f16").returncode == 0
    course = tmp_path / "f16" / "course.yaml"
    done = run("simulate", course, "-o", tmp_path / "given", "--seed", "4", "--json")
    assert json_of(done)["seed"] == 4
    logs = [tmp_path / folder / "f16.log.gz" for folder in ("f16", "given")]
    assert logs[0].read_bytes() != logs[1].read_bytes()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("nowhere",), ("no course file", "'nowhere' is not one of office, ")),
        (("far.yaml",), ("drives into a wall after",)),
    ],
)
def test_failures_are_one_line_and_leave_nothing(
    tmp_path: Path, arguments: tuple[str, ...], words: tuple[str, ...]
) -> None:
    far = "world: atrium\nscript: [forward_m: 20]\n"
    (tmp_path / "far.yaml").write_text(far, encoding="utf-8")
    before = tree(tmp_path)
    done = run("simulate", *arguments, "-o", "out", cwd=tmp_path)
    assert_one_line_failure(done, *words)
    assert tree(tmp_path) == before
