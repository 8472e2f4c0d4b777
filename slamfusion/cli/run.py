"""``slamfusion run``: the main job. The producers on one log, their fusion, errors and report."""

from __future__ import annotations

import importlib.util
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from slamfusion.cli.earlier import (
    AGREEMENT,
    FAILED,
    FUSED,
    REPORT,
    earlier_results,
    failure_folder,
    map_files,
    possible_outputs,
    remove_empty,
    report_files,
)
from slamfusion.cli.evaluate import Evaluation, evaluate_maps, print_evaluations
from slamfusion.cli.fused import (
    AllRequiredError,
    DoubledWalls,
    circumstances,
    failure_document,
    fusion_document,
    fusion_sentences,
    print_alignments,
    print_pairs,
)
from slamfusion.cli.inputs import check_writable, load_maps
from slamfusion.cli.options import (
    common_options,
    drive_options,
    file_option,
    map_resolution_option,
    with_config,
)
from slamfusion.cli.output import (
    Progress,
    Settings,
    notice,
    number,
    path_text,
    print_json,
    print_table,
    progress_bar,
)
from slamfusion.cli.produced import (
    ProducerResult,
    add_run,
    measure_run,
    output_files,
)
from slamfusion.cli.trajectory import Measures
from slamfusion.config import FusionConfig, RunConfig, VoteConfig
from slamfusion.errors import AlignmentError, SlamFusionError
from slamfusion.grid import OccupancyGrid

if TYPE_CHECKING:
    from slamfusion.compute import ComputeDevice
    from slamfusion.evaluation import Relations
    from slamfusion.fusion.path_check import PathGap
    from slamfusion.fusion.records import Alignment, FusionResult
    from slamfusion.jobs.records import (
        FailedProducerJson,
        RunDocument,
        RunFilesJson,
        RunProducerJson,
        RunRecordDocument,
    )
    from slamfusion.slam.side_by_side import Outcome
    from slamfusion.trajectory import Trajectory

__all__ = ["command"]

PROGRESS_STEPS = 1000
# On recorded and simulated drives the consensus is nearest to the truth and doubles no walls; see
# the README.
BASE = replace(
    RunConfig(), fusion=replace(FusionConfig(), vote=replace(VoteConfig(), mode="consensus"))
)
# Of what may follow --inputs; no log has such a name.
MAP_SUFFIXES = {".yaml", ".yml", ".pgm", ".png", ".bmp", ".pnm"}


@dataclass(frozen=True)
class _Request:
    """What the job is asked for beside its settings."""

    log: Path
    out: Path
    names: tuple[str, ...]
    maps: tuple[Path, ...]
    resolution: float | None
    truth: Path | None
    truth_trajectory: Path | None
    relations: Path | None
    odometry: Path | None
    scan_odometry: Path | None
    probabilities: bool

    def check(self) -> None:
        """Refuse what cannot end well before any work."""
        if importlib.util.find_spec("matplotlib") is None:
            import slamfusion.report  # noqa: F401, PLC0415  (says what to install)
        if self.odometry is not None and self.relations is None:
            message = "--odometry carries poses to the times of relations; give --relations FILE"
            raise click.UsageError(message)
        if self.out.exists() and not self.out.is_dir():
            message = f"-o {self.out} is not a folder; name one for the maps and the report"
            raise click.UsageError(message)
        given = (
            self.log,
            *self.maps,
            self.truth,
            self.truth_trajectory,
            self.relations,
            self.odometry,
            self.scan_odometry,
        )
        # Also the image of a map that is named by its YAML file.
        inputs = {path.resolve() for path in given if path is not None}
        inputs |= {path.resolve().with_suffix(".pgm") for path in (*self.maps, self.truth) if path}
        for path in self.possible_outputs():
            if path.resolve() in inputs:
                message = f"-o {self.out} would replace the input {path}; choose another folder"
                raise click.UsageError(message)
        check_writable(self.out)

    def possible_outputs(self) -> list[Path]:
        """Return every file that a run into this folder may write or remove, but for reports."""
        return [*possible_outputs(self.out), *possible_outputs(self.out / FAILED)]


