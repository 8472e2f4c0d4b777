"""What the page of the main job is made of: values, nothing drawn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from slamfusion.align.records import Alignment, FusionResult
from slamfusion.evaluation import MapError, RelationErrors, TrajectoryErrors
from slamfusion.evidence.predictive import PathEvidence
from slamfusion.evidence.recommendation import Recommendation
from slamfusion.fusion.path_check import PathGap
from slamfusion.grid import OccupancyGrid
from slamfusion.palette import NAMED, Rgb
from slamfusion.report.maps import input_colours
from slamfusion.slam.common.runner import ProducerRun
from slamfusion.trajectory import Trajectory

# What the path is called that is made of those of the producers.
FUSED_PATH = "fused path"


@dataclass(frozen=True, eq=False)
class ReportedRun:
    """One producer that made a map.

    Attributes:
        run: what it made.
        relations: its path's errors on known relations.
        errors: its path's errors against the truth.
        time_s: of its whole process.
        cpu_s: processor time of it.
    """

    run: ProducerRun
    relations: RelationErrors | None = None
    errors: TrajectoryErrors | None = None
    time_s: float | None = None
    cpu_s: float | None = None


@dataclass(frozen=True, eq=False)
class ReportedPath:
    """A path that another SLAM found with its saved map, or the one made of all.

    Attributes:
        path: in the frame of the map, named as it is.
        relations: its errors on known relations.
        errors: its errors against the truth.
    """

    path: Trajectory
    relations: RelationErrors | None = None
    errors: TrajectoryErrors | None = None


@dataclass(frozen=True, eq=False)
class RunReport:
    """Everything that the page shows.

    Attributes:
        log: what was driven.
        runs: the producers that made a map.
        failed: the others, each with its reason.
        result: the fusion; None where nothing was fused.
        mode: how the fused map came to be: ``drawn``, or the mode of the vote; empty: not said.
        failure: why the fused map must not be used, or why there is none; empty where all is well.
        grids: all inputs of the fusion, saved maps included.
        pairs: where nothing was fused, the pairs that were tried.
        gaps: between the paths of producers in the fused frame.
        doubled: shares of doubled walls by name, that of the fused map as ``fused map``.
        fused_path: made of those of the producers, in the fused frame; None where there is none.
        saved_paths: those of saved maps.
        recommendation: what to use; None if no map was made.
        evidence: what the scans say of the paths; None if they could not be asked.
        evaluations: errors of maps against the truth.
        evaluation_alignments: what each of them rests on.
        truth: the true path.
        warnings: what the user must see first, each a subject and a sentence.
        stages: seconds of each stage so far, in order.
        device: what computed the fusion, in words.
    """

    log: str
    runs: Sequence[ReportedRun]
    failed: Sequence[tuple[str, str]] = ()
    result: FusionResult | None = None
    mode: str = ""
    failure: str = ""
    grids: Sequence[OccupancyGrid] = ()
    pairs: Sequence[Alignment] = ()
    gaps: Sequence[PathGap] = ()
    doubled: Mapping[str, float] | None = None
    fused_path: ReportedPath | None = None
    saved_paths: Sequence[ReportedPath] = ()
    recommendation: Recommendation | None = None
    evidence: PathEvidence | None = None
    evaluations: Sequence[MapError] = ()
    evaluation_alignments: Sequence[Alignment | None] = ()
    truth: Trajectory | None = None
    warnings: Sequence[tuple[str, str]] = ()
    stages: Mapping[str, float] = field(default_factory=dict)
    device: str = ""

    @property
    def measured_paths(self) -> list[tuple[str, ReportedRun | ReportedPath]]:
        """The paths of the producers and of saved maps by name, and the one made of them."""
        named: list[tuple[str, ReportedRun | ReportedPath]] = [
            *((item.run.name, item) for item in self.runs),
            *((item.path.name, item) for item in self.saved_paths),
        ]
        if self.fused_path is not None:
            named.append((FUSED_PATH, self.fused_path))
        return named

    @property
    def colours(self) -> dict[str, Rgb]:
        """The colour of each input, of each path, and of the fused one, on all of the page."""
        names = [grid.name for grid in self.grids]
        names += [item.run.name for item in self.runs]
        names += [item.path.name for item in self.saved_paths]
        return {**input_colours(names), FUSED_PATH: NAMED["fused"]}
