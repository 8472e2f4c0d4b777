"""``slamfusion slam``: one producer of maps on a recorded or simulated drive."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import click

from slamfusion.cli.evaluate import Evaluation, evaluate_maps, print_evaluations
from slamfusion.cli.inputs import check_writable, load_maps
from slamfusion.cli.options import (
    common_options,
    drive_options,
    file_option,
    report_option,
    with_config,
)
from slamfusion.cli.output import (
    notice,
    path_text,
    print_json,
    print_table,
    progress_bar,
    versions,
)
from slamfusion.cli.produced import (
    SUFFIXES,
    ProducerResult,
    add_run,
    measure_run,
    output_files,
    run_remarks,
)
from slamfusion.cli.trajectory import measure_trajectory, print_measures
from slamfusion.config import RunConfig, to_mapping
from slamfusion.errors import MapFileError, SlamFusionError

if TYPE_CHECKING:
    from slamfusion.compute import ComputeDevice
    from slamfusion.io import AtomicFiles
    from slamfusion.jobs.records import SlamDocument
    from slamfusion.slam.common.mapper import Mapper
    from slamfusion.slam.common.runner import ProducerRun
    from slamfusion.trajectory import Trajectory

__all__ = ["command"]

PROGRESS_STEPS = 1000


class _Producers(click.Group):
    """A command for each producer of the registry, made when it is asked for."""

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002
        """Return the names of the producers."""
        from slamfusion.slam.registry import producer_names  # noqa: PLC0415  (loads slowly)

        return list(producer_names())

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return the command of one producer; None where there is none of this name."""
        return _make_command(cmd_name) if cmd_name in self.list_commands(ctx) else None


@click.group("slam", cls=_Producers)
def command() -> None:
    """Run one producer of maps on a log or bag."""


@dataclass(frozen=True)
class _Request:
    """What a run is asked for beside its settings."""

    log: Path
    stem: Path
    relations: Path | None
    odometry: Path | None
    truth: Path | None
    truth_map: Path | None
    report: Path | None
    resume: Path | None = None
    state: Path | None = None
    stop_after: int | None = None
    scan_odometry: Path | None = None
    probabilities: bool = False

    def check(self) -> None:
        """Refuse what cannot end well before any work."""
        if self.odometry is not None and self.relations is None:
            message = "--odometry carries poses to the times of relations; give --relations FILE"
            raise click.UsageError(message)
        given = (
            self.log,
            self.relations,
            self.odometry,
            self.truth,
            self.truth_map,
            self.resume,
            self.scan_odometry,
        )
        inputs = {path.resolve() for path in given if path is not None}
        for path in self.outputs():
            if path.resolve() in inputs:
                what = "--save-state" if path == self.state else f"-o {self.stem}"
                message = f"{what} would replace the input {path}; choose another name"
                raise click.UsageError(message)
        self._check_state()
        check_writable(self.stem.parent)
        if self.report is not None:
            import slamfusion.report  # noqa: F401, PLC0415  (says early when its extra is missing)

            check_writable(self.report)

    def _check_state(self) -> None:
        """Refuse a state that cannot be read, or that cannot be written."""
        if self.resume is not None:
            self.resume.stat()
            if not self.resume.is_file():
                message = f"--resume {self.resume}: not a file; give one that --save-state wrote"
                raise click.UsageError(message)
            self.resume.open("rb").close()
        if self.state is None:
            return
        others = output_files(self.stem, probabilities=self.probabilities)
        if self.report is not None:
            others.append(self.report / "report.html")
        if self.state.resolve() in {path.resolve() for path in others}:
            message = (
                f"--save-state {self.state} is also a file that the run writes; choose another"
            )
            raise click.UsageError(message)
        if self.state.exists() and not self.state.is_file():
            what = "a folder" if self.state.is_dir() else "a device or pipe"
            message = f"--save-state {self.state} is {what}; name a file"
            raise click.UsageError(message)
        check_writable(self.state.parent)

    def outputs(self) -> list[Path]:
        """Return the files that are written: map, path, record, and what else is wanted."""
        files = output_files(self.stem, probabilities=self.probabilities)
        return files if self.state is None else [*files, self.state]


def _stem(out: Path) -> Path:
    """Take ``OUT`` as a stem; a suffix of its files written out by the user is dropped."""
    if out.name in {"", ".."} or out.is_dir():
        message = f"-o {out}: name the map too, e.g. -o {out / 'map'}"
        raise click.UsageError(message)
    return out.with_suffix("") if out.suffix in SUFFIXES else out


