"""One producer of maps on one log: its map, its path, their errors, and the files of them."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from slamfusion.compute import ComputeDevice
from slamfusion.config import RunConfig
from slamfusion.errors import MapFileError, SlamFusionError
from slamfusion.grid import OccupancyGrid
from slamfusion.io import AtomicFiles, open_log
from slamfusion.jobs.documents import circumstances, path_text
from slamfusion.jobs.evaluate import evaluate_maps
from slamfusion.jobs.inputs import Progress, Warn, as_path, load_maps
from slamfusion.jobs.outputs import output_files
from slamfusion.jobs.produced import ProducerResult, add_run, measure_run, run_remarks
from slamfusion.jobs.run_records import (
    LogFilesJson,
    SlamDocument,
)
from slamfusion.jobs.trajectory import Measures, Yardsticks
from slamfusion.slam.common.mapper import Mapper
from slamfusion.slam.common.runner import ProducerRun, Resumable, run_producer
from slamfusion.slam.registry import make_producer, open_producer_device, resume_producer
from slamfusion.trajectory import Trajectory

__all__ = ["LogFiles", "MappedLog", "map_log", "save_mapped_log", "slam_document"]

_LOG = logging.getLogger(__name__)

# A log's progress is told in these parts of its whole length.
PROGRESS_STEPS = 1000


@dataclass(frozen=True)
class LogFiles:
    """A log, and what the path and the map made of it are held against; None: there is none.

    Attributes:
        log: the scans.
        relations: known motions between pairs of times.
        odometry: raw odometry of the whole run, to carry poses on to the relations' times.
        truth: the true trajectory.
        truth_map: the true map.
        scan_odometry: what gives the scans their odometry instead of the log; see ``open_log``.
    """

    log: Path
    relations: Path | None = None
    odometry: Path | None = None
    truth: Path | None = None
    truth_map: Path | None = None
    scan_odometry: Path | None = None

    def to_json(self) -> LogFilesJson:
        """Return the files for a JSON document."""
        return {
            "log": str(self.log),
            "relations": path_text(self.relations),
            "odometry_file": path_text(self.odometry),
            "scan_odometry": path_text(self.scan_odometry),
            "truth": path_text(self.truth),
            "truth_map": path_text(self.truth_map),
        }


@dataclass(frozen=True, eq=False)
class MappedLog:
    """What a producer made of a log, with its errors.

    Attributes:
        files: where everything was read.
        config: the settings in effect.
        result: the run and what was measured of it.
        mapper: the producer, which may go on, or save its state.
        truth: the true path; None without one.
        resumed_from: the saved state that it went on from; None: it began afresh.
        failure: why something could not be measured; None where all could. Map and path are good
            all the same.
    """

    files: LogFiles
    config: RunConfig
    result: ProducerResult
    mapper: Mapper
    truth: Trajectory | None = None
    resumed_from: Path | None = None
    failure: SlamFusionError | None = None

    @property
    def grid(self) -> OccupancyGrid:
        """The map."""
        return self.result.run.grid

    @property
    def trajectory(self) -> Trajectory:
        """The pose at each scan, in the frame of the map."""
        return self.result.run.trajectory

    def notices(self) -> tuple[str, ...]:
        """Say what was passed over, that more was to come, and what speaks against the map."""
        run, log = self.result.run, self.files.log
        sentences = []
        if run.known_scans:
            sentences.append(
                f"passed over {run.known_scans} scans of {log} that {self.resumed_from} knows"
            )
        if run.stopped_by == "limit":
            sentences.append(
                f"stopped after {len(run.feed_s)} scans, as asked for; the rest of {log} is "
                "not in the map"
            )
        return (*sentences, *run.warnings())


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
    warn: Warn = _LOG.warning,
) -> MappedLog:
    """Make a map of the scans in a log with one producer, and measure map and path.

    Args:
        log: a CARMEN or tinySLAM log, or a ROS bag.
        producer: its name in the registry.
        config: settings of the producer and of everything here; default: the defaults.
        device: where it computes; default: the one that the settings name.
        relations: known motions between pairs of times: errors of the path.
        odometry: raw odometry of the whole run, to carry poses on to the relations' times.
        truth: the true trajectory: errors of the path.
        truth_map: the true map: errors of the map.
        scan_odometry: what gives the scans their odometry instead of the log.
        resume: a saved state to go on from, made with the same settings.
        limit: scans after which it stops, at least 1; default: none.
        progress: told the producer, and how much of the log it has read.
        warn: told in a sentence what is doubtful about the true map.

    Returns:
        Map, path and record. What cannot be measured does not take the map along: it is the
        result's ``failure``.

    Raises:
        LogError: the log cannot be read.
        TrajectoryError: relations, odometry or truth cannot be read.
        MapFileError: the true map cannot be read.
        DeviceError: the device cannot be opened.
        SlamFusionError: there is no such producer, the state does not fit, or no scan could be
            used.
        OSError: a file cannot be opened.
    """
    config = config or RunConfig()
    files = LogFiles(
        Path(log), *map(as_path, (relations, odometry, truth, truth_map, scan_odometry))
    )
    held = Yardsticks.read(
        config, relations=files.relations, odometry=files.odometry, truth=files.truth
    )
    true_map = None
    if files.truth_map is not None:
        (true_map,) = load_maps([files.truth_map], None, config.map_files, warn)
    device = open_producer_device(producer, config) if device is None else device
    state = as_path(resume)
    mapper = (
        make_producer(producer, config, device)
        if state is None
        else resume_producer(producer, state, config, device)
    )
    run = _run(mapper, files, config, limit, progress)
    failure, measures, evaluation = None, Measures(), None
    try:
        measures = measure_run(run, config, held)
        if true_map is not None:
            (evaluation,) = evaluate_maps([run.grid], true_map, config, device)
    except SlamFusionError as error:  # the map is made; it is kept, and the failure is told
        failure = error
    result = ProducerResult(run, measures, evaluation, device.name)
    return MappedLog(files, config, result, mapper, held.truth, state, failure)


def _run(
    mapper: Mapper,
    files: LogFiles,
    config: RunConfig,
    limit: int | None,
    progress: Progress | None,
) -> ProducerRun:
    """Run the producer over the log; progress follows the file."""
    log = open_log(files.log, config.log, files.scan_odometry)

    def tell(_: int) -> None:
        if progress is not None:
            progress(mapper.name, round(PROGRESS_STEPS * log.fraction_read), PROGRESS_STEPS)

    return run_producer(mapper, log, log=log, progress=tell, limit=limit)


# --- files ------------------------------------------------------------------------------------


def slam_document(mapped: MappedLog, outputs: Sequence[Path], state: Path | None) -> SlamDocument:
    """Return what ``slamfusion slam`` prints as JSON and writes as the record.

    Args:
        mapped: the run.
        outputs: the files that it is written to.
        state: the file of the producer's state; None: it is not kept.
    """
    files, result = mapped.files, mapped.result
    return {
        "producers": [
            {
                **result.to_json(outputs),
                "resumed_from": path_text(mapped.resumed_from),
                "state_file": path_text(state),
            }
        ],
        **files.to_json(),
        **circumstances(mapped.config, result.device),
    }


def save_mapped_log(
    mapped: MappedLog,
    stem: str | Path,
    *,
    probabilities: bool = False,
    state: str | Path | None = None,
    report: str | Path | None = None,
    files: AtomicFiles | None = None,
) -> SlamDocument:
    """Write map, path, record, state and report; all of them or none.

    Args:
        mapped: the run.
        stem: the files' path without their suffixes.
        probabilities: also write the map with its probabilities.
        state: file for everything that a later run needs to go on; None: none.
        report: folder for ``report.html`` and its pictures; None: no report.
        files: the set of files to join; default: one of its own.

    Returns:
        The record that is written beside the map.

    Raises:
        SlamFusionError: a file cannot be written, the producer cannot save its state, or
            matplotlib is missing.
    """
    if files is None:
        with AtomicFiles() as own:
            return save_mapped_log(
                mapped, stem, probabilities=probabilities, state=state, report=report, files=own
            )
    stem, state = Path(stem), as_path(state)
    outputs = output_files(stem, probabilities=probabilities)
    document = slam_document(mapped, outputs if state is None else [*outputs, state], state)
    add_run(files, mapped.result.run, document, stem, mapped.config, probabilities=probabilities)
    if state is not None:
        _add_state(files, state, mapped.mapper)
    if report is not None:
        _add_report(files, mapped, Path(report))
    return document


def _add_state(files: AtomicFiles, target: Path, mapper: Mapper) -> None:
    """Stage the state of a producer with the other files."""
    if not isinstance(mapper, Resumable):
        message = f"{mapper.name} cannot save its state"
        raise SlamFusionError(message)
    with TemporaryDirectory(prefix="slamfusion-") as name:
        draft = Path(name) / target.name
        try:
            mapper.save_state(draft)
        except MapFileError as error:
            raise MapFileError(str(error).replace(name, str(target.parent))) from None
        files.add(target, draft.read_bytes())


def _add_report(files: AtomicFiles, mapped: MappedLog, directory: Path) -> None:
    """Stage the report: map, path, errors, health."""
    from slamfusion.report import Fact, Table, write_slam_report  # noqa: PLC0415  (an extra)
    from slamfusion.report.page import Cell  # noqa: PLC0415

    result, run = mapped.result, mapped.result.run
    time_ms = run.time_per_scan_ms()
    facts = [
        Fact(f"{run.scans_used} of {run.scans}", "scans used"),
        Fact(f"{time_ms['mean']:.2f} ms", "a scan"),
        Fact(f"{run.peak_memory_bytes / 1e6:.1f} MB", "map and filter"),
    ]
    if run.health.mean_match_score is not None:
        facts.append(Fact(f"{run.health.mean_match_score:.3f}", "mean match score"))
    rows = [[Cell(name), Cell(value)] for name, value in result.figures()]
    remarks = [[Cell(where), Cell(sentence)] for where, sentence in run_remarks(run)]
    tables = [Table("The run", ("what", "value"), rows)]
    if remarks:
        tables.append(Table("Said of the log and its scans", ("where", "what"), remarks))
    # A resumed run's log may only go on: then its odometry cannot be laid on the start of the path.
    is_later = (
        mapped.resumed_from is not None
        and run.odometry is not None
        and run.odometry.stamps_s[0] > run.trajectory.stamps_s[0]
    )
    write_slam_report(
        directory,
        name=run.name,
        grid=run.grid,
        trajectory=run.trajectory,
        config=mapped.config,
        facts=facts,
        warnings=[(f"{run.name}:", sentence) for sentence in run.warnings()],
        tables=tables,
        odometry=None if is_later else run.odometry,
        truth=mapped.truth,
        relations=result.measures.relations,
        series=run.series,
        other_paths=run.other_paths,
        closures=run.closures,
        device=result.device,
        files=files,
    )
