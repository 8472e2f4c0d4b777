"""The page of an experiment: means by hand, the best input, tests by pairs, and what is written."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from slamfusion.config import RunConfig
from slamfusion.evaluation.measured import Row, result_rows
from slamfusion.experiments.fusions import CHOICE, FUSED_PATH, FUSIONS, HINDSIGHT, alone, drawn_at
from slamfusion.experiments.page import Experiment
from slamfusion.experiments.runs import RunResult
from slamfusion.experiments.trials import fusion_experiment
from slamfusion.jobs.inputs import RUN_VOTE
from slamfusion.jobs.outputs import DRAWN
from slamfusion.json_values import plain
from slamfusion.slam.registry import BUILT_IN
from tests.support.documents import check_document


def trial(case: str, seed: int, errors: dict[str, float], **notes: str) -> tuple[str, RunResult]:
    """Return a trial whose maps have errors of 100, but for those given."""
    full = dict.fromkeys((*BUILT_IN, *FUSIONS), 100.0) | errors
    rows = [row for name, error in full.items() for row in of(case, seed, name, error=error)]
    return case, RunResult(rows, notes)


def of(case: str, seed: int, method: str, **figures: float) -> list[Row]:
    return result_rows(case, str(seed), method, figures)


def drawn(gain: float, count: int = 12) -> Experiment:
    """The graph is the best input at 90 on the mean; the plain vote is better by ``gain``."""
    rng = np.random.default_rng(0)
    results = []
    for seed in range(count):
        hard = float(rng.normal(0.0, 8.0))
        fused = 90.0 + hard - gain + float(rng.normal(0.0, 0.5))
        results.append(trial("hall", seed, {"graph": 90.0 + hard, "majority": fused}))
    return fusion_experiment("t", "drawn", results)


def compared_in(experiment: Experiment, figure: str) -> dict[tuple[str, str], pd.Series]:
    """Return the tests of a figure by both methods."""
    rows = experiment.comparisons[experiment.comparisons["figure"] == figure]
    return {(row["first"], row["second"]): row for _, row in rows.iterrows()}


def test_the_best_input_has_the_smallest_mean_not_the_smallest_error() -> None:
    results = [
        trial("hall", 0, {"tinyslam": 10.0, "gmapping": 50.0}),
        trial("hall", 1, {"tinyslam": 99.0, "gmapping": 50.0}),
    ]
    against = fusion_experiment("t", "t", results).against_best
    assert {(item.best_input, item.best_error) for item in against} == {("gmapping", 50.0)}


def test_a_clear_gain_is_found_by_pairs_and_not_without() -> None:
    experiment = drawn(3.0)
    test = compared_in(experiment, "error")["graph", "majority"]
    runs = experiment.table.pivot_table(index="seed", columns="method", values="value")
    a, b = runs["graph"], runs["majority"]
    assert test["p_pooled"] == pytest.approx(stats.ttest_ind(a, b).pvalue)
    assert test["p_pooled"] > 0.2
    assert stats.ttest_rel(a, b).pvalue <= test["p_t"] < 1e-3
    against = experiment.against_best[FUSIONS.index("majority")]
    assert (against.best_input, against.fusion) == ("graph", "majority")
    gains = b - a
    margin = stats.t.ppf(0.975, 11) * gains.std() / np.sqrt(12)
    ends = 1.0 + np.array([gains.mean() - margin, gains.mean() + margin]) / a.mean()
    assert (against.low, against.high) == pytest.approx(tuple(ends))
    assert against.ratio == pytest.approx(b.mean() / a.mean())
    sentence = experiment.sentences()[FUSIONS.index("majority")]
    assert "against graph, the best input (95 % interval -" in sentence
    assert "chance" not in sentence
    assert "may be chance" in drawn(0.0).sentences()[FUSIONS.index("majority")]


def test_overall_counts_each_case_once_and_tells_the_worst() -> None:
    experiment = fusion_experiment(
        "t",
        "t",
        [
            trial("a", 0, {"graph": 50.0, "majority": 60.0}),
            trial("b", 0, {"graph": 90.0, "majority": 45.0}),
        ],
    )
    overall = experiment.overall()["majority"]
    assert overall.ratio == pytest.approx(0.5 * (1.2 + 0.5))
    assert overall.of_sums == pytest.approx(105.0 / 140.0)
    assert overall.worst == pytest.approx(1.2)
    assert experiment.sentences()[-1] == (
        "all cases: majority -15.0 % against the best inputs on the mean of cases (-25.0 % of the "
        "sums), +20.0 % in the worst case."
    )


def test_a_harmed_producer_is_compared_with_the_others_alone() -> None:
    others = {alone(fusion): 80.0 for fusion in FUSIONS}
    results = [trial("a", 0, {}), trial("b", 0, {"consensus": 84.0, **others})]
    experiment = fusion_experiment("t", "t", results)
    assert "b: consensus +5.0 % against fusing the others alone." in experiment.remarks
    assert len(experiment.remarks) == len(FUSIONS)


def test_what_was_left_out_is_counted_with_its_reason() -> None:
    results = [trial("a", seed, {}) for seed in (1, 2)]
    results.insert(0, trial("a", 0, {}, majority="no two agree"))
    title, _, rows = fusion_experiment("t", "t", results).text_tables(details=False)[-1]
    assert title == "What was left out"
    assert rows == [["a", "majority", "1", "no two agree"]]


def test_the_fused_path_and_the_drawn_map_are_tested_against_each_and_the_best() -> None:
    """Paths of 0.06 m that the graph's beats in half of the drives; the fused one by 0.03 m."""
    rng = np.random.default_rng(3)
    results, least, fused = [], [], []
    for seed in range(10):
        hard = 0.06 + 0.02 * float(rng.random())
        ate = {"tinyslam": hard, "gmapping": hard + 0.01, "graph": hard + 0.01 * (-1) ** seed}
        least.append(min(ate.values()))
        fused.append(hard - 0.03 + 0.001 * float(rng.normal()))
        ate |= {FUSED_PATH: fused[-1], HINDSIGHT: least[-1]}
        if seed % 3:
            ate[CHOICE] = ate["graph"]
        faces = {name: 1.0 - value for name, value in ate.items() if name in BUILT_IN}
        faces |= {drawn_at(name): value for name, value in faces.items()}
        faces |= {RUN_VOTE: 0.8, DRAWN: 0.95}
        case, result = trial("hall", seed, {DRAWN: 90.0})
        rows = [row for name, own in ate.items() for row in of(case, seed, name, ate_rmse_m=own)]
        rows += [row for name, own in faces.items() for row in of(case, seed, name, faces_f1=own)]
        results.append((case, RunResult([*result.rows, *rows])))
    experiment = fusion_experiment("t", "t", results, draws=True)
    paths = compared_in(experiment, "ate_rmse_m")
    assert {second for _, second in paths} == {*BUILT_IN, CHOICE, HINDSIGHT}
    best = paths[FUSED_PATH, HINDSIGHT]
    assert best["difference"] == pytest.approx(np.mean(fused) - np.mean(least))
    # Five tests at once: Holm gives the surest at most five times its own.
    own_p = stats.ttest_rel(fused, least).pvalue
    assert own_p <= best["p_t"] <= 5.0 * own_p + 1e-15
    # Where the scans cannot tell there is no choice.
    assert paths[FUSED_PATH, CHOICE]["count_first"] == 6
    faces_tests = compared_in(experiment, "faces_f1")
    assert {first for first, _ in faces_tests} == {DRAWN}
    assert {RUN_VOTE, *map(drawn_at, BUILT_IN)} < {second for _, second in faces_tests}


