"""One producer of maps on one log: its map, its path, their errors, and the files of them."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypedDict

from slamfusion.compute import ComputeDevice
from slamfusion.config import RunConfig
from slamfusion.errors import MapFileError, SlamFusionError
from slamfusion.grid import OccupancyGrid
from slamfusion.io import AtomicFiles, open_log, save_map, write_tum
from slamfusion.jobs.documents import circumstances, number, path_text, record_bytes
from slamfusion.jobs.evaluate import evaluate_maps
from slamfusion.jobs.inputs import Progress, Warn, as_path, load_maps
from slamfusion.jobs.outputs import PROBABILITY, output_files
from slamfusion.jobs.records import CircumstancesJson, Evaluation
from slamfusion.jobs.trajectory import Measures, MeasuresJson, Yardsticks
from slamfusion.slam.common.mapper import Mapper
from slamfusion.slam.common.runner import ProducerRun, Resumable, run_producer
from slamfusion.slam.records import ProducerRunJson
from slamfusion.slam.registry import make_producer, open_producer_device, resume_producer
from slamfusion.trajectory import Trajectory

_LOG = logging.getLogger(__name__)


class ProducerJson(ProducerRunJson, MeasuresJson):
    """What one producer made of a log, what it took, and the errors that could be measured."""

    map_error: Evaluation | None
    """Errors of its map; null without a true map."""
    files: Sequence[str]
    """The files that it was written to: map, picture, path, record."""


class SlamProducerJson(ProducerJson):
    """The producer of ``slamfusion slam``."""

    resumed_from: str | None
    """The state that it was resumed from; null: it began afresh."""
    state_file: str | None
    """The file that its state was saved to."""


class LogFilesJson(TypedDict):
    """A log, and the files that its results are compared with."""

    log: str
    """The log that was mapped."""
    relations: str | None
    """The file of known relations."""
    odometry_file: str | None
    """The file of raw odometry."""
    scan_odometry: str | None
    """The file that gave the scans their odometry."""
    truth: str | None
    """The file of the true trajectory."""
    truth_map: str | None
    """The true map's file."""


class SlamDocument(LogFilesJson, CircumstancesJson):
    """``slamfusion slam``; also the record OUT.json."""

    producers: Sequence[SlamProducerJson]
    """The one producer."""


@dataclass(frozen=True)
class LogFiles:
    """A log, and what the path and the map made of it are held against; None: there is none.

    Attributes:
        relations: known motions between pairs of times.
        odometry: raw odometry of the whole run, to carry poses on to the relations' times.
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


@dataclass(frozen=True)
class ProducerResult:
    """A run and everything that was measured of it.

    Attributes:
        evaluation: errors of its map; None without a true map.
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
        run, health, stamps_s = self.run, self.run.health, self.run.trajectory.stamps_s
        ms = run.time_per_scan_ms()
        fed, wheels = len(run.feed_s), "no odometry"
        if run.odometry is not None:
            wheels = f"{number(run.odometry.path_length_m(), 1)} m"
        found = {
            "scans": f"{run.scans}, {run.scans_used} of them used",
            "scans fed in this run": "" if fed == run.scans else str(fed),
            "duration of the drive": f"{number(float(stamps_s[-1] - stamps_s[0]), 1)} s",
            "path length": f"{number(run.trajectory.path_length_m(), 1)} m",
            "path length by odometry": wheels,
            "time per scan": f"mean {number(ms['mean'], 2)} ms, median {number(ms['p50'], 2)} ms, "
            f"95 % within {number(ms['p95'], 2)} ms, 99.9 % within {number(ms['p999'], 2)} ms, "
            f"longest {number(ms['max'], 2)} ms",
            "time in all": f"{number(run.time_s, 1)} s, reading included",
            "peak memory": f"{number(run.peak_memory_bytes / 1e6, 1)} MB map and filter, "
            f"{number(run.process_peak_memory_bytes / 1e6, 0)} MB whole process",
            "match score": f"mean {number(health.mean_match_score)}, last "
            f"{number(health.match_score)}, {health.low_scores} below half of the mean, "
            f"{run.low_in_a_row} of them in a row",
            "effective particles": "" if health.n_eff is None else number(health.n_eff, 1),
            "map": f"{run.grid.width} x {run.grid.height} cells of {run.grid.resolution:g} m",
            "device": self.device,
        }
        return [(name, value) for name, value in found.items() if value]


