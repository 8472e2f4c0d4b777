"""One producer of maps on one log: its map, its path, their errors, and the files of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from slamfusion.compute import ComputeDevice
from slamfusion.config import RunConfig
from slamfusion.errors import MapFileError, SlamFusionError, counted
from slamfusion.evaluation.measured import GroundTruth, MeasuredPath, Measures
from slamfusion.grid import OccupancyGrid
from slamfusion.io import AtomicFiles, open_log, save_map, write_atomic, write_tum
from slamfusion.jobs.inputs import LogFiles, Progress, Warn, as_path, load_truth, log_warning
from slamfusion.jobs.outputs import PROBABILITY, output_files
from slamfusion.jobs.records import Circumstances, number, record_bytes
from slamfusion.json_values import FLAT
from slamfusion.palette import colours_of
from slamfusion.slam.common.mapper import Mapper
from slamfusion.slam.common.runner import ProducerRun, Resumable, run_producer
from slamfusion.slam.registry import make_producer, open_producer_device, resume_producer
from slamfusion.trajectory import Trajectory

if TYPE_CHECKING:  # what aligns maps loads slowly
    from slamfusion.jobs.fuse_documents import Evaluation


@dataclass(frozen=True, eq=False, kw_only=True)
class ProducerResult:
    """What one producer made of a log, what it took, and the errors that could be measured."""

    run: ProducerRun = field(metadata=FLAT)
    measures: Measures = field(metadata=FLAT)
    map_error: Evaluation | None
    """Errors of its map; null without a true map."""
    files: Sequence[Path] = ()
    """The files that it was written to: map, picture, path, record."""
    device: str = field(repr=False)

    @property
    def name(self) -> str:
        """The producer."""
        return self.run.name

    @property
    def path(self) -> MeasuredPath:
        """The pose at each scan, in the frame of the map, and its errors."""
        named = replace(self.run.trajectory, name=self.name)
        return MeasuredPath(trajectory=named, measures=self.measures)

    def figures(self) -> list[tuple[str, str]]:
        """Return the run's numbers with their names."""
        run, health = self.run, self.run.health
        ms = run.time_per_scan_ms
        fed, wheels = len(run.feed_s), "no odometry"
        if run.odometry_path_length_m is not None:
            wheels = f"{number(run.odometry_path_length_m, 1)} m"
        found = {
            "scans": f"{run.scans}, {run.scans_used} of them used",
            "scans fed in this run": "" if fed == run.scans else str(fed),
            "duration of the drive": f"{number(run.duration_s, 1)} s",
            "path length": f"{number(run.path_length_m, 1)} m",
            "path length by odometry": wheels,
            "time per scan": f"mean {number(ms.mean, 2)} ms, median {number(ms.p50, 2)} ms, "
            f"95 % within {number(ms.p95, 2)} ms, 99.9 % within {number(ms.p999, 2)} ms, "
            f"longest {number(ms.max, 2)} ms",
            "time in all": f"{number(run.time_s, 1)} s, reading included",
            "peak memory": f"{number(run.peak_memory_mb, 1)} MB map and filter, "
            f"{number(run.process_peak_memory_mb, 0)} MB whole process",
            "match score": f"mean {number(health.mean_match_score)}, last "
            f"{number(health.match_score)}, {health.low_scores} below half of the mean, "
            f"{run.low_scores_in_a_row} of them in a row",
            "effective particles": "" if health.n_eff is None else number(health.n_eff, 1),
            "map": f"{run.grid.width} x {run.grid.height} cells of {run.grid.resolution:g} m",
            "device": self.device,
        }
        return [(name, value) for name, value in found.items() if value]


@dataclass(frozen=True, eq=False, kw_only=True)
class SlamProducer(ProducerResult):
    """The producer of ``slamfusion slam``."""

    resumed_from: Path | None
    """The state that it was resumed from; null: it started without one."""
    state_file: Path | None = None
    """The file that its state was saved to."""


@dataclass(frozen=True, eq=False, kw_only=True)
class MappedLog:
    """``slamfusion slam``; also the record OUT.json.

    Attributes:
        mapper: the producer, which may go on, or save its state.
        true_path: None without one.
        failure: why something could not be measured; None where all could. Map and path are good
            all the same.
    """

    producers: Sequence[SlamProducer]
    """The one producer; of several seeds one for each."""
    files: LogFiles = field(metadata=FLAT)
    made_with: Circumstances = field(metadata=FLAT)
    mapper: Mapper = field(repr=False)
    true_path: Trajectory | None = field(repr=False)
    failure: SlamFusionError | None = field(repr=False)

    @property
    def result(self) -> SlamProducer:
        """The producer's run and everything that was measured of it."""
        return self.producers[0]

    @property
    def grid(self) -> OccupancyGrid:
        """The map."""
        return self.result.run.grid

    @property
    def trajectory(self) -> Trajectory:
        """The pose at each scan, in the frame of the map."""
        return self.result.run.trajectory

    def notices(self) -> tuple[str, ...]:
        """Say what was passed over, that more was to come, and what contradicts the map."""
        run, log = self.result.run, self.files.log
        sentences = []
        if run.known_scans:
            state = self.result.resumed_from
            sentences.append(
                f"passed over {counted(run.known_scans, 'scan')} of {log} that {state} knows"
            )
        if not run.complete:
            sentences.append(
                f"stopped after {counted(len(run.feed_s), 'scan')}, as asked for; the rest of "
                f"{log} is not in the map"
            )
        if (error := self.result.map_error) is not None and error.why_not:
            sentences.append(f"not aligned: {error.why_not}")
        return (*sentences, *run.warnings)