def _state_options(*, is_resumable: bool) -> Callable[[Any], Any]:
    """Give the command of a producer that can go on from a file what that takes."""

    def decorate(function: Any) -> Any:
        if not is_resumable:
            return function
        for option in (
            click.option(
                "--stop-after",
                "stop_after",
                type=click.IntRange(min=1),
                metavar="N",
                help="Stop after N scans fed in this run.",
            ),
            file_option(
                "--resume",
                "resume",
                "FILE",
                "Go on from a saved state, with the settings that it was made with; scans of LOG "
                "up to its last one are passed over.",
            ),
            file_option(
                "--save-state",
                "state",
                "FILE",
                "Write at the end everything that a later run needs to go on with --resume.",
            ),
        ):
            function = option(function)
        return function

    return decorate


def _make_command(name: str) -> click.Command:
    """Return the command of one producer; its settings become options."""
    from slamfusion.slam.registry import producer, with_producers  # noqa: PLC0415

    record = producer(name)
    base = with_producers(RunConfig(), [name])

    @click.command(name)
    @click.argument("log", type=click.Path(path_type=Path))
    @click.option(
        "-o",
        "--output",
        "out",
        required=True,
        type=click.Path(path_type=Path),
        metavar="OUT",
        help="Write the map OUT.yaml and OUT.pgm, the path OUT.tum and the record OUT.json.",
    )
    @drive_options("path")
    @file_option("--truth", "truth", "FILE", "The true trajectory: errors of the path.")
    @file_option("--truth-map", "truth_map", "MAP", "The true map: errors of the map.")
    @report_option("report")
    @_state_options(is_resumable=record.load is not None)
    @with_config(f"producers.{name}", "log", "trajectory", "map_files", "device", "", base=base)
    @common_options
    def run(log: Path, out: Path, config: RunConfig, as_json: bool, **asked: Any) -> int:
        request = _Request(log, _stem(out), **asked)
        request.check()
        return _run(name, request, config, as_json=as_json)

    run.help = (
        f"Make a map of the scans in LOG with {name}: a CARMEN or tinySLAM log, or a ROS bag.\n\n"
        f"{record.summary[0].upper()}{record.summary[1:]}.\n\n"
        "Where LOG has no odometry, the robot is expected to go on as it went."
    )
    return run


def _run(name: str, request: _Request, config: RunConfig, *, as_json: bool) -> int:
    """Run, measure, write, print."""
    from slamfusion.evaluation import read_odometry, read_relations  # noqa: PLC0415
    from slamfusion.io import read_trajectory  # noqa: PLC0415
    from slamfusion.slam.registry import open_producer_device  # noqa: PLC0415

    relations = None if request.relations is None else read_relations(request.relations)
    odometry = None if request.odometry is None else read_odometry(request.odometry, config.log)
    truth = None if request.truth is None else read_trajectory(request.truth, config.log)
    truth_map = (
        None
        if request.truth_map is None
        else load_maps([request.truth_map], None, config.map_files)[0]
    )
    device = open_producer_device(name, config)
    producer = _producer(name, request.resume, config, device)
    found = _produce(producer, request, config)
    failed: SlamFusionError | None = None
    evaluation: Evaluation | None = None
    measures = measure_trajectory(found.trajectory, config.trajectory)
    try:
        measures = measure_run(found, config, relations=relations, odometry=odometry, truth=truth)
        if truth_map is not None:
            evaluation = evaluate_maps([found.grid], truth_map, config, device)[0]
    except SlamFusionError as error:  # the map is made; it is kept, then the failure is told
        failed = error
    result = ProducerResult(found, measures, evaluation, device.name)
    document: SlamDocument = {
        "producers": [
            {
                **result.to_json(request.outputs()),
                "resumed_from": path_text(request.resume),
                "state_file": path_text(request.state),
            }
        ],
        "log": str(request.log),
        "relations": path_text(request.relations),
        "odometry_file": path_text(request.odometry),
        "scan_odometry": path_text(request.scan_odometry),
        "truth": path_text(request.truth),
        "truth_map": path_text(request.truth_map),
        "device": device.name,
        "seed": config.seed,
        "config": to_mapping(config),
        "versions": versions(),
    }
    _save(result, producer, document, request, config, truth)
    if failed is not None:
        message = f"{failed} (the map and the path were written all the same)"
        raise SlamFusionError(message) from failed
    for sentence in (*_asked(found, request), *found.doubts()):
        notice(f"{name}: {sentence}")
    if as_json:
        print_json(document)
    else:
        _print(result, request)
    return 0


