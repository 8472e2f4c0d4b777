"""``DriveSolution``: a solution of the drive so far; ``Judgement``: which inputs are right."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from slamfusion.evidence.conditions import Condition, drive_conditions
from slamfusion.evidence.parting import parted, path_gap_m, path_gaps
from slamfusion.evidence.patches import WallMap
from slamfusion.evidence.predictive import SURE, PathEvidence
from slamfusion.evidence.recommendation import LEAST_DIFFERENCE
from slamfusion.fusion.live import Evidence
from slamfusion.geometry import B8, F64, Pose2, fit_motion, moved_poses, with_levers
from slamfusion.grid import OccupancyGrid
from slamfusion.jobs.outputs import FUSED
from slamfusion.trajectory import Trajectory
from slamfusion.vote.lattice import Lattice

# Covariance of a pose that is carried as the last poses of its input were: 5 cm, 0.02 rad.
CARRIED: F64 = np.diag(np.square((0.05, 0.05, 0.02)))
# With too few hits for a pose the odometry gives it: deviation of a way by it, share of the way,
# and of the turn, radians per metre.
DRIFT = 0.1
# A path is aligned with the fused one by each of this number of parts of the drive in turn.
PARTS = 4


@dataclass(frozen=True, eq=False)
class Judgement:
    """What the scans say of the inputs.

    Attributes:
        doubts: bent inputs that the scans contradict, and why.
        conditions: problems of the drive, in words.
        gaps_m: by input, how far its last pose is from the fused path.
        disagreement: mean square, (3, 3), of how far inputs end from the fused path.
    """

    doubts: Mapping[str, str] = field(default_factory=dict)
    conditions: Mapping[Condition, str] = field(default_factory=dict)
    gaps_m: Mapping[str, float] = field(default_factory=dict)
    disagreement: F64 = field(default_factory=lambda: np.zeros((3, 3)))

    @classmethod
    def of(cls, evidence: PathEvidence) -> Judgement:
        """Judge inputs by evidence for them and the fused path."""
        contradicted = _contradicted(evidence)
        return cls(
            _doubts(evidence, contradicted),
            drive_conditions(evidence, FUSED),
            {n: path_gap_m(evidence, n, FUSED)[-1] for n in evidence.scores if n != FUSED},
            _disagreement(evidence, contradicted),
        )


@dataclass(frozen=True, eq=False)
class DriveSolution:
    """A solution of the drive so far.

    Attributes:
        path: the fused path, at the scans that are kept, in the fused frame.
        transforms: carry the newest poses of the inputs onto the path; the input whose last pose is
            nearest to it is first.
        judgement: of the inputs; that of the last solution of the whole drive, or a newer one.
        is_final: whether it is the answer of ``run``.
        lattice, drawn: see ``Evidence``.
        walls: seen by the scans along the path; new scans are matched to them.
        generation: counts the drives; a solution of one that was forgotten is not taken.
    """

    path: Trajectory
    transforms: Mapping[str, Pose2]
    judgement: Judgement
    is_final: bool
    lattice: Lattice
    drawn: OccupancyGrid | None
    walls: WallMap | None
    generation: int

    @property
    def evidence(self) -> Evidence:
        """What the fusion of the maps receives."""
        return Evidence(self.transforms, self.judgement.doubts, self.lattice, self.drawn)

    @property
    def supported(self) -> Mapping[str, Pose2]:
        """The transforms of the inputs that the scans do not contradict."""
        doubts = self.judgement.doubts
        return {name: motion for name, motion in self.transforms.items() if name not in doubts}


def _contradicted(evidence: PathEvidence, by: str = FUSED) -> list[str]:
    """Return the inputs that the scans surely support less than the path ``by``."""
    names = []
    for name in evidence.scores:
        found = None if name in {FUSED, by} else evidence.compare(by, name)
        if found and found.difference > LEAST_DIFFERENCE and found.p_value < SURE:
            names.append(name)
    return names


def _doubts(evidence: PathEvidence, contradicted: Sequence[str]) -> dict[str, str]:
    """Return bent, contradicted inputs and why.

    If all leave the fused path, none confirms it, and only those are returned that the scans surely
    support less than the best input.
    """
    found = {}
    for name in contradicted:
        bent = _bent_at(evidence, name)
        if bent.any():
            since_s = evidence.scans.stamps_s[evidence.is_judged][np.argmax(bent)]
            found[name] = f"the scans contradict its path since stamp {since_s:.1f} s"
    if not found or len(found) < len(evidence.scores) - 1:
        return found
    best = max(found, key=lambda name: evidence.scores[name].consistency)
    return {name: found[name] for name in _contradicted(evidence, best)}


def _bent_at(evidence: PathEvidence, name: str) -> B8:
    """Return at which judged scans a path has parted from the fused one, (M,) bool.

    It is aligned by the first part of the drive that shows it: aligned by most of its poses, a path
    that turns away slowly would part late.
    """
    judged = evidence.is_judged
    moving, still = (evidence.scores[one].poses[judged] for one in (name, FUSED))
    stamps_s = evidence.scans.stamps_s[judged]
    bent = np.zeros(len(still), dtype=np.bool_)
    for part in np.array_split(np.arange(len(still)), PARTS):
        if len(part) and not bent.any():
            motion = fit_motion(with_levers(moving[part]), with_levers(still[part]))
            gap_m = np.hypot(*(moved_poses(motion, moving)[:, :2] - still[:, :2]).T)
            bent = parted(gap_m, stamps_s)
    return bent


def _disagreement(evidence: PathEvidence, contradicted: Sequence[str]) -> F64:
    """Return the mean square, (3, 3), of how far inputs end from the fused path.

    Only of inputs that the scans support as well: the path of the others is known to be wrong. If
    they contradict all, no input confirms the fused path, and all count.
    """
    inputs = [name for name in evidence.scores if name != FUSED]
    names = [name for name in inputs if name not in contradicted] or inputs
    gaps = np.array([path_gaps(evidence, name, FUSED)[-1] for name in names])
    return np.asarray(gaps.T @ gaps / len(gaps))