def map_log(
    log: str | Path,
    producer: str,
    config: RunConfig | None = None,
    device: ComputeDevice | None = None,
    *,
    relations: str | Path | None = None,
    odometry: str | Path | None = None,
    truth: str | Path | None = None,
    truth_map: str | Path | None = None,
    scan_odometry: str | Path | None = None,
    resume: str | Path | None = None,
    limit: int | None = None,
    progress: Progress | None = None,
    warn: Warn = log_warning,
) -> MappedLog:
    """Make a map of the scans in a log with one producer, and measure map and path.

    Args:
        log: a CARMEN or tinySLAM log, or a ROS bag.
        relations, odometry, truth, truth_map: what path and map are compared with; odometry is that
            of the whole run, to carry poses on to the relations' times.
        scan_odometry: replaces the odometry of the log's scans; see ``open_log``.
        resume: a saved state to go on from, made with the same settings.
        limit: scans after which it stops, at least 1; default: none.

    Returns:
        Map, path and record; ``failure`` holds what could not be measured.

    Raises:
        LogError: the log cannot be read.
        TrajectoryError: relations, odometry or truth cannot be read.
        MapFileError, GridError: the true map cannot be read or is refused by ``load_truth``.
        SlamFusionError: the producer is unknown, the state does not fit, or no scan could be used.
    """
    config, state = config or RunConfig(), as_path(resume)
    read = map(as_path, (relations, odometry, truth, truth_map))
    files = LogFiles(Path(log), *read, scan_odometry=as_path(scan_odometry))
    ground_truth = GroundTruth.read(config, relations, odometry, truth, warn)
    true_map = None
    if truth_map is not None:
        true_map = load_truth(truth_map, config, warn=warn, producers=(producer,))
    device = open_producer_device(producer, config) if device is None else device
    mapper = (
        make_producer(producer, config, device)
        if state is None
        else resume_producer(producer, state, config, device)
    )
    source = open_log(log, config.log, files.scan_odometry)

    def tell(_: int) -> None:
        if progress is not None:
            progress(mapper.name, source.fraction_read, 1)

    run = run_producer(mapper, source, log=source, progress=tell, limit=limit)
    failure, measures, map_error = None, Measures(), None
    try:
        measures = measure_run(run, config, ground_truth)
        if true_map is not None:
            from slamfusion.jobs.evaluate import evaluate_maps  # noqa: PLC0415  (loads slowly)

            (map_error,) = evaluate_maps([run.grid], true_map, config, device)
    except SlamFusionError as error:  # the map is made; it is kept, with the failure
        failure = error
    result = SlamProducer(
        run=run, measures=measures, map_error=map_error, device=device.name, resumed_from=state
    )
    return MappedLog(
        producers=(result,),
        files=files,
        made_with=Circumstances(device.name, config),
        mapper=mapper,
        true_path=ground_truth.truth,
        failure=failure,
    )


def run_remarks(run: ProducerRun) -> list[tuple[str, str]]:
    """Return what was left out, what is odd, and what the log says, each with its place."""
    remarks = [(f"left out by {run.name}", item) for item in run.health.skips.sentences("scan")]
    if run.log is not None:
        remarks += [*run.log.faults(), *(("the log", item) for item in run.log.notes)]
    return list(dict.fromkeys(remarks))


def measure_run(run: ProducerRun, config: RunConfig, ground_truth: GroundTruth) -> Measures:
    """Measure the path, and the first reported one if the producer keeps it."""
    online = run.online_path()
    final = ground_truth.measure(run.trajectory, config, run.odometry)
    if online is None or (ground_truth.relations is None and ground_truth.truth is None):
        return final
    return replace(final, as_first_reported=ground_truth.measure(online, config, run.odometry))


def write_producer(
    run: ProducerRun, record: Any, stem: Path, config: RunConfig, *, probabilities: bool
) -> None:
    """Write a run's map, path and record."""
    _, _, tum, record_file = output_files(stem)
    save_map(run.grid, stem, classes=config.fusion.normalize)
    if probabilities:
        other = stem.with_name(stem.name + PROBABILITY)
        save_map(run.grid, other, mode="raw", image_format="png")
    write_tum(tum, run.trajectory)
    write_atomic(record_file, record_bytes(record))


