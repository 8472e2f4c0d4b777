"""What the commands print with ``--json``: typed documents, and the JSON Schema made of them.

A type ``...Document`` is a whole document. It is composed of records: the dataclasses that hold the
results (see ``slamfusion.json_values``), and types ``...Json`` where a document has more keys or
fewer. The text under a key is its meaning and unit. The document of ``slamfusion experiment`` is
in ``slamfusion.experiments.page``, those of the commands beside the main work in
``tool_records``.

``schema.json`` beside this module holds them all as JSON Schema (2020-12), made of these types by
``python -m tests.support.make_schema``. ``load_schema("fuse")`` is what any validator takes.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any, TypedDict

from slamfusion.align.records import Alignment, AlignmentJson, Bent, FusionResult
from slamfusion.compute.compute_device import DeviceInfo, PoclState
from slamfusion.config import FusionMode, RunConfig
from slamfusion.evaluation import (
    DensePoses,
    DistanceComparison,
    MapError,
    WallThickness,
    doubled_wall_share,
    fused_doubled_shares,
)
from slamfusion.evaluation.relations import RelationErrorsAtScans
from slamfusion.evidence import RankedPath, Recommendation, RefinedPath
from slamfusion.fusion.path_check import PathGap
from slamfusion.jobs.partial import PartialVote
from slamfusion.jobs.run_many import RunOfLog
from slamfusion.slam.records import (
    ProducerRunJson,
)
from slamfusion.vote.tiles import occupied_codes

# --- what many documents share ----------------------------------------------------------------


class FailureDocument(TypedDict):
    """All that a command prints that failed before it had anything to tell; exit code 1."""

    error: str
    """What was wrong, in one line."""


class SettingsJson(TypedDict):
    """What a result depends on beside its inputs."""

    config: Mapping[str, Any]
    """The settings in effect, as --config takes them."""
    versions: Mapping[str, str | None]
    """Versions of Python, of this package and of those it stands on; null: not installed."""


class CircumstancesJson(SettingsJson):
    """What a computed result depends on beside its inputs."""

    device: str
    """What computed it, in words."""
    seed: int
    """Seed of every random number."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Evaluation(MapError):  # noqa: N818  (a measure, no exception)
    """A map's errors, and the alignment with the truth that they rest on."""

    aligned: bool
    """Whether the alignment may be believed; a map taken as it lies counts as aligned."""
    alignment: Alignment | None
    """The alignment with the truth; null: the map was taken as it lies."""


class PlacedJson(TypedDict):
    """The names of one of several maps or paths."""

    case: str
    """What it was measured against: a place, a log or a truth, by name."""
    method: str
    """What made it: what its file's name says besides case and seed."""
    seed: str
    """Number of the repetition of this method in this case; empty for a single one."""


class MethodMeanJson(TypedDict):
    """The means of a method's figures over its cases; of seeds, those of each case come first."""

    method: str
    """The method."""
    cases: int
    """Cases that it was measured in."""
    figures: Mapping[str, float]
    """Means of the figures that are defined in each of these cases, by name."""


class RepetitionsJson(TypedDict):
    """The figures of a method in one case over several seeds."""

    case: str
    """The case."""
    method: str
    """The method."""
    seeds: int
    """Repetitions."""
    figures: Mapping[str, float]
    """Means of the figures that are defined in each of these, by name."""
    std: Mapping[str, float]
    """Their sample standard deviations (divided by N - 1)."""


class SummariesJson(TypedDict):
    """Figures of several maps or paths as means."""

    means: Sequence[MethodMeanJson]
    """The figures of each method over its cases."""
    repetitions: Sequence[RepetitionsJson]
    """The figures of each method over the seeds of one case; empty where none has several."""


# --- fuse -------------------------------------------------------------------------------------


class NoAlignmentJson(TypedDict):
    """The numbers of an alignment that was not made."""

    dx_m: None
    dy_m: None
    yaw_rad: None
    score: None
    overlap: None
    error: None
    runner_up: None
    time_s: None
    strength: None


