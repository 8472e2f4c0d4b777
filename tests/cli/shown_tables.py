"""Every table that commands print, of values written out here; see ``test_tables``.

``python -m tests.cli.shown_tables`` writes what they look like anew, to be looked at.
"""

from __future__ import annotations

import contextlib
import io
import os
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np

from slamfusion.cli import (
    compare,
    devices,
    doctor,
    evaluate,
    fused,
    judge,
    output,
    run,
)
from slamfusion.cli import results as result_tables
from slamfusion.cli import trajectory as trajectories
from slamfusion.compute.records import DeviceInfo
from slamfusion.config import NormalizeConfig
from slamfusion.evaluation import Row, compare_to_truth, error_series, result_rows
from slamfusion.evaluation.statistics import ErrorStatistics
from slamfusion.evidence.parting import Span
from slamfusion.evidence.recommendation import RankedPath, Recommendation
from slamfusion.experiments.page import Experiment
from slamfusion.jobs.compare import compare_results
from slamfusion.jobs.evaluate import Evaluation
from slamfusion.jobs.results import write_results_file
from tests.report.drawn import alignment, fusion, room

FOLDER = Path(__file__).parent
WIDTHS = (80, 200)


class Terminal(io.StringIO):
    """What a command prints to."""

    def isatty(self) -> bool:
        return True


def shown(print_it: Callable[[], None], width: int | None) -> str:
    """Return what is printed on a terminal of some width; None: into a pipe."""
    stream = io.StringIO() if width is None else Terminal()
    with (
        patch.dict(os.environ, {"COLUMNS": str(width or 0)}),
        contextlib.redirect_stdout(stream),
    ):
        print_it()
    return stream.getvalue()


def _fuse() -> None:
    fused.print_alignments(fusion(rejected_name="the_upper_floor"))


def _nothing_fused() -> None:
    fused.print_pairs([alignment("office", "upper_floor", accepted=False)], "numpy")


def _evaluate() -> None:
    truth = room("truth", 7)
    errors = [
        compare_to_truth(room(name, seed), truth, normalize=NormalizeConfig(), tolerance_m=0.1)
        for seed, name in enumerate(("tinyslam", "gmapping", "fused"))
    ]
    evaluate.print_evaluations(
        [Evaluation(**vars(error), aligned=True, alignment=None) for error in errors]
    )


def _run() -> None:
    made: Any = SimpleNamespace(
        name="gmapping",
        scans=910,
        scans_used=908,
        time_s=12.31,
        time_per_scan_ms=lambda: {"mean": 13.4, "p50": 12.0, "p95": 21.7},
        peak_memory_bytes=81.2e6,
        health=SimpleNamespace(mean_match_score=0.913),
    )
    errors = ErrorStatistics.of([0.02, 0.06])
    measures = SimpleNamespace(
        relations=SimpleNamespace(translation=errors, rotation_deg=errors),
        truth=SimpleNamespace(ate=errors, ate_rotation_deg=errors),
    )
    outcomes = [
        SimpleNamespace(name="gmapping", reason=""),
        SimpleNamespace(name="tinyslam", reason="the process was killed (SIGKILL) at scan 400"),
    ]
    log: Any = SimpleNamespace(
        results={"gmapping": SimpleNamespace(run=made, measures=measures)},
        saved_paths={},
        outcomes=outcomes,
        files=SimpleNamespace(log="intel.log"),
    )
    run._print_producers(log)


def _judge() -> None:
    away_m = {"fused": None, "graph": 0.0131, "gmapping": 1.27}
    paths = tuple(
        RankedPath(
            name=name,
            consistency=-1.2034 - 0.0132 * index,
            tied=not index,
            behind=0.0132 if index else 0.0,
            behind_95=(0.0041, 0.0212) if index else None,
            p_value=0.004 if index else None,
            from_fused_m=from_m,
            beams_judged=100,
            scans_judged=10,
            seen_share=0.9,
            seen_consistency=-1.2,
            own_poses_share=1.0,
            covered_share=1.0,
            over_time=(),
            spans=(Span(0.0, 30.0, True, 0.02), Span(30.0, 62.5, False, 0.41)) if index else (),
        )
        for index, (name, from_m) in enumerate(away_m.items())
    )
    answer = Recommendation("fused", "fused", "graph", "high", paths=paths)
    judge.print_reasons(answer)