@dataclass(frozen=True, eq=False)
class _Yardsticks:
    """What the results are held against; None where nothing was given."""

    truth: OccupancyGrid | None
    path: Trajectory | None
    relations: Relations | None
    odometry: Trajectory | None

    @classmethod
    def read(cls, request: _Request, config: RunConfig) -> _Yardsticks:
        """Read all of them; a file that cannot be read ends the run before it has begun."""
        from slamfusion.evaluation import read_odometry, read_relations  # noqa: PLC0415
        from slamfusion.io import read_trajectory  # noqa: PLC0415

        truth, path = request.truth, request.truth_trajectory
        relations, odometry = request.relations, request.odometry
        return cls(
            None if truth is None else load_maps([truth], request.resolution, config.map_files)[0],
            None if path is None else read_trajectory(path, config.log),
            None if relations is None else read_relations(relations),
            None if odometry is None else read_odometry(odometry, config.log),
        )

    def measure(self, outcome: Outcome, config: RunConfig) -> Measures:
        """Measure a producer's path."""
        if outcome.run is None:
            return Measures()
        return measure_run(
            outcome.run,
            config,
            relations=self.relations,
            odometry=self.odometry,
            truth=self.path,
        )


@dataclass
class _Job:
    """The job as far as it has come.

    Attributes:
        outcomes: what became of each producer.
        grids: the inputs of the fusion: the producers' maps, then the saved ones.
        results: the producers that made a map, with their errors.
        fused: the fusion; None where there is none.
        pairs: what was aligned where nothing was fused.
        gaps: between the producers' paths in the fused frame.
        doubled: the doubled walls of the fusion.
        evaluations: errors of the inputs and of the fused map.
        best_founded: where nothing is fused, the input whose walls the others' fit best; else None.
        failure: why the job is to end with exit code 1; None where it is well.
        troubles: what could not be measured, a sentence each.
        folder: where its files lie.
        stages: seconds of each stage, in order.
        device: what computed the fusion.
        true_path: the true trajectory.
    """

    outcomes: Sequence[Outcome]
    grids: list[OccupancyGrid]
    device: str
    folder: Path
    true_path: Trajectory | None = None
    results: dict[str, ProducerResult] = field(default_factory=dict)
    fused: FusionResult | None = None
    pairs: tuple[Alignment, ...] = ()
    gaps: tuple[PathGap, ...] = ()
    doubled: DoubledWalls | None = None
    evaluations: list[Evaluation] = field(default_factory=list)
    best_founded: str | None = None
    failure: SlamFusionError | None = None
    troubles: list[str] = field(default_factory=list)
    stages: dict[str, float] = field(default_factory=dict)

    @property
    def failed(self) -> list[Outcome]:
        """The producers that made no map."""
        return [outcome for outcome in self.outcomes if outcome.run is None]

    @property
    def usable(self) -> FusionResult | None:
        """The fusion where it may be used."""
        return None if self.failure is not None else self.fused


class _ManyInputs(click.Command):
    """A command that takes ``--inputs A.yaml B.yaml`` for ``--inputs A.yaml --inputs B.yaml``."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Put ``--inputs`` before each map that follows another one."""
        spread: list[str] = []
        wants, may_follow = False, False
        for argument in args:
            if wants:
                wants, may_follow = False, True
            elif argument == "--inputs":
                wants, may_follow = True, False
            elif may_follow and Path(argument).suffix in MAP_SUFFIXES:
                spread.append("--inputs")
            else:
                may_follow = False
            spread.append(argument)
        return super().parse_args(ctx, spread)