def repeated(cases: Sequence[str] = ("hall", "yard")) -> Experiment:
    """Errors that the new method halves, of three seeds; the yard has no relations."""
    rows: list[Row] = []
    for case in cases:
        for method, share in (("old", 1.0), ("new", 0.5)):
            for seed in (1, 2, 3):
                error = share + 0.01 * seed
                rows += of(case, seed, method, ate_rmse_m=error)
                rows += of(case, seed, method, relations_mean_m=error) if case == "hall" else []
    figures = ("relations_mean_m", "ate_rmse_m")
    pairs = dict.fromkeys(figures, (("old", "new"),))
    return Experiment("stem", "A title", rows, figures, pairs, is_paired=False)


def test_repeated_runs_are_summed_up_by_hand() -> None:
    experiment = repeated()
    summary = experiment.summaries.loc["hall", "ate_rmse_m", "old"]
    assert list(summary[["count", "mean", "median", "max"]]) == pytest.approx([3, 1.02, 1.02, 1.03])
    assert summary["std"] == pytest.approx(0.01)
    margin = stats.t.ppf(0.975, 2) * 0.01 / np.sqrt(3)
    assert summary["high"] - summary["mean"] == pytest.approx(margin)
    tests = experiment.comparisons
    assert list(tests["case"] + " " + tests["figure"]) == [
        "hall relations_mean_m", "hall ate_rmse_m", "yard ate_rmse_m"
    ]  # fmt: skip
    a, b = (np.array([share + 0.01 * seed for seed in (1, 2, 3)]) for share in (1.0, 0.5))
    welch = stats.ttest_ind(a, b, equal_var=False).pvalue
    assert list(tests["p_t"]) == pytest.approx([welch] * 3)
    assert list(tests["p_rank"]) == pytest.approx([0.1] * 3)  # 2 of 20 orders
    titles = [title for title, *_ in experiment.text_tables(details=False)]
    assert titles == ["relations mean [m], mean ± deviation", "ATE rmse [m], mean ± deviation"]
    _, heads, rows = experiment.text_tables(details=False)[1]
    assert list(heads) == ["case", "runs", "old", "new"]
    assert rows[1] == ["yard", "3", "1.0200 ± 0.0100", "0.5200 ± 0.0100"]


def test_single_runs_have_a_table_a_case() -> None:
    rows = [*of("intel", 0, "graph", error=1.0, wall_f1=0.5), *of("intel", 0, "vote", error=2.0)]
    experiment = Experiment("t", "t", rows, ("error", "wall_f1"))
    assert experiment.text_tables(details=True) == [
        ("intel", ("map", "error", "F1"), [["graph", "1.00", "0.500"], ["vote", "2.00", "-"]])
    ]


def test_files_hold_every_result_and_the_tables(tmp_path: Path) -> None:
    experiment = drawn(3.0)
    files = experiment.write(tmp_path / "out", ("svg",))
    assert [path.name for path in files] == ["t.csv", "t.md", "t.png", "t.svg"]
    table = pd.read_csv(files[0])
    assert list(table.columns) == ["case", "seed", "method", "figure", "value"]
    assert len(table) == 12 * len((*BUILT_IN, *FUSIONS))
    text = files[1].read_text(encoding="utf-8")
    for words in ("## error, mean ± deviation", "p pooled t [F16]", "## In words", "(t.png)"):
        assert words in text
    assert files[2].read_bytes().startswith(b"\x89PNG")
    again = experiment.write(tmp_path / "again", ("svg",))
    assert [path.read_bytes() for path in files] == [path.read_bytes() for path in again]
    document = plain(experiment.document(files, RunConfig(), "numpy"))
    check_document(document, "experiment failures")
    assert len(document["comparisons"]) == 10