def _trajectory() -> None:
    statistics = ErrorStatistics.of([0.01, 0.02, 0.12])
    kinds = ("relations, translation m", "RPE over 1 frames, rotation deg, as first reported")
    trajectories.print_errors(
        "slam: 910 poses, 412.1 m", [(kind, statistics, 4) for kind in kinds], ["3 of 3 used"]
    )


def _rows(seed: str = "", scale: float = 1.0) -> list[list[Row]]:
    """Return two methods in two places, the rows of each."""
    along = error_series(np.sin(np.arange(40.0)) / 99, np.arange(40.0))
    return [
        result_rows(
            case,
            seed,
            method,
            {
                "ate_rmse_m": scale * error_m,
                "rpe_mean_m": error_m / 7.0,
                "ate_rotation_mean_deg": 0.4 - error_m**2,
            },
            {"ate_m": along + np.array([error_m, 0.0, 0.0])},
        )
        for method, base_m in (("graph", 0.05), ("slam_toolbox", 0.07))
        for case, error_m in (("intel", base_m), ("fr079", 1.3 * base_m))
    ]


def _several() -> None:
    result_tables.print_items([row for rows in _rows() for row in rows], "path", ("ate_rmse_m",))


def _compare() -> None:
    _print_compared([_rows()])


def _compare_seeds() -> None:
    repeated = [_rows(str(seed), 1 + 0.01 * seed**2) for seed in range(3)]
    _print_compared(
        [[rows for run in repeated for rows in run[2 * n : 2 * n + 2]] for n in (0, 1, 1)]
    )


def _print_compared(sets: Sequence[Sequence[Sequence[Row]]]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        files = [Path(folder) / f"{name}.zip" for name in ("graph", "slam_toolbox", "karto")]
        for file, parts in zip(files, sets, strict=False):
            rows = [row for part in parts for row in part]
            write_results_file(file, command="", arguments=(), document={}, rows=rows)
        compare.print_comparison(compare_results(files[: len(sets)]))


def _experiment() -> None:
    methods = ("tinyslam", "gmapping", "graph", "consensus", "majority")
    rows = [
        row
        for lidar in ("rplidar", "hokuyo utm-30lx")
        for number, method in enumerate(methods)
        for seed, spread in (("w1-s0", 1.5), ("w1-s1", -1.5))
        for row in result_rows(
            f"obstacle, {lidar}", seed, method, {"error": 68.11 - 2.25 * number + spread}
        )
    ]
    for title, heads, cells in Experiment("", "", rows, ("error",)).text_tables(details=False):
        output.print_table([f"{heads[0]} ", *heads[1:]], cells, title=title)


DEVICE = DeviceInfo(
    index=0,
    name="cpu-haswell-Intel(R) Xeon(R) Processor @ 2.90GHz",
    platform="Portable Computing Language",
    type="cpu",
    version="OpenCL 2.0 pocl",
    compute_units=2,
    memory_mb=5858,
    usable=True,
    note="one thread; for many small kernels",
)


def _devices() -> None:
    devices.print_devices([DEVICE])


def _doctor(*, passed: bool) -> None:
    test = {"name": "fields", "passed": passed, "detail": "12 of 4096 cells differ"}
    document: Any = {
        "versions": {"python": "3.11.2", "pyopencl": None},
        "devices": [DEVICE],
        "pocl": None,
        "self_test": [test, {"name": "votes", "passed": True, "detail": ""}],
        "device": "numpy",
        "install": {"any CPU": "apt install pocl-opencl-icd"},
    }
    doctor._print(document)


SHOWN: dict[str, Callable[[], None]] = {
    "fuse": _fuse,
    "fuse, nothing": _nothing_fused,
    "evaluate": _evaluate,
    "run": _run,
    "judge": _judge,
    "trajectory": _trajectory,
    "trajectory, several": _several,
    "compare": _compare,
    "compare, seeds": _compare_seeds,
    "experiment": _experiment,
    "devices": _devices,
    "doctor": lambda: _doctor(passed=True),
    "doctor, failed": lambda: _doctor(passed=False),
}


def all_shown(width: int | None) -> str:
    """Return every table."""
    return "\n".join(f"### {name}\n{shown(print_it, width)}" for name, print_it in SHOWN.items())


if __name__ == "__main__":
    for number in WIDTHS:
        (FOLDER / f"tables_{number}.txt").write_text(all_shown(number), encoding="utf-8")