@click.command("run", cls=_ManyInputs)
@click.argument("log", type=click.Path(path_type=Path))
@click.option(
    "-o",
    "--output",
    "out",
    required=True,
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="Write here: each producer's map, path and record, the fused map, and report/.",
)
@click.option(
    "--inputs",
    "maps",
    multiple=True,
    type=click.Path(path_type=Path),
    metavar="MAP",
    help="Saved maps of other SLAMs that vote too: one or several.",
)
@file_option("--truth", "truth", "MAP", "The true map: errors of every map and the fused one.")
@file_option(
    "--truth-trajectory", "truth_trajectory", "FILE", "The true trajectory: errors of the paths."
)
@drive_options("paths")
@map_resolution_option
@with_config(
    "run",
    "fusion",
    "fusion.normalize",
    "fusion.align",
    "fusion.vote",
    "map_files",
    "log",
    "evaluate",
    "trajectory",
    "device",
    "",
    base=BASE,
)
@common_options
def command(log: Path, out: Path, config: RunConfig, as_json: bool, **asked: Any) -> int:
    """Map the scans in LOG with all producers side by side, fuse their maps, report.

    LOG is a CARMEN or tinySLAM log, or a ROS bag. A producer that fails is named and left out; at
    least two maps have to fit each other. Settings of the producers stand in --config.

    A fused map with everything beside it replaces the results of an earlier run in DIR, all at
    once. A run without one leaves them as they are; what it made goes to DIR/failed then.
    """
    from slamfusion.slam.registry import BUILT_IN, with_producers  # noqa: PLC0415

    names = config.run.producers or BUILT_IN
    config = with_producers(config, names)
    request = _Request(log, out, names, **asked)
    request.check()
    debug = click.get_current_context().ensure_object(Settings).debug
    return _run(request, config, as_json=as_json, debug=debug)


def _run(request: _Request, config: RunConfig, *, as_json: bool, debug: bool) -> int:
    """Produce, fuse, measure, write, print."""
    begun_s = time.perf_counter()
    job = _work(request, config, begun_s)
    files = _save(job, request, config)
    document = _document(job, request, config, files, time.perf_counter() - begun_s)
    _tell(job, debug=debug)
    if as_json:
        print_json(document)
    else:
        _print(job, request, document["time_s"])
    if job.failure is not None:
        raise SlamFusionError(_kept(str(job.failure), job, request))
    if job.troubles:
        raise SlamFusionError(_kept("; ".join(job.troubles), job, request))
    return 0


def _kept(reason: str, job: _Job, request: _Request) -> str:
    """Say where what was made lies, and what stays beside it."""
    earlier = "" if job.folder == request.out else f"; {request.out} keeps its earlier results"
    return f"{reason} (what was made lies in {job.folder}{earlier})"


def _work(request: _Request, config: RunConfig, begun_s: float) -> _Job:
    """Run the producers, then everything that needs their maps."""
    from slamfusion.slam.side_by_side import SideBySide  # noqa: PLC0415

    with SideBySide(request.names, request.log, config, request.scan_odometry) as side_by_side:
        # Prepared while the producers are at work: what is wrong ends the run at once.
        import slamfusion.report.run_report  # noqa: F401, PLC0415

        yardsticks = _Yardsticks.read(request, config)
        maps = load_maps(request.maps, request.resolution, config.map_files)
        device = _open(config)
        with progress_bar() as bar:

            def tell(name: str, share: float) -> None:
                if bar is not None:
                    bar(name, round(PROGRESS_STEPS * share), PROGRESS_STEPS)

            outcomes = side_by_side.wait(tell)
    grids = [outcome.run.grid for outcome in outcomes if outcome.run is not None]
    job = _Job(outcomes, [*grids, *_renamed(maps)], device.name, request.out, yardsticks.path)
    job.stages["producers"] = time.perf_counter() - begun_s
    with progress_bar() as bar:
        began_s = time.perf_counter()
        _fuse(job, request, config, device, bar)
        job.stages["fusion"] = time.perf_counter() - began_s
        began_s = time.perf_counter()
        _measure(job, yardsticks, config, device, bar)
        job.stages["errors"] = time.perf_counter() - began_s
    return job


def _open(config: RunConfig) -> ComputeDevice:
    """Return the device of the fusion."""
    from slamfusion.compute import open_device  # noqa: PLC0415

    return open_device(config.device.device)


def _renamed(maps: Sequence[OccupancyGrid]) -> list[OccupancyGrid]:
    """Return saved maps under names that no producer has."""
    from slamfusion.slam.registry import producer_names  # noqa: PLC0415

    taken = {*producer_names(), FUSED}
    return [grid.with_name(f"{grid.name} (saved)") if grid.name in taken else grid for grid in maps]


