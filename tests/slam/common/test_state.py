"""A state comes back whole and only where it belongs; anything else is refused by name."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from slamfusion.config import MatcherConfig
from slamfusion.errors import SlamFusionError
from slamfusion.geometry import Pose2
from slamfusion.slam.common.mapper import Health
from slamfusion.slam.common.state import SavedMapper


@dataclass(frozen=True)
class Config:
    """Settings of a producer that is none."""

    reach_m: float = 8.0
    matcher: MatcherConfig = field(default_factory=MatcherConfig)


@dataclass(frozen=True, eq=False)
class Row:
    cells: npt.NDArray[np.int8]
    pose: Pose2 | None


class Drawn(SavedMapper):
    """A producer that is none, with a value of each kind that states are made of."""

    name = "drawn"
    STATE_FORMAT = 3
    STATE_KINDS = (Row, Health)
    STATE = ("health", "rng", "poses", "rows", "begun", "pairs", "step", "stamp_s")

    def __init__(self, config: Config, device: Any = None, seed: int = 5) -> None:
        del device
        self._config, self._seed = config, seed
        self.health = Health()
        self.rng = np.random.default_rng(seed)
        self.poses = np.zeros((0, 3))
        self.rows: list[Row] = []
        self.begun: dict[tuple[int, int], Pose2] = {}
        self.pairs: list[tuple[float, int]] = []
        self.step = Pose2()
        self.stamp_s: float | None = None


def drawn() -> Drawn:
    made = Drawn(Config())
    made.health.skips.add("no hits", 3)
    made.rng.normal(size=3)
    made.poses = np.array([[0.1, math.pi, -1e-300]])
    made.rows = [
        Row(np.arange(12, dtype=np.int8).reshape(3, 4), Pose2(1.0 / 3.0, -2.0, 3.1)),
        Row(np.zeros((0, 2), dtype=np.int8), None),
    ]
    made.begun = {(1, 2): Pose2(0.1)}
    made.pairs = [(0.1 + 0.2, 4)]
    made.stamp_s = 9.5
    return made


def assert_whole(path: Path) -> None:
    made, again = drawn(), Drawn.load_state(path, Config(), None, 5)
    assert again.health == made.health
    assert again.rng.random() == made.rng.random()
    assert (again.poses.dtype, again.poses.tobytes()) == (np.float64, made.poses.tobytes())
    assert [(row.cells.tolist(), row.pose) for row in again.rows] == [
        (row.cells.tolist(), row.pose) for row in made.rows
    ]
    assert again.rows[1].cells.shape == (0, 2)
    assert (again.begun, again.step, again.stamp_s) == (made.begun, made.step, made.stamp_s)
    assert again.pairs == [[0.1 + 0.2, 4]]


# -- files -----------------------------------------------------------------------------------------


@pytest.fixture
def path(tmp_path: Path) -> Path:
    drawn().save_state(tmp_path / "drawn.state")
    return tmp_path / "drawn.state"


def refused(path: Path, config: Any = None, seed: int = 5, kind: type[Drawn] = Drawn) -> str:
    with pytest.raises(SlamFusionError) as caught:
        kind.load_state(path, config or Config(), None, seed)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    return message.removeprefix(f"{path}: ")


def test_a_state_comes_back_whole(path: Path) -> None:
    assert_whole(path)


class Other(Drawn):
    name = "other"


class Newer(Drawn):
    STATE_FORMAT = 4


@pytest.mark.parametrize(
    ("others", "words"),
    [
        ({"kind": Other}, "wanted a state of other, format 3, found drawn, format 3; make it"),
        ({"kind": Newer}, "wanted a state of drawn, format 4, found drawn, format 3; make it"),
        ({"seed": 6}, "was made with seed = 5, found 6; resume with the same settings"),
        ({"config": Config(8.001)}, "was made with reach_m = 8.0, found 8.001; resume with"),
        (
            {"config": Config(matcher=MatcherConfig(beams=121))},
            "was made with matcher.beams = 120, found 121; resume with the same settings",
        ),
        ({"config": MatcherConfig()}, "was made with reach_m = 8.0, found None; resume with"),
    ],
)
def test_a_state_of_another_owner_is_refused_by_what_differs(
    path: Path, others: dict[str, Any], words: str
) -> None:
    assert refused(path, **others).startswith(words)


@pytest.mark.parametrize("kept", [0, 1, 100, -1])
def test_a_state_that_was_cut_short_is_refused(path: Path, kept: int) -> None:
    path.write_bytes(path.read_bytes()[:kept])
    assert refused(path) == "not a whole state that `--save-state` has written"


def test_what_is_no_state_is_refused(path: Path, tmp_path: Path) -> None:
    assert refused(tmp_path / "none") == "cannot be read (No such file or directory)"
    path.write_bytes(b"free_thresh: 0.25\n")
    assert "not a whole state" in refused(path)
    np.savez(path.open("wb"), cells=np.zeros(3))
    assert "not a whole state" in refused(path)
    for record in ({}, {"name": "drawn"}, [3]):
        text = np.frombuffer(json.dumps(record).encode(), dtype=np.uint8)
        np.savez(path.open("wb"), record=text)
        assert "not a whole state" in refused(path)


def test_a_state_that_cannot_be_written_leaves_the_one_before(path: Path) -> None:
    broken = drawn()
    broken.pairs = [object()]  # type: ignore[list-item]
    with pytest.raises(TypeError):
        broken.save_state(path)
    assert_whole(path)
    assert [item.name for item in path.parent.iterdir()] == [path.name]