class InputVoteJson(TypedDict):
    """How an input votes, and how well its walls agree with those of the others."""

    agreement: float | None
    """Share of its walls that agree with the other maps, 0 to 1; null: nothing to compare."""
    weight: float
    """Of its vote in all, 0 to 1; less or more where its walls agree less or more."""
    bent: Bent | None
    """Where it agrees least, if it is bent; null: it agrees with the others."""


class FusedInputJson(AlignmentJson, InputVoteJson):
    """An input of a fusion that was aligned with the reference."""


class UnalignedInputJson(NoAlignmentJson, InputVoteJson):
    """An input of a fusion that was not aligned with the reference."""

    name: str
    """The input."""
    reference: str | None
    """The input whose frame the fused map has; null where nothing was fused."""
    accepted: bool
    """Whether it voted."""
    reason: str
    """Why not."""


@dataclass(frozen=True)
class DoubledWalls:
    """Shares of the wall cells that have a parallel wall close by, the trace of a slip."""

    inputs: dict[str, float]
    """Of each input as it was given, by name; 0 to 1."""
    fused: float
    """Of the fused map, 0 to 1."""
    added_by_fusion: float
    """Of the fused map's wall cells, doubled there and in no input; 0 to 1."""

    @classmethod
    def of(
        cls,
        result: FusionResult,
        config: RunConfig,
        known: Mapping[str, float] | None = None,
    ) -> DoubledWalls:
        """Measure a fusion."""
        known, normalize = known or {}, config.fusion.normalize
        shares = {
            record.name: known[record.name]
            if record.name in known
            else doubled_wall_share(record.grid, normalize=normalize)
            for record in result.inputs
        }
        layers = (record.layer for record in result.accepted if record.layer is not None)
        aligned = ((layer.codes, layer.box) for layer in layers)
        return cls(
            shares,
            *fused_doubled_shares(result.fused.cells, aligned, is_wall=occupied_codes),
        )


class FusionJson(TypedDict):
    """The result of a fusion; null and empty values where nothing was fused."""

    inputs: Sequence[FusedInputJson | UnalignedInputJson]
    """The inputs, in the order given."""
    reference: str | None
    """The input whose frame and lattice the fused map has."""
    fused_count: int
    """Inputs that voted."""
    phantom_cells: int | None
    """Cells occupied in the fused map by vote, and in no input."""
    left_out_m2: Mapping[str, float]
    """Area that inputs know outside of the box of --extent reference, square metres, by input."""
    doubled_wall_share: DoubledWalls | None
    """Shares of the wall cells that have a parallel wall close by."""
    weights: Mapping[str, float]
    """Weight of each voter, 0 to 1, by name; a drawn map votes and is no input."""
    pairs: Sequence[Alignment]
    """Every pair that was aligned, also between rejected inputs."""
    copies: Mapping[str, str]
    """Inputs that are the same map as another, by name, and which of them votes for both."""


class FusedGroupJson(TypedDict):
    """Inputs that share ground, and the map that they became."""

    fused: str | None
    """YAML file of the fused map; null where it is in a store alone."""
    agreement: str | None
    """YAML file of the agreement map; null where it is in a store alone."""
    store: str | None
    """Zarr store of both, with -o OUT.zarr; else null."""
    reference: str
    """The input whose frame and lattice the fused map has."""
    inputs: Sequence[Alignment]
    """How each of them lies to the reference."""
    left_out_m2: Mapping[str, float]
    """Area that inputs know outside of the box of --extent reference, square metres, by input."""
    weights: Mapping[str, float]
    """Weight of each vote, by input."""


class GivenMapsJson(TypedDict):
    """The files of the inputs of a fusion."""

    saved_maps: Sequence[str]
    """In the order of the inputs; empty for maps from memory."""
    resolution: float | None
    """Metres per cell of bare images, as it was given; null: not given."""