def _fuse(
    job: _Job, request: _Request, config: RunConfig, device: ComputeDevice, bar: Progress | None
) -> None:
    """Fuse the maps, and hold the producers' paths against each other in the fused frame.

    All producers begin in one frame, the odometry's. The search is full all the same: a lost
    producer must not be pulled into place. The common frame only decides between answers that fit
    equally well, in places that look alike under two turns. Saved maps may have any frame, so with
    them the settings decide.
    """
    from slamfusion.fusion.path_check import (  # noqa: PLC0415
        LEAST_FUSED,
        PathsApartError,
        best_founded,
        fuse_with_paths,
    )
    from slamfusion.slam.registry import loop_closers  # noqa: PLC0415

    count = len(job.grids)
    if count < LEAST_FUSED:
        job.best_founded = job.grids[0].name if job.grids else None
        reasons = "; ".join(f"{outcome.name}: {outcome.reason}" for outcome in job.failed)
        message = f"{count or 'none'} of {len(request.names) + len(request.maps)} maps was made"
        job.failure = SlamFusionError(
            f"{message}, at least {LEAST_FUSED} are needed for a vote{reasons and f' ({reasons})'}"
        )
        return
    fusion = config.fusion
    if not request.maps:
        fusion = replace(fusion, align=replace(fusion.align, shared_frame=True))
    paths = {item.name: item.run.trajectory for item in job.outcomes if item.run is not None}
    try:
        job.fused, job.gaps = fuse_with_paths(
            job.grids, paths, fusion, config.run.path_gap_m, device, bar
        )
    except AlignmentError as error:
        job.best_founded = best_founded(job.grids, error.pairs, loop_closers(paths)).name
        job.failure = AlignmentError(
            f"{error}; the map to go on with is that of {job.best_founded}, the best founded",
            error.pairs,
        )
        job.pairs = error.pairs
        job.gaps = error.gaps if isinstance(error, PathsApartError) else ()
        return
    if config.fusion.require_all and (job.fused.rejected or job.failed):
        job.failure = (
            AllRequiredError(job.fused)
            if job.fused.rejected
            else SlamFusionError(
                f"--require-all, but no map of {', '.join(item.name for item in job.failed)}"
            )
        )


def _measure(
    job: _Job,
    yardsticks: _Yardsticks,
    config: RunConfig,
    device: ComputeDevice,
    bar: Progress | None,
) -> None:
    """Measure every map and path; what cannot be measured does not take the rest with it."""
    if job.fused is not None:
        job.doubled = DoubledWalls.of(job.fused, config)
    evaluated: dict[str, Evaluation] = {}
    if yardsticks.truth is not None and job.grids:
        judged = list(job.grids)
        if job.fused is not None:
            judged.append(job.fused.fused.with_name(FUSED))
        try:
            job.evaluations = evaluate_maps(judged, yardsticks.truth, config, device, progress=bar)
        except SlamFusionError as error:
            job.troubles.append(str(error))
        evaluated = {item.error.name: item for item in job.evaluations}
    for outcome in job.outcomes:
        if outcome.run is None:
            continue
        measures = Measures()
        try:
            measures = yardsticks.measure(outcome, config)
        except SlamFusionError as error:
            job.troubles.append(f"{outcome.name}: {error}")
        evaluation = evaluated.get(outcome.name)
        job.results[outcome.name] = ProducerResult(
            outcome.run, measures, evaluation, outcome.device
        )


# --- files ------------------------------------------------------------------------------------


