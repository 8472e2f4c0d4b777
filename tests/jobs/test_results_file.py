"""Saved results: what is in the file, and files that are none."""

from __future__ import annotations

import hashlib
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slamfusion.evaluation import ErrorSeries, MeasuredItem
from slamfusion.jobs import results_file
from slamfusion.jobs.results_file import (
    InputFile,
    ResultsFileError,
    map_inputs,
    read_results,
    write_results_file,
)
from tests.cli.command import MAPS

ITEMS = [
    MeasuredItem(
        "intel",
        "graph",
        {"ate_rmse_m": 0.1 + 0.2, "rpe_mean_m": 1e-300},
        {
            "ate_m": ErrorSeries(np.array([[1e9 + 0.1], [1e9 + 0.3]]), np.array([0.1, 1 / 3])),
            "relations_m": ErrorSeries(np.array([[0.0, 1.0]]), np.array([0.5])),
        },
    ),
    MeasuredItem("mit", "graph", {"ate_rmse_m": 2.0}),
]


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    """A good file, with a truth of known bytes among its inputs."""
    (tmp_path / "true.tum").write_text("truth\n", encoding="ascii")
    return write(tmp_path / "a.zip", tmp_path / "true.tum")


def write(path: Path, truth: Path) -> Path:
    write_results_file(
        path,
        command="trajectory",
        arguments=("trajectory", "graph.tum", "--truth", "true.tum"),
        document={"config": {"seed": 3}, "ate": float("nan")},
        items=ITEMS,
        inputs=[InputFile("truth", "intel", truth)],
    )
    return path


def changed(path: Path, name: str, change: Callable[[bytes], bytes | None]) -> Path:
    """Return a copy of a file with one entry changed, or left out (None)."""
    other = path.with_name("changed.zip")
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(other, "w") as new:
        for entry in old.namelist():
            data = change(old.read(entry)) if entry == name else old.read(entry)
            if data is not None:
                new.writestr(entry, data)
    return other


def with_json(path: Path, name: str, change: Callable[[Any], object]) -> Path:
    def changed_text(data: bytes) -> bytes:
        document = json.loads(data)
        change(document)
        return json.dumps(document).encode()

    return changed(path, name, changed_text)


def test_what_is_read_is_what_was_measured(saved: Path) -> None:
    found = read_results(saved)
    assert (found.name, found.command) == ("a", "trajectory")
    for own, item in zip(found.items, ITEMS, strict=True):
        assert (own.case, own.method, own.figures) == (item.case, item.method, item.figures)
        assert own.series.keys() == item.series.keys()
        for name, series in item.series.items():
            assert np.array_equal(own.series[name].at, series.at)
            assert np.array_equal(own.series[name].errors, series.errors)
    digest = hashlib.sha256(b"truth\n").hexdigest()
    assert found.yardsticks == {("truth", "intel"): digest}


def test_the_manifest_says_how_it_was_made(saved: Path) -> None:
    with zipfile.ZipFile(saved) as packed:
        manifest = json.loads(packed.read("manifest.json"))
        document = json.loads(packed.read("document.json"))
        times = {entry.date_time for entry in packed.infolist()}
    assert manifest["format"] == "slamfusion-results"
    assert manifest["arguments"] == ["trajectory", "graph.tum", "--truth", "true.tum"]
    assert manifest["settings"] == {"seed": 3}
    (truth,) = manifest["inputs"]
    assert (truth["role"], truth["case"], truth["bytes"]) == ("truth", "intel", 6)
    assert document == {"config": {"seed": 3}, "ate": None}
    assert times == {(1980, 1, 1, 0, 0, 0)}


def test_the_same_results_are_the_same_bytes(saved: Path, tmp_path: Path) -> None:
    again = write(tmp_path / "b.zip", tmp_path / "true.tum")
    assert again.read_bytes() == saved.read_bytes()


def test_of_a_map_both_files_are_told() -> None:
    found = map_inputs("map", "office", [Path(MAPS[0])])
    assert [(item.role, item.path.suffix) for item in found] == [
        ("map", ".yaml"),
        ("map image", ".pgm"),
    ]