@dataclass(frozen=True, eq=False)
class MappedLog:
    """What a producer made of a log, with its errors.

    Attributes:
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
        """Say what was passed over, that more was to come, and what contradicts the map."""
        run, log = self.result.run, self.files.log
        sentences = []
        if run.known_scans:
            sentences.append(
                f"passed over {run.known_scans} scans of {log} that {self.resumed_from} knows"
            )
        if not run.is_complete:
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
        relations, odometry, truth, truth_map, scan_odometry: see ``LogFiles``.
        resume: a saved state to go on from, made with the same settings.
        limit: scans after which it stops, at least 1; default: none.

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
    held = Yardsticks.read(config, files.relations, files.odometry, files.truth, warn)
    true_map = None
    if files.truth_map is not None:
        (true_map,) = load_maps([files.truth_map], None, config.map_files, warn, measured=True)
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
    mapper: Mapper, files: LogFiles, config: RunConfig, limit: int | None, progress: Progress | None
) -> ProducerRun:
    """Run the producer over the log; progress follows the file."""
    log = open_log(files.log, config.log, files.scan_odometry)

    def tell(_: int) -> None:
        if progress is not None:
            progress(mapper.name, log.fraction_read, 1)

    return run_producer(mapper, log, log=log, progress=tell, limit=limit)


def run_remarks(run: ProducerRun) -> list[tuple[str, str]]:
    """Return what was left out, what is odd, and what the log says, each with its place."""
    remarks = [(f"left out by {run.name}", item) for item in run.health.skips.sentences("scan")]
    if run.log is not None:
        remarks += [("left out of the log", item) for item in run.log.skipped.sentences()]
        remarks += [("odd in the log", item) for item in run.log.warnings.sentences()]
        remarks += [("the log", item) for item in run.log.notes]
    return remarks


def measure_run(run: ProducerRun, config: RunConfig, held: Yardsticks) -> Measures:
    """Measure the path, and the one that was first reported where the producer keeps it.

    Raises:
        TrajectoryError: the path does not meet the relations, the odometry or the truth.
    """
    online = run.online_path()
    final = held.measure(run.trajectory, config, run.odometry)
    if online is None or (held.relations is None and held.truth is None):
        return final
    return replace(final, online=held.measure(online, config, run.odometry))


# --- files ------------------------------------------------------------------------------------


def slam_document(mapped: MappedLog, outputs: Sequence[Path], state: Path | None) -> SlamDocument:
    """Return what ``slamfusion slam`` prints as JSON and writes as the record."""
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


def add_run(
    files: AtomicFiles,
    run: ProducerRun,
    document: Mapping[str, Any],
    stem: Path,
    config: RunConfig,
    *,
    probabilities: bool,
) -> None:
    """Stage a run's map, path and record with other files."""
    _, _, tum, record = output_files(stem)
    save_map(run.grid, stem, classes=config.fusion.normalize, files=files)
    if probabilities:
        other = stem.with_name(stem.name + PROBABILITY)
        save_map(run.grid, other, mode="raw", image_format="png", files=files)
    write_tum(tum, run.trajectory, files=files)
    files.add(record, record_bytes(document))


def save_mapped_log(
    mapped: MappedLog,
    stem: str | Path,
    *,
    probabilities: bool = False,
    state: str | Path | None = None,
    report: str | Path | None = None,
) -> SlamDocument:
    """Write map, path, record, state and report; all of them or none.

    Args:
        stem: the files' path without their suffixes.
        probabilities: also write the map with its probabilities.
        state: file for everything that a later run needs to go on; None: none.
        report: folder for ``report.html`` and its pictures; None: no report.

    Returns:
        The record that is written beside the map.

    Raises:
        SlamFusionError: a file cannot be written, the producer cannot save its state, or
            matplotlib is missing.
    """
    stem, state = Path(stem), as_path(state)
    outputs = output_files(stem, probabilities=probabilities)
    document = slam_document(mapped, outputs if state is None else [*outputs, state], state)
    with AtomicFiles() as files:
        add_run(
            files, mapped.result.run, document, stem, mapped.config, probabilities=probabilities
        )
        if state is not None:
            _add_state(files, state, mapped.mapper)
        if report is not None:
            _add_report(files, mapped, Path(report))
    return document


def _add_state(files: AtomicFiles, target: Path, mapper: Mapper) -> None:
    """Stage the state of a producer with the other files."""
    if not isinstance(mapper, Resumable):
        raise SlamFusionError(f"{mapper.name} cannot save its state")
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

    result, run = mapped.result, mapped.result.run
    time_ms = run.time_per_scan_ms()
    facts = [
        Fact(f"{run.scans_used} of {run.scans}", "scans used"),
        Fact(f"{time_ms['mean']:.2f} ms", "a scan"),
        Fact(f"{run.peak_memory_bytes / 1e6:.1f} MB", "map and filter"),
    ]
    if run.health.mean_match_score is not None:
        facts.append(Fact(f"{run.health.mean_match_score:.3f}", "mean match score"))
    first, second = itemgetter(0), itemgetter(1)
    tables = [Table.of("The run", result.figures(), {"what": first, "value": second})]
    if remarks := run_remarks(run):
        title = "Said of the log and its scans"
        tables.append(Table.of(title, remarks, {"where": first, "what": second}))
    # A resumed run's log may only go on: then its odometry cannot be laid on the start of the path.
    is_later = (
        mapped.resumed_from is not None
        and run.odometry is not None
        and run.odometry.stamps_s[0] > run.trajectory.stamps_s[0]
    )
    write_slam_report(
        directory,
        replace(run, odometry=None) if is_later else run,
        config=mapped.config,
        facts=facts,
        tables=tables,
        truth=mapped.truth,
        relations=result.measures.relations,
        device=result.device,
        files=files,
    )