class FuseDocument(FusionJson, GivenMapsJson, CircumstancesJson):
    """``slamfusion fuse``."""

    fused: str | None
    """YAML file of the fused map; null where nothing was fused, or it is in a store alone."""
    agreement: str | None
    """YAML file of the agreement map; null where nothing was fused, or it is in a store alone."""
    store: str | None
    """Zarr store of both, with -o OUT.zarr; else null."""
    groups: Sequence[FusedGroupJson]
    """Groups of inputs that share ground, the largest, which is told above, first."""
    evaluations: Sequence[Evaluation]
    """Errors of the inputs and of the fused map, with --truth."""
    time_s: float | None
    """Wall time of the fusion, seconds; null where nothing was fused."""


class FailedFuseDocument(FuseDocument):
    """``slamfusion fuse`` of maps that do not fit, or with --require-all; exit code 1."""

    error: str
    """Why nothing was fused."""


# --- align, evaluate --------------------------------------------------------------------------


class AlignDocument(AlignmentJson, CircumstancesJson):
    """``slamfusion align``; exit code 1 where the alignment is not accepted."""

    resolution: float
    """Metres per cell of the moving map; with --scale as it was found."""
    scale: float | None
    """By which that is larger than the map says; null: without --scale."""


class EvaluateDocument(SettingsJson):
    """``slamfusion evaluate``."""

    maps: Sequence[Evaluation]
    """The maps against the truth; empty without --truth."""
    distances: Sequence[DistanceComparison]
    """The maps against measured distances; empty without --distances."""
    agreement: Sequence[FusedInputJson | UnalignedInputJson]
    """The maps against each other; empty with --truth or --distances."""
    truth: str | None
    """The true map's file; null without --truth."""
    device: str | None
    """What computed the alignments, in words; null where none was."""
    seed: int
    """Seed of every random number."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CaseEvaluation(Evaluation):
    """One of several maps, against one of several truths."""

    case: str
    """The truth that it was measured against, by name."""
    method: str
    """What made it: what its file's name says besides case and seed."""
    seed: str
    """Number of the repetition of this method in this case; empty for a single one."""


class CasesEvaluationDocument(SummariesJson, CircumstancesJson):
    """``slamfusion evaluate`` with several truths."""

    maps: Sequence[CaseEvaluation]
    """The maps in the order given, each against the truth of its case."""
    distances: Sequence[DistanceComparison]
    """The maps against measured distances; empty without --distances."""
    truths: Mapping[str, str]
    """The true maps' files, by case."""


# --- trajectory, slam, run --------------------------------------------------------------------


class PathErrorsJson(TypedDict, total=False):
    """Errors of a path: against the truth, on known relations, both or none."""

    # And the keys of TrajectoryErrors and RelationErrors; see tests/support/make_schema.py.
    odometry: DensePoses | None
    """How poses at the relations' times were composed with odometry; null: they were not."""
    at_scans: RelationErrorsAtScans | None
    """Errors on the relations whose both ends are poses of the path; null: the same or none."""


class MeasuresJson(PathErrorsJson, total=False):
    """Errors of a path, and of the same path as it was first reported."""

    as_first_reported: PathErrorsJson
    """The same of the path as it was first reported, of a producer that corrects it later."""


class TrajectoryRecordJson(MeasuresJson):
    """A trajectory with its errors, and the files that they rest on."""

    name: str
    """The trajectory."""
    path_length_m: float
    """Its length, metres."""
    duration_s: float
    """From its first pose to its last, seconds."""
    poses: int
    """Its poses."""
    estimate: str
    """Its file."""
    relations: str | None
    """The file of known relations."""
    odometry_file: str | None
    """The file of raw odometry."""
    log: str | None
    """The log that the trajectory was made from."""
    truth: str | None
    """The file of the true trajectory."""


class TrajectoryDocument(TrajectoryRecordJson, SettingsJson):
    """``slamfusion trajectory`` of one trajectory."""


class CaseTrajectoryJson(PlacedJson, TrajectoryRecordJson):
    """One of several trajectories."""


class TrajectoriesDocument(SummariesJson, SettingsJson):
    """``slamfusion trajectory`` of several; exit code 1 where something is ``not_measured``."""

    trajectories: Sequence[CaseTrajectoryJson]
    """The trajectories in the order given."""
    not_measured: Sequence[str]
    """What could not be measured, a sentence each."""


