"""Saved results: what is in the file, files that are none, and results against each other."""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from slamfusion.errors import SlamFusionError
from slamfusion.evaluation.measured import Row, error_series, result_rows
from slamfusion.jobs import results
from slamfusion.jobs.cases import CaseFile, place_files
from slamfusion.jobs.compare import ComparedResults, compare_results, write_comparison_plot
from slamfusion.jobs.results import (
    ResultsFileError,
    map_inputs,
    read_results,
    results_table,
    write_results_file,
)
from slamfusion.json_values import plain
from slamfusion.report.result_plots import running
from tests.cli.command import MAPS
from tests.support.documents import check_document

CASES = ("intel", "mit", "office", "hall")
ROWS = [
    *result_rows(
        "intel",
        "",
        "graph",
        {"ate_rmse_m": 0.1 + 0.2, "rpe_mean_m": 1e-300, "ssim": None},
        {
            "ate_m": error_series(np.array([0.1, 1 / 3]), np.array([1e9 + 0.1, 1e9 + 0.3])),
            "relations_m": error_series(np.array([0.5]), np.zeros(1), np.ones(1)),
        },
    ),
    *result_rows("NA", "07", "graph", {"ate_rmse_m": 2.0}),
]


def item(case: str, method: str, seed: str = "", **figures: float) -> list[Row]:
    return result_rows(case, seed, method, figures)


def path_item(case: str, method: str, error_m: float) -> list[Row]:
    errors = error_m * (1.0 + 0.2 * np.sin(np.arange(120.0) / 7.0 + error_m))
    rmse, series = float(np.sqrt(np.mean(errors**2))), error_series(errors, np.arange(120.0))
    return result_rows(case, "", method, {"ate_rmse_m": rmse}, {"ate_m": series})


def joined(parts: Iterable[Sequence[Row]]) -> list[Row]:
    return [row for part in parts for row in part]


def save(
    path: Path,
    rows: Sequence[Row],
    inputs: Sequence[tuple[str, str, Path]] = (),
    command: str = "trajectory",
) -> Path:
    write_results_file(
        path,
        command=command,
        arguments=(command, "graph.tum"),
        document={"config": {"seed": 3}, "ate": float("nan")},
        rows=rows,
        inputs=inputs,
    )
    return path


def compared(folder: Path, *sets: Sequence[Row]) -> ComparedResults:
    """Return sets of items against each other, in files of the names a, b, ..."""
    return compare_results(
        [save(folder / f"{chr(97 + n)}.zip", rows) for n, rows in enumerate(sets)]
    )


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    """A good file, with a truth of known bytes among its inputs."""
    (tmp_path / "true.tum").write_text("truth\n", encoding="ascii")
    return save(tmp_path / "a.zip", ROWS, [("truth", "intel", tmp_path / "true.tum")])


def changed(path: Path, name: str, change: Callable[[bytes], bytes | None]) -> Path:
    """Return a copy of a file with one entry changed, or left out (None)."""
    other = path.with_name("changed.zip")
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(other, "w") as new:
        for entry in old.namelist():
            data = change(old.read(entry)) if entry == name else old.read(entry)
            if data is not None:
                new.writestr(entry, data)
    return other


def with_manifest(path: Path, **values: object) -> Path:
    return changed(
        path, "manifest.json", lambda data: json.dumps({**json.loads(data), **values}).encode()
    )


def test_what_is_read_is_what_was_measured(saved: Path) -> None:
    found = read_results(saved)
    assert (found.name, found.command) == ("a", "trajectory")
    pd.testing.assert_frame_equal(found.table, results_table(ROWS), rtol=1e-14)
    digest = hashlib.sha256(b"truth\n").hexdigest()
    assert found.yardsticks == {("truth", "intel"): digest}


