"""How far a trajectory is from known relations, and from the truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import zip_longest
from pathlib import Path

from slamfusion.config import RunConfig
from slamfusion.errors import SlamFusionError, error_text
from slamfusion.evaluation.measured import GroundTruth, MeasuredPath, Row, rankings, result_rows
from slamfusion.grid import OccupancyGrid
from slamfusion.io import read_trajectory
from slamfusion.jobs.cases import Placed
from slamfusion.jobs.inputs import LogFiles
from slamfusion.jobs.records import Settings, Summaries
from slamfusion.json_values import FLAT, printed_as
from slamfusion.palette import colours_of


@dataclass(frozen=True, eq=False, kw_only=True)
class MeasuredTrajectory(MeasuredPath):
    """A trajectory with its errors, and the files that they rest on."""

    file: Path = field(metadata=printed_as("estimate"))
    """Its file."""
    ground_truth: GroundTruth = field(repr=False)
    """What it was measured by."""
    grid: OccupancyGrid | None = field(default=None, repr=False)
    """A map in its frame, to be drawn under it."""
    duration_s: float
    """From its first pose to its last, seconds."""
    files: LogFiles = field(metadata=FLAT)
    placed: Placed = field(metadata=FLAT)

    def rows(self) -> list[Row]:
        """Return figures and single errors as rows of a table of results."""
        return result_rows(*self.placed.keys, self.measures.figures(), self.measures.series())


@dataclass(frozen=True, eq=False)
class TrajectoryDocument:
    """``slamfusion trajectory`` of one trajectory."""

    measured: MeasuredTrajectory = field(metadata=FLAT)
    settings: Settings = field(metadata=FLAT)


@dataclass(frozen=True, eq=False)
class TrajectoriesDocument:
    """``slamfusion trajectory`` of several; exit code 1 where something is ``not_measured``."""

    trajectories: Sequence[MeasuredTrajectory]
    """The trajectories in the order given."""
    summaries: Summaries = field(metadata=FLAT)
    not_measured: Sequence[str]
    """What could not be measured, a sentence each."""
    settings: Settings = field(metadata=FLAT)


def measure_trajectories(
    placed: Sequence[Placed], known: Mapping[str, LogFiles], config: RunConfig | None = None
) -> tuple[list[MeasuredTrajectory], list[str]]:
    """Measure each path by the files of its case.

    Returns:
        The measured paths, in the order given, and a sentence for each other one.

    Raises:
        TrajectoryError: a file of a case is damaged, or the only path cannot be measured.
        LogError: a log cannot be read.
        SlamFusionError: none of the paths could be measured.
    """
    config = config or RunConfig()
    truths = {}
    for case in dict.fromkeys(item.case for item in placed):
        files = known[case]
        ground_truth = GroundTruth.read(config, files.relations, files.odometry, files.truth)
        scans = None if files.log is None else read_trajectory(files.log, config.log)
        truths[case] = replace(ground_truth, scans=scans)
    found, not_measured = [], []
    for item in placed:
        ground_truth = truths[item.case]
        if ground_truth.relations is None and ground_truth.truth is None:
            not_measured.append(
                f"{item.path}: neither truth nor relations of {item.case} was given"
            )
            continue
        try:
            estimate = read_trajectory(item.path, config.log)
            measures = ground_truth.measure(estimate, config)
        except (SlamFusionError, OSError) as error:
            if len(placed) == 1:
                raise
            not_measured.append(f"{item.path}: {error_text(error, item.path)}")
            continue
        found.append(
            MeasuredTrajectory(
                placed=item,
                trajectory=estimate,
                ground_truth=ground_truth,
                duration_s=float(estimate.stamps_s[-1] - estimate.stamps_s[0]),
                measures=measures,
                file=item.path,
                files=known[item.case],
            )
        )
    if not found:
        raise SlamFusionError("; ".join(not_measured) or "no path to measure; give at least one")
    return found, not_measured


def write_trajectories(
    found: Sequence[MeasuredTrajectory], directory: str | Path, config: RunConfig | None = None
) -> Path:
    """Write one report of the errors of paths; see ``slamfusion.report.page.write_page``."""
    from slamfusion.report import errors, page, paths  # noqa: PLC0415  (an extra)

    config = config or RunConfig()
    cases: dict[str, list[MeasuredTrajectory]] = {}
    for own in found:
        named = replace(own, trajectory=replace(own.trajectory, name=own.placed.name))
        cases.setdefault(own.placed.case, []).append(named)
    sections, by_path, lines = [], [], []
    is_one = len(cases) == 1
    colours = colours_of(item.name for own in cases.values() for item in own)
    for case, measured in cases.items():
        first = measured[0]
        if len(measured) == 1:
            grid = None
            if first.grid is not None:
                grid = first.grid.classified(config.fusion.normalize)
            pictures = paths.path_pictures(
                first.trajectory,
                grid=grid,
                errors=first.measures.truth,
                truth=first.ground_truth.truth,
                odometry=first.ground_truth.scans if len(found) == 1 else None,
            )
        else:
            pictures = [paths.paths_over_truth(case, measured, first.ground_truth.truth, colours)]
        title = f"The path{'s' if len(measured) > 1 else ''}"
        sections.append(page.Section(title if is_one else f"{case}: {title}", "", pictures))
        sections += errors.errors_section(measured, colours, "" if is_one else case)
        by_path += [errors.error_facts(item) for item in measured]
        words: dict[str, list[str]] = {}
        for item in measured:
            counted = item.measures.how_counted()
            words.setdefault("; ".join(counted) + ".", []).append(item.name)
        lines += [(f"{case}, {', '.join(names)}:", text) for text, names in words.items()]
    # The leading error of each path comes first.
    facts = [fact for row in zip_longest(*by_path) for fact in row if fact is not None]
    if len(found) == 1:
        facts += [
            page.Fact(f"{found[0].poses}", "poses"),
            page.Fact(f"{found[0].path_length_m:.1f} m", "travelled by the estimate"),
        ]
    banner = page.Banner("plain", _headline(cases), lines)
    report = page.Page("SLAMfusion trajectory", banner, facts, sections, config, "none needed")
    return page.write_page(report, directory)


def _headline(cases: Mapping[str, Sequence[MeasuredPath]]) -> str:
    """Name the path with the smallest error; of several cases the number of paths."""
    measured = [item for own in cases.values() for item in own]
    known = rankings(measured)
    if len(cases) > 1 or not any(known.values()):
        return f"{len(measured)} paths of {len(cases)} cases"
    errors = known["ATE"] or known["relations"]
    best, (error_m, _) = next(iter(errors.items()))
    kind = "from the truth (ATE rmse)" if known["ATE"] else "off the relations (mean)"
    place = f", the nearest of {len(errors)}" if len(errors) > 1 else ""
    return f"{best}: {error_m:.4f} m {kind}{place}"