class JudgedPathJson(MeasuresJson):
    """A path that was judged, with the errors that could be measured."""

    name: str
    """The path: its file's name without the ending."""
    file: str
    """Its file."""
    poses: int
    """Its poses."""
    path_length_m: float
    """Its length, metres."""


class FusedPathJson(MeasuresJson):
    """The fused path: one path made of those of several SLAMs, and its errors."""

    file: str
    """Its file, a TUM trajectory, of ``run`` in the frame of the fused map, of ``judge`` in that of
    one of the paths."""
    poses: int
    """Its poses."""
    trust: Mapping[str, float]
    """How much each path was believed by what the scans say of it, 0 to 1."""
    excluded_share: Mapping[str, float]
    """Share of each path's poses that had no weight, as it had left the others, 0 to 1."""
    refinement: RefinedPath | None
    """What laying all scans on each other made of it; null where the scans could not be asked."""


class JudgeRecordJson(TypedDict):
    """What the scans of one log say of its paths."""

    recommendation: Recommendation
    """Which path to use, and what to check first."""
    path_evidence: Sequence[RankedPath]
    """What the scans say of each path, the recommended one first."""
    paths: Sequence[JudgedPathJson]
    """The paths as they were given."""
    fused_path: FusedPathJson | None
    """The path fused of them, with ``--fused``."""
    ranking_by_truth: Sequence[str]
    """The paths by their ATE, the least first; empty without a truth."""
    ranking_by_relations: Sequence[str]
    """The paths by their mean error on the relations, the least first; empty without relations."""
    not_measured: Sequence[str]
    """What could not be measured, a sentence each."""
    log: str
    """The log that the paths are of."""
    relations: str | None
    """The file of known relations."""
    odometry_file: str | None
    """The file of raw odometry."""
    scan_odometry: str | None
    """The file that gave the scans their odometry."""
    truth: str | None
    """The file of the true trajectory."""


class JudgeDocument(JudgeRecordJson, CircumstancesJson):
    """``slamfusion judge`` of one log; exit code 1 where something is ``not_measured``."""


class CaseJudgementJson(JudgeRecordJson):
    """One of several logs."""

    case: str
    """Its name."""


class JudgementsDocument(SummariesJson, CircumstancesJson):
    """``slamfusion judge`` of several logs; exit code 1 where something is ``not_measured``."""

    logs: Sequence[CaseJudgementJson]
    """The logs in the order given; paths are named by what made them."""


# --- the schema -------------------------------------------------------------------------------


def load_schema(what: str | None = None) -> dict[str, Any]:
    """Return the JSON Schema (2020-12) of what commands print with ``--json``.

    Args:
        what: the words of a command, e.g. ``fuse`` or ``graph optimize``, or the name of a record,
            e.g. ``Alignment`` or ``RunRecordDocument``; None: any command's document.

    Returns:
        A whole schema, for any validator. ``$defs`` holds an entry for each command, named by its
        words joined by hyphens (``graph-optimize``), and one for each record, named in CapWords.

    Raises:
        KeyError: there is no such command or record.
    """
    text = resources.files("slamfusion.jobs").joinpath("schema.json").read_text(encoding="utf-8")
    schema: dict[str, Any] = json.loads(text)
    if what is None:
        return schema
    name = what.replace(" ", "-")
    if name not in schema["$defs"]:
        raise KeyError(what)
    return {
        **{key: value for key, value in schema.items() if key != "anyOf"},
        "$ref": f"#/$defs/{name}",
    }


# --- slam, run ------------------------------------------------------------------------------------


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


class RunProducerJson(ProducerJson):
    """A producer of ``slamfusion run`` that made a map."""

    failed: None
    process_time_s: float
    """Wall time of its process, seconds."""
    process_cpu_s: float | None
    """Processor time of its process, seconds; null where unknown."""


