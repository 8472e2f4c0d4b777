"""A fork of the loaded command is a process like one that is started."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.cli.command import SAMPLE, run, server

pytestmark = pytest.mark.once


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (("--version",), 0),
        (("evaluate", SAMPLE / "map_a.yaml"), 2),
        (("align", "absent.yaml", "absent.yaml"), 1),
        (("graph", "optimize", "bad.g2o", "--json"), 1),
    ],
)
def test_a_fork_says_and_ends_as_a_start_does(
    tmp_path: Path, arguments: tuple[str, ...], code: int
) -> None:
    (tmp_path / "bad.g2o").write_text("no graph\n", encoding="utf-8")
    forked, started = (run(*arguments, cwd=tmp_path, is_anew=anew) for anew in (False, True))
    assert forked.returncode == code
    assert vars(forked) == vars(started)


def test_what_is_read_while_a_library_loads_is_no_fork(monkeypatch: pytest.MonkeyPatch) -> None:
    assert server().can_start({**os.environ, "ROS_DOMAIN_ID": "7"})
    assert not server().can_start({**os.environ, "OMP_NUM_THREADS": "17"})
    monkeypatch.setenv("PYTHONPATH", "elsewhere")
    assert not server().can_start(os.environ)
