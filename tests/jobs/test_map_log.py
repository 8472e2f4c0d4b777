"""``map_log`` as a library: one producer on a log, its files, and going on from a state."""

from __future__ import annotations

from pathlib import Path

import pytest

from slamfusion.compute import NumpyDevice
from slamfusion.config import RunConfig
from slamfusion.errors import LogError, SlamFusionError
from slamfusion.io import load_map
from slamfusion.jobs.map_log import map_log, save_mapped_log
from slamfusion.json_values import plain
from slamfusion.slam.registry import with_settings
from tests.cli.command import tree
from tests.support.documents import check_document

DEVICE = NumpyDevice()


@pytest.mark.once
def test_a_log_is_mapped_measured_saved_and_gone_on_with(place: Path, tmp_path: Path) -> None:
    told: list[tuple[str, float, int]] = []
    begun = map_log(
        place / "flat.log", "graph", limit=20, truth=place / "truth.tum",
        relations=place / "flat.relations", progress=lambda *words: told.append(words),
    )  # fmt: skip
    assert begun.failure is not None  # the relation ends after the last scan of these
    assert begun.notices()[0].startswith("stopped after 20 scans, as asked for")
    assert told[0][0] == "graph"
    assert told[-1][1] <= told[-1][2]
    record = save_mapped_log(begun, tmp_path / "begun", state=tmp_path / "state")
    assert list(record.result.files) == [
        tmp_path / f"begun{end}" for end in (".yaml", ".pgm", ".tum", ".json")
    ] + [tmp_path / "state"]

    ended = map_log(
        place / "flat.log", "graph", truth=str(place / "truth.tum"),
        relations=place / "flat.relations", truth_map=tmp_path / "begun.yaml",
        resume=tmp_path / "state",
    )  # fmt: skip
    assert ended.failure is None
    assert ended.result.run.known_scans == 20
    assert len(ended.trajectory) == 32
    saved = save_mapped_log(ended, tmp_path / "end" / "map", report=tmp_path / "report")
    check_document(plain(saved), "slam")
    assert saved.result.measures.truth.ate.rmse < 0.1
    assert saved.result.map_error is not None
    assert (tmp_path / "report" / "report.html").exists()
    assert load_map(tmp_path / "end" / "map.yaml").cells.shape == ended.grid.cells.shape


def test_a_map_without_a_known_cell_is_a_doubt(place: Path) -> None:
    config = with_settings(RunConfig(), "graph", min_pass_through=1000)
    mapped = map_log(place / "flat.log", "graph", config, limit=3)
    assert any("no cell of its map is known" in sentence for sentence in mapped.notices())


def test_what_cannot_be_mapped_is_an_error(place: Path, tmp_path: Path) -> None:
    with pytest.raises(SlamFusionError, match="'nobody' is not one of"):
        map_log(place / "flat.log", "nobody", device=DEVICE)
    (tmp_path / "empty.log").write_text("nothing\n", encoding="utf-8")
    with pytest.raises(LogError, match=r"empty\.log"):
        map_log(tmp_path / "empty.log", "tinyslam", device=DEVICE)


def test_a_state_that_cannot_be_saved_leaves_nothing(place: Path, tmp_path: Path) -> None:
    mapped = map_log(place / "flat.log", "tinyslam", limit=3)
    with pytest.raises(SlamFusionError, match="tinyslam cannot save its state"):
        save_mapped_log(mapped, tmp_path / "map", state=tmp_path / "state")
    assert not tree(tmp_path)