def test_the_file_says_how_it_was_made_and_is_a_table(saved: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(saved) as packed:
        manifest = json.loads(packed.read("manifest.json"))
        document = json.loads(packed.read("document.json"))
        table = pd.read_csv(io.BytesIO(packed.read("results.csv")))
        times = {entry.date_time for entry in packed.infolist()}
    assert manifest["arguments"] == ["trajectory", "graph.tum"]
    assert manifest["settings"] == {"seed": 3}
    (truth,) = manifest["inputs"]
    assert (truth["role"], truth["case"], truth["bytes"]) == ("truth", "intel", 6)
    assert document == {"config": {"seed": 3}, "ate": None}
    assert list(table.columns) == ["case", "seed", "method", "figure", "value", "at", "to"]
    assert times == {(1980, 1, 1, 0, 0, 0)}
    again = save(tmp_path / "b.zip", ROWS, [("truth", "intel", tmp_path / "true.tum")])
    assert again.read_bytes() == saved.read_bytes()


def test_of_maps_and_folders_every_file_is_told(tmp_path: Path) -> None:
    found = map_inputs("map", "office", [Path(MAPS[0])])
    assert [(role, path.suffix) for role, _, path in found] == [
        ("map", ".yaml"),
        ("map image", ".pgm"),
    ]
    bag = tmp_path / "bag"
    bag.mkdir()
    for name in ("metadata.yaml", "a.db3"):
        (bag / name).write_text(name, encoding="ascii")
    with zipfile.ZipFile(save(tmp_path / "a.zip", ROWS, [("log", "", bag)])) as packed:
        records = json.loads(packed.read("manifest.json"))["inputs"]
    assert [Path(record["name"]).name for record in records] == ["a.db3", "metadata.yaml"]


def test_no_zip_and_others_zips_are_refused(saved: Path, tmp_path: Path) -> None:
    none = "wanted a zip of --save-results, found a damaged one or none"
    data = bytearray(saved.read_bytes())
    data[len(data) // 3] ^= 0xFF
    for name, content, words in (
        ("text", b"no zip\n", none),
        ("cut", data[:-40], none),
        ("flipped", data, "save"),
    ):
        (tmp_path / f"{name}.zip").write_bytes(content)
        with pytest.raises(ResultsFileError, match=words):
            read_results(tmp_path / f"{name}.zip")
    with pytest.raises(ResultsFileError, match=r"no item named 'manifest\.json'"):
        read_results(changed(saved, "manifest.json", lambda _: None))
    with pytest.raises(ResultsFileError, match="that of another program"):
        read_results(with_manifest(saved, format="evo"))
    with pytest.raises(ResultsFileError, match="found a folder"):
        read_results(tmp_path)


def test_older_and_newer_formats_say_what_to_do(saved: Path) -> None:
    with pytest.raises(ResultsFileError, match=r"format 3, found 4, .*'9\.1'; update"):
        read_results(with_manifest(saved, format_version=4, version="9.1"))
    with pytest.raises(ResultsFileError, match=r"format 3, found 2, .*; run its command with"):
        read_results(with_manifest(saved, format_version=2))


def test_a_bomb_is_refused_before_it_is_unpacked(
    saved: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with zipfile.ZipFile(saved) as packed:
        size = sum(entry.file_size for entry in packed.infolist())
    monkeypatch.setattr(results, "MOST_BYTES", size - 1)
    with pytest.raises(ResultsFileError, match="unpacks to more than"):
        read_results(saved)


def repeated(method: str, gain: float = 0.0, seeds: Sequence[int] = (0, 1, 2)) -> list[Row]:
    """Three cases of three seeds: errors of 1, 2, 3 and a hundredth a seed, less a gain a seed."""
    placed = place_files(
        ["intel", "mit", "hall"],
        [
            CaseFile(Path(f"{method}/seed{seed}/{case}.tum"))
            for case in ("intel", "mit", "hall")
            for seed in seeds
        ],
    )
    return joined(
        item(
            own.case,
            own.method,
            own.seed,
            ate_rmse_m=1.0 + n // len(seeds) + 0.01 * int(own.seed) - gain * (1 + n % len(seeds)),
        )
        for n, own in enumerate(placed)
    )


def test_seeds_are_repetitions_of_a_case_and_pairs_of_the_same_seed(tmp_path: Path) -> None:
    found = compared(tmp_path, repeated("graph"), repeated("gmapping", gain=0.1))
    assert found.pairings == ["9 pairs of the same case and seed, in 3 cases"]
    (figure,) = found.figures
    # By hand: errors 1, 1.01, 1.02, 2, ...; 0.1, 0.2, 0.3 less of the second in each case.
    assert (figure.mean_first, figure.mean_second) == pytest.approx((2.01, 1.81))
    values = np.array([case + seed / 100 for case in (1, 2, 3) for seed in (0, 1, 2)])
    assert figure.std_first == pytest.approx(np.sqrt(np.sum((values - 2.01) ** 2) / 8))
    assert (figure.count_first, figure.difference) == (9, pytest.approx(0.2))
    # Differences 0.1, 0.2, 0.3 three times: deviation 0.1 sqrt(6 / 8), t = 0.2 / (that / 3) = 6.93,
    # for which the t distribution of 8 degrees of freedom has 0.000121 on both sides together.
    assert figure.p_t == pytest.approx(0.000121, abs=1e-6)
    # All nine of one sign: two of 2^9 outcomes are as extreme.
    assert figure.p_rank == pytest.approx(2 / 512)
    assert (figure.better, found.notes) == ("b", [])
    check_document(plain(found), "compare")


def test_other_seeds_are_compared_by_the_means_of_each_case(tmp_path: Path) -> None:
    found = compared(tmp_path, repeated("graph"), repeated("graph", 0.1, seeds=(3, 4)))
    assert found.pairings[0] == (
        "3 pairs of the same case and method; no seed is in both, so the means over the seeds are "
        "the pairs"
    )
    (figure,) = found.figures
    assert (figure.count_first, figure.mean_first) == (3, pytest.approx(2.01))
    assert figure.mean_second == pytest.approx(2.035 - 0.15)


def test_methods_of_one_file_are_compared_with_each_other(tmp_path: Path) -> None:
    both = [*repeated("graph"), *repeated("gmapping", 0.1)]
    file = save(tmp_path / "all.zip", [*both, *item("intel", "drawn", "0", wall_f1=1.0)])
    other = save(tmp_path / "other.zip", repeated("karto", 0.05))
    one, two = compare_results([file]), compare_results([file, other])
    assert [result.name for result in one.results] == ["graph", "gmapping", "drawn"]
    assert [own.figure for own in one.figures] == ["ate_rmse_m"]
    assert one.notes[0] == ("graph (trajectory) and drawn (trajectory) have no figure in common")
    apart = compared(tmp_path, repeated("graph"), repeated("gmapping", 0.1))
    assert one.figures[0].p_t == apart.figures[0].p_t
    assert [result.name for result in two.results] == ["graph", "gmapping", "drawn", "other"]
    with pytest.raises(SlamFusionError, match=r"one with several methods of a case, found .*other"):
        compare_results([other])


def test_two_files_are_compared_case_by_case(tmp_path: Path) -> None:
    old = joined(path_item(case, "old", 0.3 + 0.05 * n) for n, case in enumerate(CASES))
    new, best = (
        joined(path_item(case, "new", error + 0.05 * n) for n, case in enumerate(CASES))
        for error in (0.2, 0.15)
    )
    found = compared(tmp_path, old, new)
    (figure,) = found.figures
    assert (figure.count_first, figure.better) == (4, "b")
    assert figure.p_t < 0.01
    few = "4 pairs: too few for Wilcoxon's test, whose p cannot be below 0.12; add cases or seeds"
    assert found.notes == [few]
    check_document(plain(found), "compare")
    together = compared(tmp_path, old, new, best)
    names = [sentence.partition(":")[0] for sentence in together.pairings]
    assert names == ["a and b", "a and c", "b and c"]
    first = together.figures[0]
    assert first.p_t == figure.p_t
    assert first.p_holm > figure.p_t
    # The interval is corrected as the p-value is.
    assert first.low < figure.low


def test_an_interval_holds_no_zero_if_the_corrected_p_value_is_small(tmp_path: Path) -> None:
    """The first two differ with p = 0.04, which is too much for three comparisons."""
    gains = np.array([0.2, 0.05, 0.16, 0.0, 0.12])
    rows = [
        joined(item(str(n), name, error=1.0 - share * gain) for n, gain in enumerate(gains))
        for name, share in (("x", 0.0), ("y", 1.0), ("z", 1.001))
    ]
    two = compared(tmp_path, *rows[:2]).figures[0]
    three = compared(tmp_path, *rows).figures[0]
    for figure, is_significant in ((two, True), (three, False)):
        assert (figure.p_holm < 0.05) == is_significant == (figure.low > 0.0)


def test_samples_that_are_too_few_for_ranks_are_named(tmp_path: Path) -> None:
    rows = [joined(item(f"{name}{n}", name, error=n + 1.0) for n in range(3)) for name in "xy"]
    (note,) = compared(tmp_path, *rows).notes
    assert note.startswith("3 and 3 results: too few for Mann and Whitney's test")


def test_pairs_show_what_samples_hide(tmp_path: Path) -> None:
    values = [1.0, 5.0, 9.0, 2.0, 7.0]
    gains = [0.1, 0.12, 0.09, 0.11, 0.1]
    first = joined(item(str(n), "x", error=value) for n, value in enumerate(values))
    others = reversed(list(enumerate(zip(values, gains, strict=True))))
    second = joined(item(str(n), "y", error=value - gain) for n, (value, gain) in others)
    (found,) = compared(tmp_path, first, second).figures
    assert found.difference == pytest.approx(np.mean(gains))
    assert found.p_t == pytest.approx(stats.ttest_1samp(gains, 0.0).pvalue)
    assert found.better == "b"
    apart = compared(tmp_path, first, [(f"other {case}", *rest) for case, *rest in second])
    assert np.isnan(apart.figures[0].low)
    assert apart.figures[0].p_t == pytest.approx(
        stats.ttest_ind(values, np.subtract(values, gains), equal_var=False).pvalue
    )
    assert apart.figures[0].better is None
    sentence = "no case in common; figures are compared as two samples"
    assert apart.pairings == [sentence]


def test_rows_without_a_partner_and_another_truth_are_told(tmp_path: Path) -> None:
    inputs = {}
    for name in ("one", "other"):
        (tmp_path / name).write_text(name, encoding="ascii")
        inputs[name] = [("truth", "", tmp_path / name)]
    all_items = joined(path_item(case, "new", 0.2) for case in CASES)
    some = [*path_item("intel", "new", 0.2), *item("attic", "new", "3", ate_rmse_m=1.0)]
    new = save(tmp_path / "new.zip", all_items, inputs["one"])
    few = save(tmp_path / "few.zip", some, inputs["other"])
    assert compare_results([new, few]).notes == [
        "new: not in few: new in mit, new in office, new in hall",
        "few: not in new: new in attic seed 3",
        "new and few rest on different files: truth",
        "1 pair: too few for Wilcoxon's test, whose p cannot be below 1; add cases or seeds",
    ]


@pytest.mark.parametrize(
    ("figure", "better"), [("wall_f1", "a"), ("error", "b"), ("seen_share", None)]
)
def test_some_figures_are_better_when_they_are_larger(
    tmp_path: Path, figure: str, better: str | None
) -> None:
    first = joined(item(str(n), "x", **{figure: 2.0 + 0.01 * n}) for n in range(4))
    second = joined(item(str(n), "x", **{figure: 1.0 + 0.02 * n}) for n in range(4))
    (found,) = compared(tmp_path, first, second).figures
    assert found.better == better


HEADS = {"png": b"\x89PNG", "svg": b"<?xml", "pdf": b"%PDF"}


@pytest.mark.once
def test_the_plot_is_drawn_alike_each_time_and_names_as_they_are_written(tmp_path: Path) -> None:
    names = ("$one", "_two$")
    item_of = path_item("a$b_{c}$", "x", 0.1)
    found = compare_results([save(tmp_path / f"{name}.zip", item_of) for name in names])
    for form, head in HEADS.items():
        plots = [tmp_path / f"{name}.{form}" for name in "ab"]
        for plot in plots[: 2 if form == "svg" else 1]:
            write_comparison_plot(found, plot)
        data = plots[0].read_bytes()
        assert data.startswith(head)
        if form == "svg":
            assert data == plots[1].read_bytes()
    text = (tmp_path / "a.svg").read_text(encoding="utf-8")
    assert all(f">{words}<" in text for words in ("$one", "_two$", "a$b_{c}$", "ATE [m]"))


def test_one_large_error_does_not_move_the_running_median() -> None:
    at, values = np.arange(100.0), np.full(100, 0.1)
    values[37] = 40.0
    middles, (low, median, high) = running(at, values)
    assert list(middles[:2]) == [2.0, 7.0]  # windows of five errors
    assert (low == 0.1).all()
    assert (median == 0.1).all()
    assert np.flatnonzero(high > 0.1).tolist() == [7]
