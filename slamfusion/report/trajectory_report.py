"""The report of a trajectory against the truth or known relations, and its parts."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from slamfusion.config import RunConfig
from slamfusion.evaluation import (
    ErrorStatistics,
    RelationErrors,
    TrajectoryErrors,
    error_kinds,
)
from slamfusion.fusion.path_check import moved_path
from slamfusion.grid import OccupancyGrid
from slamfusion.io.files import AtomicFiles
from slamfusion.palette import colours_of
from slamfusion.report import paths
from slamfusion.report.map_axes import mark_legend
from slamfusion.report.page import (
    Banner,
    Cell,
    Fact,
    Page,
    Picture,
    Section,
    Table,
    number,
    write_page,
)
from slamfusion.trajectory import Trajectory

FIGURES = ("mean", "std", "rmse", "median", "min", "max")


def write_trajectory_report(
    directory: str | Path,
    *,
    trajectory: Trajectory,
    config: RunConfig,
    relations: RelationErrors | None = None,
    errors: TrajectoryErrors | None = None,
    truth: Trajectory | None = None,
    odometry: Trajectory | None = None,
    grid: OccupancyGrid | None = None,
    files: AtomicFiles | None = None,
) -> Path:
    """Write the errors of a trajectory as one self-contained page with its pictures beside it.

    Args:
        directory, files: see ``write_page``, also for what is returned and raised.
        trajectory: the estimate, at least one pose.
        config: the settings in effect.
        relations: its errors on known relations.
        errors: its errors against ``truth``.
        truth: the true path, drawn dashed where ``errors`` says how it lies to the estimate.
        odometry: where the wheels alone would have gone, laid on the estimate's start.
        grid: a map in the frame of the estimate, drawn under it.
    """
    shown = path_pictures(
        trajectory, config=config, grid=grid, errors=errors, truth=truth, odometry=odometry
    )
    sections = [Section("Path", "path", "", shown)]
    if errors is not None:
        sections.append(truth_section(errors, config=config, grid=grid))
    if relations is not None:
        sections.append(relations_section(relations))
    facts = [
        *error_facts(relations, errors),
        Fact(f"{len(trajectory)}", "poses"),
        Fact(f"{trajectory.path_length_m():.1f} m", "travelled by the estimate"),
    ]
    headline = f"{trajectory.name}: {_judged(relations, errors)}"
    banner = Banner("plain", headline, _how_counted(relations, errors))
    page = Page("SLAMfusion trajectory", banner, facts, sections, config, "none needed")
    return write_page(page, directory, files)


def path_pictures(
    trajectory: Trajectory,
    *,
    config: RunConfig,
    grid: OccupancyGrid | None = None,
    errors: TrajectoryErrors | None = None,
    truth: Trajectory | None = None,
    odometry: Trajectory | None = None,
) -> list[Picture]:
    """Return the path by time, and where there are others, beside them.

    Args:
        trajectory: the estimate, in the frame of ``grid``.
        config: what counts as wall and as free in the map.
        grid: the map; None: none.
        errors: says how the truth lies to the estimate; without it the truth is left out.
        truth: the true path, in its own frame.
        odometry: raw odometry, in its own frame; it is laid on the estimate's start.
    """
    normalize = config.fusion.normalize
    pictures = [
        Picture(
            "path",
            paths.path_picture(trajectory, grid=grid, normalize=normalize),
            "The path over the map" if grid is not None else "The path",
            f"{len(trajectory)} poses, {trajectory.path_length_m():.1f} m.",
            legend=mark_legend(),
        )
    ]
    lines = [paths.estimate_line(trajectory)]
    if odometry is not None and len(odometry):
        lines.insert(0, paths.odometry_line(paths.laid_on_start(odometry, trajectory)))
    if truth is not None and errors is not None:
        lines.append(paths.truth_line(moved_path(truth, errors.pose_truth_estimate.inverse())))
    if len(lines) > 1:
        pictures.append(
            Picture(
                "paths",
                paths.paths_picture(lines, trajectory, grid=grid, normalize=normalize),
                "The path beside the others",
                "The truth is laid on the estimate as a whole, raw odometry on its start; drift "
                "far beyond the picture is cut off.",
                legend=paths.paths_legend(lines),
            )
        )
    return pictures


def truth_section(
    errors: TrajectoryErrors, *, config: RunConfig, grid: OccupancyGrid | None = None
) -> Section:
    """Return the errors against the truth: along the path, on the map, and as a table."""
    aligned = Trajectory(errors.stamps_s, errors.aligned, errors.name)
    matched = moved_path(aligned, errors.pose_truth_estimate.inverse())
    pictures = [
        Picture(
            "error-along-path",
            paths.error_picture(errors, colours_of([errors.name])[errors.name]),
            "Error along the path",
            "Distance of each place from the true one, and difference of the headings, over the "
            "metres that were truly travelled.",
        ),
        Picture(
            "error-on-path",
            paths.path_picture(
                matched,
                grid=grid,
                normalize=config.fusion.normalize,
                values=errors.translation_m,
            ),
            "Where the error is",
            "The estimated path, coloured by the distance from the true place.",
            legend=mark_legend(),
        ),
    ]
    return Section(
        "Error against the truth",
        "truth",
        "ATE: of each pose alone, after the best rigid motion of the whole (where asked for). "
        "RPE: of the motion between two poses, whatever came before.",
        pictures,
        [_table(f"Against {errors.truth}", error_kinds(errors, None))],
    )


def relations_section(errors: RelationErrors) -> Section:
    """Return what is left of each relation, over time and as a table."""
    revisits = errors.is_revisit()
    picture = Picture(
        "relations",
        paths.relations_picture(errors),
        "Error of each relation",
        f"{errors.relations_used} of {errors.relations_total} relations, "
        f"{int(revisits.sum())} of them revisits. A slip shows at the relations across it and "
        "nowhere else.",
        legend=paths.revisit_legend(),
    )
    kinds = error_kinds(None, errors)
    if revisits.any():
        own = ErrorStatistics.of(errors.translation_m[revisits])
        kinds.append(("revisits, translation m", own, 4))
    return Section(
        "Error on known relations",
        "relations",
        "The motion between two times, as it should be, taken off the motion that the trajectory "
        "made between them [K09]. No common frame is needed.",
        [picture],
        [_table(f"On {errors.relations}", kinds)],
    )


def error_facts(relations: RelationErrors | None, errors: TrajectoryErrors | None) -> list[Fact]:
    """Return the numbers of the headline."""
    facts = []
    if relations is not None:
        part = f"{relations.relations_used} of {relations.relations_total}"
        facts += [
            Fact(f"{relations.translation.mean:.4f} m", f"mean error of {part} relations"),
            Fact(f"{relations.rotation_deg.mean:.2f}°", "mean rotation error of the relations"),
        ]
    if errors is not None:
        facts.append(Fact(f"{errors.ate.rmse:.4f} m", "ATE, root mean square"))
        if errors.rpe is not None:
            pair = f"{errors.rpe_delta:g} {errors.rpe_unit}"
            facts.append(Fact(f"{errors.rpe.rmse:.4f} m", f"RPE over {pair}, root mean square"))
    return facts


def figure_cells(statistics: ErrorStatistics | None, digits: int) -> list[Cell]:
    """Return the ``FIGURES`` of an error as cells; dashes where there are none."""
    values = [None if statistics is None else getattr(statistics, name) for name in FIGURES]
    return [number(value, digits) for value in values]


def _judged(relations: RelationErrors | None, errors: TrajectoryErrors | None) -> str:
    """Return the error in words; how much is good is for the reader to say."""
    if errors is not None:
        return f"{errors.ate.rmse:.3f} m from the truth (ATE, root mean square)"
    if relations is not None:
        return f"{relations.translation.mean:.4f} m off a relation, in the mean"
    return "nothing was measured"


def _how_counted(
    relations: RelationErrors | None, errors: TrajectoryErrors | None
) -> Sequence[tuple[str, str]]:
    """Say what the numbers rest on."""
    lines = []
    if relations is not None:
        counted = (
            f"{relations.relations_used} of {relations.relations_total} of "
            f"{relations.relations}, poses within {relations.tolerance_s:g} s of both times."
        )
        lines.append(("Relations:", counted))
    if errors is not None:
        aligned = "aligned" if errors.alignment.kind == "se2" else "not aligned"
        counted = (
            f"{errors.poses_matched} of {errors.poses} poses met one of {errors.truth} "
            f"within {errors.tolerance_s:g} s; {aligned}."
        )
        lines.append(("Truth:", counted))
    return lines


def _table(title: str, rows: Sequence[tuple[str, ErrorStatistics | None, int]]) -> Table:
    """Return a table of figures, dashes where there are none."""
    return Table(
        title,
        ("error", *FIGURES),
        [[Cell(name), *figure_cells(figures, digits)] for name, figures, digits in rows],
        "std is that of the population; min and max are the best and the worst.",
    )