def _producer(name: str, state: Path | None, config: RunConfig, device: ComputeDevice) -> Mapper:
    """Return the producer, fresh or in a saved state."""
    from slamfusion.slam.registry import make_producer, resume_producer  # noqa: PLC0415

    if state is None:
        return make_producer(name, config, device)
    return resume_producer(name, state, config, device)


def _produce(producer: Mapper, request: _Request, config: RunConfig) -> ProducerRun:
    """Run the producer over the log, with a bar that follows the file."""
    from slamfusion.io import open_log  # noqa: PLC0415
    from slamfusion.slam.common.runner import run_producer  # noqa: PLC0415

    log = open_log(request.log, config.log, request.scan_odometry)
    with progress_bar() as bar:

        def tell(_: int) -> None:
            if bar is not None:
                bar(producer.name, round(PROGRESS_STEPS * log.fraction_read), PROGRESS_STEPS)

        return run_producer(producer, log, log=log, progress=tell, limit=request.stop_after)


def _asked(run: ProducerRun, request: _Request) -> list[str]:
    """Say what was passed over, and that more was to come, because it was asked for so."""
    sentences = []
    if run.known_scans:
        sentences.append(
            f"passed over {run.known_scans} scans of {request.log} that {request.resume} knows"
        )
    if run.stopped_by == "limit":
        sentences.append(
            f"stopped after {len(run.feed_s)} scans, as asked for; the rest of {request.log} is "
            "not in the map"
        )
    return sentences


def _save(
    result: ProducerResult,
    producer: Mapper,
    document: Mapping[str, Any],
    request: _Request,
    config: RunConfig,
    truth: Trajectory | None,
) -> None:
    """Write map, path, record, state and report; all of them or none."""
    from slamfusion.io import AtomicFiles  # noqa: PLC0415

    with AtomicFiles() as files:
        add_run(
            files,
            result.run,
            document,
            request.stem,
            config,
            probabilities=request.probabilities,
        )
        if request.state is not None:
            _add_state(files, request.state, producer)
        if request.report is not None:
            _report(files, result, request, request.report, config, truth)


def _add_state(files: AtomicFiles, target: Path, producer: Mapper) -> None:
    """Stage the state of a producer with the other files."""
    from slamfusion.slam.common.runner import Resumable  # noqa: PLC0415

    if not isinstance(producer, Resumable):
        message = f"{producer.name} cannot save its state"
        raise SlamFusionError(message)
    with TemporaryDirectory(prefix="slamfusion-") as name:
        draft = Path(name) / target.name
        try:
            producer.save_state(draft)
        except MapFileError as error:
            raise MapFileError(str(error).replace(name, str(target.parent))) from None
        files.add(target, draft.read_bytes())


def _report(
    files: AtomicFiles,
    result: ProducerResult,
    request: _Request,
    directory: Path,
    config: RunConfig,
    truth: Trajectory | None,
) -> None:
    """Stage the report: map, path, errors, health."""
    from slamfusion.report import Fact, Table, write_slam_report  # noqa: PLC0415
    from slamfusion.report.page import Cell  # noqa: PLC0415

    run = result.run
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
        request.resume is not None
        and run.odometry is not None
        and run.odometry.stamps_s[0] > run.trajectory.stamps_s[0]
    )
    write_slam_report(
        directory,
        name=run.name,
        grid=run.grid,
        trajectory=run.trajectory,
        config=config,
        facts=facts,
        warnings=[(f"{run.name}:", sentence) for sentence in run.doubts()],
        tables=tables,
        odometry=None if is_later else run.odometry,
        truth=truth,
        relations=result.measures.relations,
        series=run.series,
        other_paths=run.other_paths,
        closures=run.closures,
        device=result.device,
        files=files,
    )


def _print(result: ProducerResult, request: _Request) -> None:
    """Print the numbers, the remarks and the errors."""
    run = result.run
    print_table(
        ("what ", "value "),
        [[name, value] for name, value in result.figures()],
        title=f"{run.name} on {request.log}",
        header=False,
    )
    for where, sentence in run_remarks(run):
        print(f"{where}: {sentence}")
    if result.measures.relations is not None or result.measures.truth is not None:
        print_measures(run.trajectory, result.measures)
    if result.evaluation is not None:
        print_evaluations([result.evaluation])
    for path in request.outputs():
        print(path)
    if request.report is not None:
        print(request.report / "report.html")
