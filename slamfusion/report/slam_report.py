"""The report of one producer's run: its map, its path, how well it did, and its errors."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from slamfusion.config import RunConfig
from slamfusion.evaluation import RelationErrors, trajectory_errors
from slamfusion.io.files import AtomicFiles
from slamfusion.palette import colours_of
from slamfusion.report import paths
from slamfusion.report.errors import MeasuredPath, error_facts, errors_section
from slamfusion.report.layers import map_layers
from slamfusion.report.maps import input_picture, statistics_table
from slamfusion.report.page import Banner, Fact, Page, Picture, Section, Table, write_page
from slamfusion.report.series import drawable, series_picture
from slamfusion.report.trajectory_report import path_pictures
from slamfusion.slam.common.runner import ProducerRun
from slamfusion.trajectory import Trajectory


def write_slam_report(
    directory: str | Path,
    run: ProducerRun,
    *,
    config: RunConfig,
    facts: Sequence[Fact] = (),
    tables: Sequence[Table] = (),
    truth: Trajectory | None = None,
    relations: RelationErrors | None = None,
    device: str = "",
    files: AtomicFiles | None = None,
) -> Path:
    """Write the report of a producer's run as one self-contained page with its pictures.

    Args:
        directory, files: see ``write_page``, also for what is returned and raised.
        run: what was made; its path has at least one pose. The first of the other paths of a
            producer with closures is the path as it was first reported.
        facts: health and timing, for the headline, in this order.
        truth: the true path; its errors are computed as ``config.trajectory`` says.
        relations: the trajectory's errors on known relations.

    Raises:
        TrajectoryError: the truth does not meet the trajectory in time.
    """
    normalize, warnings = config.fusion.normalize, run.warnings()
    grid, trajectory, errors = run.grid, run.trajectory, None
    if truth is not None:
        errors = trajectory_errors(trajectory, truth, config.trajectory)
    pictures = [
        input_picture(grid, normalize),
        *path_pictures(
            trajectory,
            config=config,
            grid=grid,
            errors=errors,
            truth=truth,
            odometry=run.odometry,
            others=run.other_paths,
        ),
    ]
    if run.closures:
        pictures.append(
            paths.closures_picture(trajectory, run.closures, grid=grid, normalize=normalize)
        )
    tables_of_map = [statistics_table([grid], normalize)]
    layers = map_layers(grid, trajectory)
    sections = [Section("Map and path", "", pictures, tables_of_map, layers=layers)]
    measured = MeasuredPath(run.name, trajectory, errors, relations)
    sections += errors_section([measured], colours_of([run.name]))
    over_time = _series_pictures(run)
    if tables or over_time:
        health = Section("Health and time", pictures=over_time, tables=tables)
        sections.append(health)
    judged = "its map may be wrong" if warnings else "no warning from its run"
    size = f"{len(trajectory)} poses, {trajectory.path_length_m():.1f} m"
    lines = [(f"{run.name}:", sentence) for sentence in warnings]
    banner = Banner("warn" if warnings else "plain", f"{run.name}: {judged} ({size})", lines)
    shown = [*error_facts(measured), *facts]
    page = Page("SLAMfusion run", banner, shown, sections, config, device)
    return write_page(page, directory, files)


def _series_pictures(run: ProducerRun) -> list[Picture]:
    """Return the quantities over time as one picture; nothing where none has a value."""
    shown = drawable(run.series)
    if not shown:
        return []
    names, path = ", ".join(item.name for item in shown), run.trajectory
    colour = colours_of([path.name])[path.name]
    figure = series_picture(shown, colours=[colour] * len(shown), start_s=float(path.stamps_s[0]))
    return [Picture("over-time", figure, "Over the run", f"From the top: {names}.")]
