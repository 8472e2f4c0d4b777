"""The report of one producer's run: its map, its path, how well it did, and its errors."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from slamfusion.config import RunConfig
from slamfusion.evaluation import RelationErrors, trajectory_errors
from slamfusion.grid import OccupancyGrid
from slamfusion.io.atomic import AtomicFiles
from slamfusion.palette import colours_of
from slamfusion.report import paths
from slamfusion.report.closures import closure_pictures
from slamfusion.report.layers import map_layers
from slamfusion.report.maps import input_picture, statistics_table
from slamfusion.report.page import (
    Banner,
    Fact,
    Page,
    Picture,
    Section,
    Table,
    circumstances,
    write_page,
)
from slamfusion.report.series import drawable, series_picture
from slamfusion.report.trajectory_report import (
    error_facts,
    path_pictures,
    relations_section,
    truth_section,
)
from slamfusion.slam.common.mapper import Closure, Series
from slamfusion.trajectory import Trajectory


def write_slam_report(
    directory: str | Path,
    *,
    name: str,
    grid: OccupancyGrid,
    trajectory: Trajectory,
    config: RunConfig,
    facts: Sequence[Fact] = (),
    warnings: Sequence[tuple[str, str]] = (),
    tables: Sequence[Table] = (),
    odometry: Trajectory | None = None,
    truth: Trajectory | None = None,
    relations: RelationErrors | None = None,
    series: Sequence[Series] = (),
    other_paths: Sequence[Trajectory] = (),
    closures: Sequence[Closure] = (),
    device: str = "",
    files: AtomicFiles | None = None,
) -> Path:
    """Write the report of a producer's run as one self-contained page with its pictures beside it.

    Args:
        directory: for ``report.html`` and the PNG files; made when missing.
        name: the producer.
        grid: its map.
        trajectory: its pose at each scan, in the frame of the map; at least one.
        config: the effective configuration, written out in full.
        facts: health and timing, for the headline, in this order.
        warnings: what the user must see first, each a subject and a sentence: scans that were
            skipped, a producer that may be lost.
        tables: more of health and timing.
        odometry: raw odometry of the scans, laid on the start of the path.
        truth: the true path; its errors are computed as ``config.trajectory`` says.
        relations: the trajectory's errors on known relations.
        series: the producer's own quantities over time; those without a value are left out.
        other_paths: what else it believes the path to be, in the frame of the map; the first of
            a producer with closures is the path as it was first reported.
        closures: of a producer that closes loops.
        device: the device that computed, in words.
        files: the set of files to join; default: one of its own.

    Returns:
        The path of ``report.html``.

    Raises:
        TrajectoryError: the truth does not meet the trajectory in time.
        SlamFusionError: the directory cannot be written.
    """
    normalize = config.fusion.normalize
    errors = None
    if truth is not None:
        errors = trajectory_errors(trajectory, truth, config.trajectory)
    pictures = [
        input_picture(grid, normalize),
        *path_pictures(
            trajectory, config=config, grid=grid, errors=errors, truth=truth, odometry=odometry
        ),
        *_other_paths_pictures(trajectory, other_paths, config, grid),
        *closure_pictures(
            trajectory,
            other_paths[0] if other_paths else None,
            closures,
            grid=grid,
            normalize=normalize,
        ),
    ]
    tables_of_map = [statistics_table([grid], normalize)]
    layers = map_layers(grid, trajectory)
    sections = [Section("Map and path", "map-and-path", "", pictures, tables_of_map, layers=layers)]
    if errors is not None:
        sections.append(truth_section(errors, config=config, grid=grid))
    if relations is not None:
        sections.append(relations_section(relations))
    over_time = _series_pictures(series, trajectory)
    if tables or over_time:
        health = Section("Health and time", "health", pictures=over_time, tables=tables)
        sections.append(health)
    sections.append(circumstances(config, device))
    judged = "its map may be wrong" if warnings else "nothing in the run speaks against its map"
    size = f"{len(trajectory)} poses, {trajectory.path_length_m():.1f} m"
    # That nothing was noticed is no proof: the truth alone would be.
    banner = Banner("warn" if warnings else "plain", f"{name}: {judged} ({size})", warnings)
    shown = [*facts, *error_facts(relations, errors)]
    page = Page("SLAMfusion run", banner, shown, sections)
    return write_page(page, directory, files, forms=config.report.pictures)


def _other_paths_pictures(
    trajectory: Trajectory,
    others: Sequence[Trajectory],
    config: RunConfig,
    grid: OccupancyGrid,
) -> list[Picture]:
    """Return the path over what else it may have been; nothing where there is nothing else."""
    if not others:
        return []
    png = paths.paths_picture(
        trajectory, others=others, grid=grid, normalize=config.fusion.normalize
    )
    return [
        Picture(
            "other-paths",
            png,
            "The path and what else it may have been",
            "Where the faint paths leave the estimate, the producer is not of one mind.",
            legend=paths.others_legend(trajectory.name, len(others)),
        )
    ]


def _series_pictures(series: Sequence[Series], trajectory: Trajectory) -> list[Picture]:
    """Return the quantities over time as one picture; nothing where none has a value."""
    shown = drawable(series)
    if not shown:
        return []
    names = ", ".join(item.name for item in shown)
    colour = colours_of([trajectory.name])[trajectory.name]
    png = series_picture(shown, colour=colour, start_s=float(trajectory.stamps_s[0]))
    return [Picture("over-time", png, "Over the run", f"From the top: {names}.")]
