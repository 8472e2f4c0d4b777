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

from slamfusion.align.records import Alignment, AlignmentJson, Bent
from slamfusion.evaluation import DensePoses, DistanceComparison, ErrorStatistics, MapError
from slamfusion.evaluation.relations import RelationErrorsAtScans
from slamfusion.evaluation.trajectory_error import TrajectoryAlignment
from slamfusion.evidence import RankedPath, Recommendation, RefinedPath
from slamfusion.jobs.fuse_documents import DoubledWalls

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
    """Null: it was not aligned."""
    dy_m: None
    """Null: it was not aligned."""
    yaw_rad: None
    """Null: it was not aligned."""
    score: None
    """Null: it was not aligned."""
    overlap: None
    """Null: it was not aligned."""
    error: None
    """Null: it was not aligned."""
    runner_up: None
    """Null: it was not aligned."""
    time_s: None
    """Null: it was not aligned."""
    strength: None
    """Null: it was not aligned."""


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


class FusionJson(TypedDict):
    """What came of a fusion; null and empty values where nothing was fused."""

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


class _PathErrorsJson(TypedDict, total=False):
    ate: ErrorStatistics
    """Absolute errors of place against the truth, metres."""
    ate_rotation_deg: ErrorStatistics
    """Absolute errors of heading against the truth, degrees."""
    rpe: ErrorStatistics | None
    """Relative errors of place, metres a pair; null where the path is too short for a pair."""
    rpe_rotation_deg: ErrorStatistics | None
    """Relative errors of heading, degrees a pair; null where there is no pair."""
    rpe_pairs: int
    """Pairs that the relative errors rest on."""
    rpe_delta: float
    """What a pair spans."""
    rpe_unit: str
    """Unit of what a pair spans: the setting trajectory.rpe_unit."""
    alignment: TrajectoryAlignment
    """What laid the path on the truth."""
    poses_matched: int
    """Poses of the path that met a true one in time."""
    translation: ErrorStatistics
    """Remaining translations on the known relations, metres."""
    rotation_deg: ErrorStatistics
    """Remaining rotations on the known relations, degrees."""
    relations_used: int
    """Relations whose two times met a pose."""
    relations_total: int
    """All relations of the file."""
    odometry: DensePoses | None
    """How poses at the relations' times were composed with odometry; null: they were not."""
    at_scans: RelationErrorsAtScans | None
    """Errors on the relations whose both ends are poses of the path; null: the same or none."""
    tolerance_s: float
    """Poses further apart in time than this do not meet, seconds."""


class PathErrorsJson(_PathErrorsJson, total=False):
    """Errors of a path: against the truth, on known relations, both or none."""

    poses: int
    """Poses of the path."""


class _MeasuresJson(_PathErrorsJson, total=False):
    as_first_reported: PathErrorsJson
    """The same of the path as it was first reported, of a producer that corrects it later."""


class MeasuresJson(_MeasuresJson, total=False):
    """Errors of a path, and of the same path as it was first reported."""

    poses: int
    """Poses of the path."""


class TrajectoryRecordJson(_MeasuresJson):
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


class JudgedPathJson(_MeasuresJson):
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