def test_a_folder_is_told_file_by_file(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    bag.mkdir()
    for name in ("metadata.yaml", "a.db3"):
        (bag / name).write_text(name, encoding="ascii")
    records = list(results_file._input_records(InputFile("log", "", bag)))
    assert [Path(record["name"]).name for record in records] == ["a.db3", "metadata.yaml"]


NONE = "wanted a zip of --save-results, found a damaged one or none"


def test_no_zip_and_others_zips_are_refused(saved: Path, tmp_path: Path) -> None:
    (tmp_path / "text.zip").write_text("no zip\n", encoding="ascii")
    with pytest.raises(ResultsFileError, match=NONE):
        read_results(tmp_path / "text.zip")
    cut = saved.read_bytes()[:-40]
    (tmp_path / "cut.zip").write_bytes(cut)
    with pytest.raises(ResultsFileError, match=NONE):
        read_results(tmp_path / "cut.zip")
    with pytest.raises(ResultsFileError, match=r"found one without manifest\.json"):
        read_results(changed(saved, "manifest.json", lambda _: None))
    with pytest.raises(ResultsFileError, match=r"found the manifest\.json of another program"):
        read_results(with_json(saved, "manifest.json", lambda item: item.update(format="evo")))
    with pytest.raises(ResultsFileError, match="found a folder"):
        read_results(tmp_path)


def test_flipped_bytes_are_seen(saved: Path, tmp_path: Path) -> None:
    data = bytearray(saved.read_bytes())
    data[len(data) // 3] ^= 0xFF
    (tmp_path / "flipped.zip").write_bytes(data)
    with pytest.raises(ResultsFileError):
        read_results(tmp_path / "flipped.zip")


def test_a_newer_version_says_to_update(saved: Path) -> None:
    newer = with_json(
        saved, "manifest.json", lambda item: item.update(format_version=2, version="9.1")
    )
    with pytest.raises(ResultsFileError, match=r"format 1 or older, found 2, .*'9\.1'; update"):
        read_results(newer)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda own: own["items"][0]["figures"].update(ate_rmse_m="small"), "is 'small', no numb"),
        (lambda own: own["items"][0]["figures"].update(ate_rmse_m=float("nan")), "is nan, no numb"),
        (lambda own: own["items"][0]["figures"].update(ate_rmse_m=10**400), "damaged"),
        (lambda own: own["items"][0].pop("case"), "wanted a text 'case'"),
        (lambda own: own["items"][1].update(case="intel"), "two items are of one case"),
        (lambda own: own["items"][0]["series"].update(ate_m="../x"), "a series lies in"),
        (lambda own: own["items"][0]["series"].update(ate_m="series/9.csv"), "is missing|damaged"),
        (lambda own: own.update(items={}), "wanted a list 'items'"),
    ],
)
def test_damaged_items_are_one_line(
    saved: Path, change: Callable[[Any], object], words: str
) -> None:
    with pytest.raises(ResultsFileError, match=words) as found:
        read_results(with_json(saved, "items.json", change))
    assert len(str(found.value).splitlines()) == 1


@pytest.mark.parametrize("text", [b"", b"at,error\n", b"at,error\n1,x\n", b"at,error\n1,nan\n"])
def test_damaged_series_are_one_line(saved: Path, text: bytes) -> None:
    with pytest.raises(
        ResultsFileError, match=r"items\.json is damaged: series/0001\.csv"
    ) as found:
        read_results(changed(saved, "series/0001.csv", lambda _: text))
    assert len(str(found.value).splitlines()) == 1


@pytest.mark.parametrize("text", [b"{", b"[" * 100_000, b"\xff\xfe\x00", b"[]", b"3"])
def test_a_damaged_manifest_is_one_line(saved: Path, text: bytes) -> None:
    with pytest.raises(ResultsFileError) as found:
        read_results(changed(saved, "manifest.json", lambda _: text))
    assert len(str(found.value).splitlines()) == 1


def test_a_bomb_is_refused_before_it_is_unpacked(saved: Path, tmp_path: Path) -> None:
    bomb = tmp_path / "bomb.zip"
    bomb.write_bytes(saved.read_bytes())
    with zipfile.ZipFile(bomb, "a", zipfile.ZIP_DEFLATED) as packed:
        for name in range(5):
            packed.writestr(f"series/{name}.txt", b"0" * 2**20)
    with zipfile.ZipFile(bomb) as packed:
        entries = packed.infolist()
    most = sum(entry.file_size for entry in entries) - 1
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(results_file, "MOST_BYTES", most)
        with pytest.raises(ResultsFileError, match=r"more than the .* that saved results may have"):
            read_results(bomb)