def _save(job: _Job, request: _Request, config: RunConfig) -> dict[str, list[Path]]:
    """Write all files together or none; with them goes what an earlier run left beside them.

    A map of an earlier run beside those of this one would be taken for one of them. So a run that
    made a fused map replaces everything of an earlier one, and one that made none writes into a
    folder of its own where there are results already. That there was an earlier run is told by its
    report; without one nothing is removed.

    Returns:
        The files of each producer, of the fused map and of the report.
    """
    from slamfusion.io import AtomicFiles, save_map  # noqa: PLC0415
    from slamfusion.report.run_report import write_run_report  # noqa: PLC0415

    if job.usable is None:
        earlier = [*possible_outputs(request.out), *report_files(request.out / REPORT)]
        job.folder = failure_folder(request.out, earlier)
    failed = request.out / FAILED
    written: dict[str, list[Path]] = {}
    with AtomicFiles() as files:
        for name, result in job.results.items():
            stem = job.folder / name
            written[name] = output_files(stem, probabilities=request.probabilities)
            document: RunRecordDocument = {
                "producers": [_made(job, name, written[name])],
                **_asked(request),
                **circumstances(config, result.device),
            }
            add_run(files, result.run, document, stem, config, probabilities=request.probabilities)
        if job.usable is not None:
            for name, grid, mode in (
                (FUSED, job.usable.fused, "trinary"),
                (AGREEMENT, job.usable.agreement, "raw"),
            ):
                stem = job.folder / name
                save_map(grid, stem, mode=mode, files=files)
                written[name] = map_files(stem)
        began_s = time.perf_counter()
        page = write_run_report(
            _reported(job, request), job.folder / REPORT, config=config, files=files
        )
        job.stages["report"] = time.perf_counter() - began_s
        written[REPORT] = [page]
        kept = {path for paths in written.values() for path in paths}
        folders = [job.folder] if job.usable is None else [request.out, failed]
        for path in earlier_results(folders):
            if path not in kept and path not in report_files(job.folder / REPORT):
                files.remove(path)
    if job.usable is not None:
        remove_empty(failed / REPORT, failed)
    return written


def _reported(job: _Job, request: _Request) -> Any:
    """Return what the report shows."""
    from slamfusion.report.run_report import ReportedRun, RunReport  # noqa: PLC0415

    runs = [
        ReportedRun(
            outcome.run,
            job.results[outcome.name].measures.relations,
            job.results[outcome.name].measures.truth,
            outcome.time_s,
            outcome.cpu_s,
        )
        for outcome in job.outcomes
        if outcome.run is not None
    ]
    warnings = [(f"{item.run.name}:", doubt) for item in runs for doubt in item.run.doubts()]
    warnings += [("Not measured:", trouble) for trouble in job.troubles]
    return RunReport(
        log=str(request.log),
        runs=runs,
        failed=[(outcome.name, outcome.reason) for outcome in job.failed],
        result=job.fused,
        failure="" if job.failure is None else str(job.failure),
        grids=job.grids,
        pairs=job.pairs,
        gaps=job.gaps,
        doubled=None
        if job.doubled is None
        else (job.doubled.inputs | {"fused map": job.doubled.fused}),
        evaluations=[item.error for item in job.evaluations],
        evaluation_alignments=[item.alignment for item in job.evaluations],
        truth=job.true_path,
        warnings=warnings,
        stages=job.stages,
        device=job.device,
    )


# --- what is said -----------------------------------------------------------------------------


def _asked(request: _Request) -> RunFilesJson:
    """Return the files that the run was given, for a JSON document."""
    return {
        "log": str(request.log),
        "relations": path_text(request.relations),
        "odometry_file": path_text(request.odometry),
        "scan_odometry": path_text(request.scan_odometry),
        "truth": path_text(request.truth_trajectory),
        "truth_map": path_text(request.truth),
        "saved_maps": [str(path) for path in request.maps],
    }


def _record(
    job: _Job, outcome: Outcome, files: Sequence[Path]
) -> RunProducerJson | FailedProducerJson:
    """Return a producer's record; of one that made no map, why."""
    if outcome.name in job.results:
        return _made(job, outcome.name, files)
    return {
        "name": outcome.name,
        "scans": None,
        "scans_used": None,
        "time_s": None,
        "time_per_scan_ms": None,
        "peak_memory_mb": None,
        "health": None,
        "map_error": None,
        "files": [],
        "failed": outcome.reason,
        "process_time_s": outcome.time_s,
        "process_cpu_s": outcome.cpu_s,
    }


def _made(job: _Job, name: str, files: Sequence[Path]) -> RunProducerJson:
    """Return the record of a producer that made a map."""
    outcome = next(item for item in job.outcomes if item.name == name)
    return {
        **job.results[name].to_json(files),
        "failed": None,
        "process_time_s": outcome.time_s,
        "process_cpu_s": outcome.cpu_s,
    }