class FailedProducerJson(TypedDict):
    """A producer of ``slamfusion run`` that made no map."""

    name: str
    """The producer."""
    scans: None
    scans_used: None
    time_s: None
    time_per_scan_ms: None
    peak_memory_mb: None
    health: None
    map_error: None
    files: Sequence[str]
    """Empty: nothing was written."""
    failed: str
    """Why it made no map."""
    process_time_s: float
    """Wall time of its process, seconds."""
    process_cpu_s: float | None
    """Processor time of its process, seconds; null where unknown."""


class DrawnMapJson(TypedDict):
    """The map that is drawn from all scans at the fused path."""

    file: str
    """Its YAML file."""
    doubled_wall_share: float
    """Share of its wall cells that have a parallel wall close by, 0 to 1."""
    wall_thickness_m: WallThickness | None
    """How thick its walls are; null when no wall is beside a free cell."""


class RunFilesJson(LogFilesJson):
    """The files that ``slamfusion run`` was given."""

    saved_maps: Sequence[str]
    """Saved maps that voted too."""


class RunRecordDocument(RunFilesJson, CircumstancesJson):
    """The record NAME.json that ``slamfusion run`` writes beside a producer's map."""

    producers: Sequence[RunProducerJson]
    """The one producer."""


class RunDocument(FusionJson, RunFilesJson, CircumstancesJson):
    """``slamfusion run``; exit code 1 where there is an ``error`` or something ``not_measured``."""

    producers: Sequence[RunProducerJson | FailedProducerJson]
    """What became of each producer."""
    fused: str | None
    """YAML file of the fused map; null where nothing was fused."""
    fused_mode: FusionMode | None
    """How the fused map came to be: by which vote, or drawn; null where nothing was fused."""
    why_voted: str | None
    """Why the maps voted although --mode drawn was asked for; null: it was drawn, or not asked."""
    agreement: str | None
    """YAML file of the agreement map; null where nothing was fused."""
    best_founded: str | None
    """Where nothing was fused, the map of ``recommendation``; else null."""
    partial_votes: Sequence[PartialVote]
    """Producers that have no vote for the time in which they left the others."""
    path_gaps: Sequence[PathGap]
    """Between every two producers' paths in the fused frame."""
    path_evidence: Sequence[RankedPath]
    """What the scans say of each path, the recommended one first; empty where they could not be
    asked."""
    recommendation: Recommendation | None
    """What to use, and what to check first; null if no map was made."""
    no_verdict: str | None
    """Why the scans could not be asked; null where they were."""
    fused_path: FusedPathJson | None
    """The fused path; null where nothing was fused, or fewer than two producers have a path."""
    drawn_map: DrawnMapJson | None
    """The map drawn at the fused path; null where it was not asked for, or there is no path."""
    saved_paths: Sequence[JudgedPathJson]
    """The paths that were given with saved maps, and their errors."""
    evaluations: Sequence[Evaluation]
    """Errors of the inputs and of the fused map, with --truth."""
    error: str | None
    """Why nothing was fused; null where it was."""
    not_measured: Sequence[str]
    """What could not be measured, a sentence each."""
    report: str
    """The page of the report."""
    stages_s: Mapping[str, float]
    """Wall time of each stage, seconds."""
    time_s: float
    """Wall time of all, seconds."""


class RunsDocument(SettingsJson):
    """``slamfusion run`` of several logs; exit code 1 for an ``error`` or ``not_measured``."""

    runs: Sequence[RunOfLog]
    """The logs, in the order given."""


# --- the commands other than the main work --------------------------------------------------------


class GraphOptimizeDocument(SettingsJson):
    """``slamfusion graph optimize``."""

    file: str
    """The pose graph."""
    nodes: int
    """Its vertices."""
    edges: int
    """Its edges."""
    closures: int
    """Of the edges, the ones that close a loop."""
    fixed: Sequence[int]
    """Ids of the vertices that were held."""
    has_poses: bool
    """Whether the file gave the vertices poses; else they were laid along the odometry."""
    skipped_lines: Mapping[str, int]
    """Lines that were not understood, by kind."""
    chi2_start: float
    """Chi-square before, of all edges."""
    chi2: float
    """Chi-square after, of the edges that are no outliers."""
    chi2_all: float
    """Chi-square after, of all edges."""
    iterations: int
    """Steps of the solver."""
    converged: bool
    """Whether the last step changed next to nothing."""
    doubted: Sequence[tuple[int, int]]
    """Ids of both ends of the outliers: closures taken to be false."""
    time_s: float
    """Wall time of the optimisation, seconds."""
    output: str | None
    """The file that the graph was written to."""
    tum: str | None
    """The file that the poses were written to."""


