"""Saved results against each other, as a library."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from slamfusion.errors import SlamFusionError
from slamfusion.evaluation import ErrorSeries, MeasuredItem
from slamfusion.jobs.compare import compare_results, write_comparison_plot
from slamfusion.jobs.documents import plain
from slamfusion.jobs.results_file import InputFile, write_results_file
from slamfusion.jobs.several import CaseFiles
from slamfusion.report import comparison_plot
from tests.support.documents import check_document

CASES = ("intel", "mit", "office", "hall")


def path_item(case: str, method: str, error_m: float) -> MeasuredItem:
    stamps_s = np.arange(120.0)
    errors = error_m * (1.0 + 0.2 * np.sin(stamps_s / 7.0 + error_m))
    return MeasuredItem(
        case,
        method,
        {"ate_rmse_m": float(np.sqrt(np.mean(errors**2)))},
        {"ate_m": ErrorSeries(stamps_s[:, None], errors)},
    )


def save(
    path: Path,
    items: Sequence[MeasuredItem],
    truth: Path,
    command: str = "trajectory",
    inputs: Sequence[InputFile] = (),
) -> Path:
    write_results_file(
        path,
        command=command,
        arguments=(command,),
        document={},
        items=items,
        inputs=inputs or [InputFile("truth", "", truth)],
    )
    return path


@pytest.fixture
def saved(tmp_path: Path) -> list[Path]:
    """Three files of the same cases: the second and third are better, each a bit more."""
    truth = tmp_path / "true.tum"
    truth.write_text("truth", encoding="ascii")
    return [
        save(
            tmp_path / f"{name}.zip",
            [path_item(case, name, error + 0.05 * n) for n, case in enumerate(CASES)],
            truth,
        )
        for name, error in (("old", 0.30), ("new", 0.20), ("best", 0.15))
    ]


def test_two_files_are_compared_case_by_case(saved: list[Path]) -> None:
    found = compare_results(saved[:2])
    (pair,) = found.pairs
    (figure,) = pair.figures
    assert (figure.count_first, figure.better) == (4, 1)
    assert figure.p_value is not None
    assert figure.p_value < 0.01
    assert [item.first.case for item in pair.series] == list(CASES)
    assert all(item.comparison.common == 120 for item in pair.series)
    assert found.sentences() == []
    document = plain(found.to_json())
    check_document(document, "compare")
    assert document["figures"][0]["better"] == "new"


def test_every_two_of_three_are_compared_and_corrected(saved: list[Path]) -> None:
    found = compare_results(saved)
    names = [(pair.first.name, pair.second.name) for pair in found.pairs]
    assert names == [("old", "new"), ("old", "best"), ("new", "best")]
    alone = compare_results(saved[:2]).pairs[0].figures[0].p_value
    together = found.pairs[0].figures[0].p_value
    assert alone is not None
    assert together is not None
    assert together > alone


def test_what_has_no_partner_and_another_truth_are_told(saved: list[Path], tmp_path: Path) -> None:
    other = tmp_path / "other.tum"
    other.write_text("another truth", encoding="ascii")
    items = [path_item("intel", "new", 0.2), path_item("attic", "new", 0.2)]
    few = save(tmp_path / "few.zip", items, other)
    assert compare_results([saved[1], few]).sentences() == [
        "new: not in few: new in mit, new in office, new in hall",
        "few: not in new: new in attic",
        "new and few rest on different files: truth",
    ]
    lone = save(tmp_path / "lone.zip", items[1:], tmp_path / "true.tum")
    (sentence,) = compare_results([saved[1], lone]).sentences()
    assert "no map or path of one case in common" in sentence


@pytest.mark.parametrize("kind", [item.name for item in fields(CaseFiles)])
def test_whatever_paths_were_held_against_is_told_where_it_is_another(
    tmp_path: Path, kind: str
) -> None:
    zips = []
    for name in ("old", "new"):
        file = tmp_path / f"{name}.txt"
        file.write_text(name, encoding="ascii")
        (held,) = CaseFiles(**{kind: {"intel": file}}).inputs([])
        items = [path_item("intel", name, 0.2)]
        zips.append(save(tmp_path / f"{name}.zip", items, file, inputs=[held]))
    (sentence,) = compare_results(zips).sentences()
    assert sentence == f"old and new rest on different files: {held.role} of intel"


def test_what_cannot_be_compared_is_one_line(saved: list[Path], tmp_path: Path) -> None:
    with pytest.raises(SlamFusionError, match="wanted two files"):
        compare_results(saved[:1])
    maps = [MeasuredItem("intel", "old", {"error": 1.0})]
    other = save(tmp_path / "maps.zip", maps, tmp_path / "true.tum", "evaluate")
    with pytest.raises(
        SlamFusionError, match=r"^old is of trajectory, maps of evaluate: .*no figure"
    ):
        compare_results([saved[0], other])
    with pytest.raises(OSError, match=r"absent\.zip"):
        compare_results([saved[0], tmp_path / "absent.zip"])


HEADS = {"png": b"\x89PNG", "svg": b"<?xml", "pdf": b"%PDF"}


@pytest.mark.once
def test_the_plot_is_drawn_alike_each_time_and_names_as_they_are_written(tmp_path: Path) -> None:
    truth = tmp_path / "true.tum"
    truth.write_text("truth", encoding="ascii")
    files = [
        save(tmp_path / f"{name}.zip", [path_item("a$b_{c}$", "x", 0.1)], truth)
        for name in ("$one", "_two$")
    ]
    found = compare_results(files)
    for form, head in HEADS.items():
        plots = [tmp_path / f"{name}.{form}" for name in "ab"]
        for plot in plots[: 2 if form == "svg" else 1]:
            write_comparison_plot(found, plot)
        data = plots[0].read_bytes()
        assert data.startswith(head)
        if form == "svg":
            assert data == plots[1].read_bytes()
    text = (tmp_path / "a.svg").read_text(encoding="utf-8")
    assert all(f">{words}<" in text for words in ("$one", "_two$", "a$b_{c}$", "ATE m"))


def test_figures_are_drawn_for_several_maps(tmp_path: Path) -> None:
    truth = tmp_path / "true.yaml"
    truth.write_text("truth", encoding="ascii")
    files = [
        save(
            tmp_path / f"{name}.zip",
            [MeasuredItem(case, name, {"wall_f1": 0.5 + 0.1 * n}) for n, case in enumerate(CASES)],
            truth,
        )
        for name in ("old", "_new")
    ]
    write_comparison_plot(compare_results(files), tmp_path / "plot.svg")
    text = (tmp_path / "plot.svg").read_text(encoding="utf-8")
    assert all(f">{words}<" in text for words in ("F1", "larger is better", "old", "_new"))


@pytest.mark.parametrize(("worst", "scale"), [(0.2, "linear"), (40.0, "log"), (-40.0, "linear")])
def test_one_large_error_does_not_hide_the_others(worst: float, scale: str) -> None:
    usual = path_item("intel", "x", 0.1).series["ate_m"]
    large = ErrorSeries(np.array([[1.0]]), np.array([worst]))
    assert comparison_plot._scale([usual, large]) == scale