def save_mapped_log(
    mapped: MappedLog,
    stem: str | Path,
    *,
    probabilities: bool = False,
    state: str | Path | None = None,
    report: str | Path | None = None,
) -> MappedLog:
    """Write map, path, record, state and report, all or none; return the record with its files.

    Args:
        stem: the files' path without their suffixes.
        probabilities: also write the map with its probabilities.
        state: file for ``resume`` of a later run.
        report: folder for ``report.html`` and its pictures.

    Raises:
        SlamFusionError: a file cannot be written, the producer cannot save its state, or
            matplotlib is missing.
    """
    stem, state = Path(stem), as_path(state)
    outputs = output_files(stem, probabilities=probabilities)
    if state is not None:
        outputs.append(state)
    saved = replace(mapped, producers=(replace(mapped.result, files=outputs, state_file=state),))
    config = mapped.made_with.config
    # Packed ahead: a file that a producer writes within the block would only appear at its end.
    packed = {} if state is None else {state: _packed_state(mapped.mapper, state)}
    with AtomicFiles():
        write_producer(mapped.result.run, saved, stem, config, probabilities=probabilities)
        for path, data in packed.items():
            write_atomic(path, data)
        if report is not None:
            write_slam_report(mapped.result, report, config, mapped.true_path)
    return saved


def _packed_state(mapper: Mapper, target: Path) -> bytes:
    """Return the file of a producer's state; a producer may write it in any way."""
    if not isinstance(mapper, Resumable):
        raise SlamFusionError(f"{mapper.name} cannot save its state")
    with TemporaryDirectory(prefix="slamfusion-") as name:
        draft = Path(name) / target.name
        try:
            mapper.save_state(draft)
        except MapFileError as error:
            raise MapFileError(str(error).replace(name, str(target.parent))) from None
        return draft.read_bytes()


def write_slam_report(
    result: SlamProducer, directory: str | Path, config: RunConfig, truth: Trajectory | None = None
) -> Path:
    """Write the report of a producer's run; see ``slamfusion.report.page.write_page``.

    Args:
        result: its path has at least one pose. The first of the other paths of a producer with
            closures is the path as it was first reported.
        truth: the true path; drawn where ``result`` has the errors against it.
    """
    from slamfusion.report import errors, layers, maps, page, paths  # noqa: PLC0415  (an extra)

    run = result.run
    trajectory, odometry = run.trajectory, run.odometry
    grid = run.grid.classified(config.fusion.normalize)
    # A resumed run's log may only go on: then its odometry cannot start where the path does.
    if odometry is not None and result.resumed_from is not None:
        starts_later = odometry.stamps_s[0] > trajectory.stamps_s[0]
        odometry = None if starts_later else odometry
    pictures = [
        maps.input_picture(grid),
        *paths.path_pictures(
            trajectory,
            grid=grid,
            errors=result.measures.truth,
            truth=truth,
            odometry=odometry,
            others=run.other_paths,
        ),
    ]
    if run.closures:
        pictures.append(paths.closures_picture(trajectory, run.closures, grid))
    statistics = maps.map_statistics([grid])
    shown = layers.map_layers(run.grid, trajectory)
    sections = [page.Section("Map and path", "", pictures, statistics, layers=shown)]
    sections += errors.errors_section([result.path], colours_of([run.name]))
    over_time = []
    if series := errors.drawable(run.series):
        colour = colours_of([trajectory.name])[trajectory.name]
        start_s = float(trajectory.stamps_s[0])
        figure = errors.series_picture(series, colours=[colour] * len(series), start_s=start_s)
        text = f"From the top: {', '.join(item.name for item in series)}."
        over_time = [page.Picture("over-time", figure, "Over the run", text)]
    tables = page.tables()
    health = tables.texts("The run", ["what", "value"], result.figures())
    if remarks := run_remarks(run):
        health += tables.texts("Said of the log and its scans", ["where", "what"], remarks)
    sections.append(page.Section("Health and time", "", over_time, health))
    facts = [
        *errors.error_facts(result.path),
        page.Fact(f"{run.scans_used} of {run.scans}", "scans used"),
        page.Fact(f"{run.time_per_scan_ms.mean:.2f} ms", "a scan"),
        page.Fact(f"{run.peak_memory_mb:.1f} MB", "map and filter"),
    ]
    if run.health.mean_match_score is not None:
        facts.append(page.Fact(f"{run.health.mean_match_score:.3f}", "mean match score"))
    judged = "its map may be wrong" if run.warnings else "no warning from its run"
    poses = counted(len(trajectory), "pose")
    headline = f"{run.name}: {judged} ({poses}, {trajectory.path_length_m():.1f} m)"
    lines = [(f"{run.name}:", sentence) for sentence in run.warnings]
    banner = page.Banner("warn" if run.warnings else "plain", headline, lines)
    report = page.Page("SLAMfusion run", banner, facts, sections, config, result.device)
    return page.write_page(report, directory)