class OdometryEndErrorJson(TypedDict):
    """How far odometry alone is off at the end of a drive."""

    translation_m: float
    """Distance, metres."""
    rotation_deg: float
    """Size of the turn, degrees."""


class SimulatedWorldJson(TypedDict):
    """A drawn place."""

    name: str
    """What kind of place."""
    width_m: float
    """Metres in x."""
    height_m: float
    """Metres in y."""
    resolution: float
    """Metres per cell."""
    people: int
    """People who walk in it."""
    obstacles: int
    """Obstacles that are in no map."""
    glass_cells: int
    """Cells of glass, which the laser often passes."""


class SimulatedDriveJson(TypedDict):
    """A simulated drive in numbers."""

    name: str
    """The course."""
    scans: int
    """Scans of the log."""
    beams: int
    """Readings of a scan."""
    duration_s: float
    """Length of the drive, seconds."""
    path_m: float
    """Its true path, metres."""
    waypoints_left_out: int
    """Planned waypoints that the robot cannot drive to."""
    no_return_share: float
    """Share of the readings without an echo, 0 to 1."""
    odometry_end_error: OdometryEndErrorJson
    """How far odometry alone is off at the end."""
    world: SimulatedWorldJson
    """The place."""


class SimulateDocument(SimulatedDriveJson, CircumstancesJson):
    """``slamfusion simulate``."""

    files: Sequence[str]
    """What was written."""
    time_s: float
    """Wall time, seconds."""


class ShowDocument(TypedDict):
    """What ``slamfusion show`` prints when it starts."""

    url: str
    """Address of the page."""
    maps: list[str]
    """Names of the maps that it shows."""


class LiveLineJson(TypedDict):
    """What a running node says of itself or of an input; a line of its diagnostics."""

    name: str
    """Of the input, or fusion."""
    level: str
    """ok, warn, error or stale."""
    message: str
    """Why, for people."""
    figures: Mapping[str, str]
    """Figures by name, with their units, as the node writes them."""


class LiveStatusDocument(TypedDict):
    """``slamfusion live status``."""

    node: str
    """The node that answered, with its namespace."""
    fusion: LiveLineJson
    """What it says of the fusion."""
    inputs: Sequence[LiveLineJson]
    """What it says of each input."""


class LiveAnswerDocument(TypedDict):
    """``slamfusion live save``, ``reset``, ``set``, ``add`` and ``remove``."""

    success: bool
    """Whether it was done."""
    message: str
    """What was done, or why not; of ``save`` the file."""


class DevicesDocument(TypedDict):
    """``slamfusion devices``."""

    devices: Sequence[DeviceInfo]
    """The OpenCL devices; may be empty."""


class SelfTestJson(TypedDict):
    """A test of the kernels."""

    name: str
    """What was tested."""
    passed: bool
    """Whether it computes as it should."""
    detail: str
    """What was found."""


class DoctorDocument(TypedDict):
    """``slamfusion doctor``; exit code 1 where it is not ``ok``."""

    ok: bool
    """Whether nothing is wrong."""
    problems: Sequence[str]
    """What is wrong and what to do, a sentence each."""
    versions: Mapping[str, str | None]
    """Versions of Python, of this package and of those it stands on; null: not installed."""
    devices: Sequence[DeviceInfo]
    """The OpenCL devices; may be empty."""
    pocl: PoclState | None
    """What became of the PoCL that came with the package; null where no OpenCL was looked at."""
    device: str | None
    """The one that was tested, in words; null where it cannot be opened."""
    self_test: Sequence[SelfTestJson]
    """The tests of the kernels."""
    install: Mapping[str, str]
    """What to install, by maker of the device."""