def _document(
    job: _Job,
    request: _Request,
    config: RunConfig,
    files: dict[str, list[Path]],
    time_s: float,
) -> RunDocument:
    """Return the JSON document."""
    usable, failure = job.usable, job.failure
    fusion = (
        failure_document(job.grids, job.pairs, str(failure))
        if usable is None or job.doubled is None
        else fusion_document(usable, job.doubled)
    )
    return {
        "producers": [
            _record(job, outcome, files.get(outcome.name, [])) for outcome in job.outcomes
        ],
        **fusion,
        "fused": None if usable is None else str(files[FUSED][0]),
        "agreement": None if usable is None else str(files[AGREEMENT][0]),
        "best_founded": job.best_founded,
        "path_gaps": [gap.to_json() for gap in job.gaps],
        "evaluations": [item.to_json() for item in job.evaluations],
        "error": None if failure is None else str(failure),
        "not_measured": job.troubles,
        "report": str(files[REPORT][0]),
        **_asked(request),
        **circumstances(config, job.device),
        "stages_s": job.stages,
        "time_s": time_s,
    }


def _tell(job: _Job, *, debug: bool) -> None:
    """Name on stderr what was left out, and what is doubtful."""
    for outcome in job.failed:
        notice(f"no map: {outcome.name}: {outcome.reason}")
        if debug and outcome.detail:
            print(outcome.detail, file=sys.stderr)
    for record in job.fused.rejected if job.fused is not None else ():
        notice(f"rejected: {record.name}: {record.reason}")
    for name, result in job.results.items():
        for sentence in result.run.doubts():
            notice(f"{name}: {sentence}")


def _print(job: _Job, request: _Request, time_s: float) -> None:
    """Print the producers, the alignment, the errors, and where everything lies."""
    _print_producers(job, request)
    if job.usable is not None and job.doubled is not None:
        print_alignments(job.usable)
        for sentence in fusion_sentences(job.usable, job.doubled):
            print(sentence)
        for gap in job.gaps:
            print(
                f"paths in the fused map: {gap.a} and {gap.b} are {gap.median_m:.2f} m apart "
                f"(median), {gap.max_m:.2f} m at most"
            )
        print()
    elif job.pairs:
        print_pairs(job.pairs, job.device)
    if job.evaluations:
        print_evaluations(job.evaluations)
    stages = ", ".join(f"{name} {seconds:.1f}" for name, seconds in job.stages.items())
    print(f"time:      {time_s:.1f} s ({stages})")
    if job.usable is not None:
        print(f"fused map: {job.folder / FUSED}.yaml")
        print(f"agreement: {job.folder / AGREEMENT}.yaml")
    print(f"report:    {job.folder / REPORT / 'report.html'}")


def _print_producers(job: _Job, request: _Request) -> None:
    """Print a row for each producer, with the errors that are known."""
    with_relations = any(item.measures.relations for item in job.results.values())
    with_truth = any(item.measures.truth for item in job.results.values())
    columns = ["producer ", "scans", "used", "s", "ms a scan", "95 %", "MB", "match score"]
    columns += ["relations m", "deg"] if with_relations else []
    columns += ["ATE m", "deg"] if with_truth else []
    rows = []
    for outcome in job.outcomes:
        result = job.results.get(outcome.name)
        if result is None:
            rows.append([outcome.name, *["-"] * (len(columns) - 1), f"NO MAP: {outcome.reason}"])
            continue
        run, measures = result.run, result.measures
        time_ms = run.time_per_scan_ms()
        row = [
            run.name,
            str(run.scans),
            str(run.scans_used),
            number(run.time_s, 1),
            number(time_ms["mean"], 2),
            number(time_ms["p95"], 2),
            number(run.peak_memory_bytes / 1e6, 1),
            number(run.health.mean_match_score),
        ]
        if with_relations:
            errors = measures.relations
            row += [
                number(None if errors is None else errors.translation.mean, 4),
                number(None if errors is None else errors.rotation_deg.mean, 3),
            ]
        if with_truth:
            found = measures.truth
            row += [
                number(None if found is None or found.ate is None else found.ate.rmse, 4),
                number(None if found is None else found.ate_rotation_deg.rmse, 3),
            ]
        rows.append([*row, "made a map"])
    print_table([*columns, "what "], rows, title=f"Producers on {request.log}")
