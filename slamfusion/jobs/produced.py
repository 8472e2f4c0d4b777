"""What a producer's run is measured, shown and written as; shared by ``slam`` and ``run``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from slamfusion.config import RunConfig
from slamfusion.io import AtomicFiles, save_map, write_tum
from slamfusion.jobs.documents import number, record_bytes
from slamfusion.jobs.outputs import PROBABILITY, output_files
from slamfusion.jobs.records import Evaluation
from slamfusion.jobs.run_records import ProducerJson
from slamfusion.jobs.trajectory import Measures, Yardsticks
from slamfusion.slam.common.runner import ProducerRun, skipped_scans


@dataclass(frozen=True)
class ProducerResult:
    """A run and everything that was measured of it.

    Attributes:
        run: what the producer made.
        measures: errors of its path.
        evaluation: errors of its map; None without a true map.
        device: what it computed on, in words.
    """

    run: ProducerRun
    measures: Measures
    evaluation: Evaluation | None
    device: str

    def to_json(self, files: Sequence[Path]) -> ProducerJson:
        """Return the run's record with its errors and files."""
        return {
            **self.run.to_json(),
            **self.measures.to_json(),
            "map_error": self.evaluation,
            "files": [str(path) for path in files],
        }

    def figures(self) -> list[tuple[str, str]]:
        """Return the run's numbers with their names."""
        run = self.run
        time_ms, health = run.time_per_scan_ms(), run.health
        stamps_s = run.trajectory.stamps_s
        fed = len(run.feed_s)
        return [
            ("scans", f"{run.scans}, {run.scans_used} of them used"),
            *([("scans fed in this run", f"{fed}")] if fed != run.scans else []),
            ("duration of the drive", f"{number(float(stamps_s[-1] - stamps_s[0]), 1)} s"),
            ("path length", f"{number(run.trajectory.path_length_m(), 1)} m"),
            (
                "path length by odometry",
                "no odometry"
                if run.odometry is None
                else f"{number(run.odometry.path_length_m(), 1)} m",
            ),
            (
                "time per scan",
                (
                    f"mean {number(time_ms['mean'], 2)} ms, median {number(time_ms['p50'], 2)} ms, "
                    f"95 % within {number(time_ms['p95'], 2)} ms, "
                    f"99.9 % within {number(time_ms['p999'], 2)} ms, "
                    f"longest {number(time_ms['max'], 2)} ms"
                ),
            ),
            ("time in all", f"{number(run.time_s, 1)} s, reading included"),
            (
                "peak memory",
                (
                    f"{number(run.peak_memory_bytes / 1e6, 1)} MB map and filter, "
                    f"{number(run.process_peak_memory_bytes / 1e6, 0)} MB whole process"
                ),
            ),
            (
                "match score",
                (
                    f"mean {number(health.mean_match_score)}, last {number(health.match_score)}, "
                    f"{health.low_scores} below half of the mean, {run.low_in_a_row} of them "
                    "in a row"
                ),
            ),
            *(
                [("effective particles", number(health.n_eff, 1))]
                if health.n_eff is not None
                else []
            ),
            (
                "map",
                f"{run.grid.width} x {run.grid.height} cells of {run.grid.resolution:g} m",
            ),
            ("device", self.device),
        ]


def run_remarks(run: ProducerRun) -> list[tuple[str, str]]:
    """Return what was left out, what is odd, and what the log says, each with its place."""
    remarks = [(f"left out by {run.name}", item) for item in skipped_scans(run.health)]
    if run.log is not None:
        remarks += [("left out of the log", item) for item in run.log.skipped.sentences()]
        remarks += [("odd in the log", item) for item in run.log.warnings.sentences()]
        remarks += [("the log", item) for item in run.log.notes]
    return remarks


def measure_run(run: ProducerRun, config: RunConfig, held: Yardsticks) -> Measures:
    """Measure the path, and the one that was first reported where the producer keeps it.

    Args:
        run: what a producer made of a log.
        config: ``trajectory`` is used.
        held: what the path is held against.

    Raises:
        TrajectoryError: the path does not meet the relations, the odometry or the truth.
    """
    online = run.online_path()
    final = held.measure(run.trajectory, config, run.odometry)
    if online is None or (held.relations is None and held.truth is None):
        return final
    return replace(final, online=held.measure(online, config, run.odometry))


def add_run(
    files: AtomicFiles,
    run: ProducerRun,
    document: Mapping[str, Any],
    stem: Path,
    config: RunConfig,
    *,
    probabilities: bool,
) -> None:
    """Stage a run's map, path and record with other files.

    Args:
        files: the set.
        run: what was made.
        document: the record.
        stem: the files' path without their suffixes.
        config: its thresholds of the vote decide what is free and occupied in the map.
        probabilities: also stage the map with its probabilities: value by value, mode raw.
    """
    _, _, tum, record = output_files(stem)
    save_map(run.grid, stem, classes=config.fusion.normalize, files=files)
    if probabilities:
        other = stem.with_name(stem.name + PROBABILITY)
        save_map(run.grid, other, mode="raw", image_format="png", files=files)
    write_tum(tum, run.trajectory, files=files)
    files.add(record, record_bytes(document))
