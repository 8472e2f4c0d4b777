"""How far the scans alone tell right paths from wrong ones, on simulated drives.

    python -m tests.benchmarks.bench_evidence --drives out/drives --worlds 1,101 --make
    python -m tests.benchmarks.bench_evidence --drives out/drives --worlds 1 --lidars rplidar

Validity: the true path, made wrong in a known way, must score below the true path; and the true
path should be the best of all, or not to be told from it. Choice: ATE of the producer whose path is
taken (``choose_path``) over that of the best one in hindsight, beside the one whose path scores
best and always the same one; then with the fused path as one more candidate, and one more to be
best. Intervals are 95 % of a bootstrap that draws whole courses of a world. A kidnapping is cut at
the place where the robot was carried away, and each segment is a drive of its own.

Drives are those of the ``failures`` experiment, kept in a folder each, named
CONDITION[-HARMED],LASER-wWORLD-sSEED: scans.pickle, what the robot recorded; truth.tum; NAME.tum of
each producer; and drive.json, which is written last. Where a fault befalls one producer
(``harmed``), only that one was fed other scans; a kidnapping befalls all.
"""

from __future__ import annotations

import itertools
import json
import math
import pickle
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
import scipy
from rich.table import Table

from slamfusion.compute import ComputeDevice, open_device
from slamfusion.config import FailuresConfig, RunConfig
from slamfusion.evaluation.trajectory_error import trajectory_errors
from slamfusion.evidence.beams import judged_scans
from slamfusion.evidence.displacement import (
    find_contradiction,
    find_displacements,
    find_place_seen_before,
)
from slamfusion.evidence.parting import PART_M
from slamfusion.evidence.predictive import score_paths
from slamfusion.evidence.recommendation import choose_path
from slamfusion.experiments.fusions import produce_maps
from slamfusion.experiments.trials import FAILURES, FAULTS, Trial, failure_trials, true_path
from slamfusion.geometry import F64, compose_poses, invert_poses
from slamfusion.io import LogScan, read_trajectory, write_tum
from slamfusion.jobs.fused_path import fuse_weighed_paths
from slamfusion.sim import simulate
from slamfusion.slam.registry import BUILT_IN
from slamfusion.trajectory import Trajectory
from tests.benchmarks.record import bench_parser, console_for

TRUTH, FUSED = "truth", "fused"
# Drives of this condition are cut where the true path jumps by this, metres.
KIDNAPPING, JUMP_M = "kidnapping", 1.0
DRAWS = 2000


@dataclass(frozen=True, eq=False)
class Drive:
    """A simulated drive as it is kept.

    Attributes:
        key: name of its folder.
        trial: the record of it: condition, lidar, world, seed, fault, harmed.
        scans: what the robot recorded.
        truth: the true path.
        paths: by producer.
    """

    key: str
    trial: dict[str, str]
    scans: tuple[LogScan, ...]
    truth: Trajectory
    paths: dict[str, Trajectory]


def drive_trials(worlds: Sequence[int], lidars: Sequence[str]) -> Iterator[Trial]:
    """Yield the drives of ``failures``: each fault of one producer befalls each of them in turn.

    Each course has seeds of its own.
    """
    for world, (index, course) in itertools.product(worlds, enumerate(FAILURES)):
        failures = FailuresConfig(
            repetitions=1,
            first_world=world,
            courses=(course,),
            lidars=tuple(name for name in ("kinect", "hokuyo", "rplidar") if name in lidars),
        )
        config = RunConfig(seed=1 + 10 * index)
        config = replace(config, experiment=replace(config.experiment, failures=failures))
        for trial in failure_trials(config):
            for harmed in BUILT_IN if trial.harmed else ("",):
                yield replace(trial, harmed=harmed)


def key_of(trial: Trial) -> str:
    """Return the name of a drive's folder."""
    course, lidar = trial.condition.split(", ")
    name = f"{course} {trial.harmed}".strip().replace(" ", "-")
    return f"{name},{lidar}-w{trial.course.world.seed}-s{trial.course.seed}"


def make_drive(trial: Trial, folder: Path, device: ComputeDevice) -> Path:
    """Simulate a drive, run the producers on it and keep everything; does nothing where it is.

    Returns:
        The drive's folder.
    """
    target = folder / key_of(trial)
    if (target / "drive.json").exists():
        return target
    target.mkdir(parents=True, exist_ok=True)
    recording = simulate(trial.course, device)
    scans = faulty = recording.scans
    if trial.fault:
        faulty = FAULTS[trial.fault](scans)
    truth = recording.truth
    if not trial.harmed:
        # A kidnapping cuts out a part.
        truth, scans = true_path(recording, faulty), faulty
    fed = {name: faulty if trial.harmed in {"", name} else scans for name in BUILT_IN}
    made = produce_maps(fed, RunConfig(seed=trial.course.seed), device)
    (target / "scans.pickle").write_bytes(pickle.dumps(scans))
    write_tum(target / "truth.tum", truth)
    for name, path in made.paths.items():
        write_tum(target / f"{name}.tum", path)
    course, lidar = trial.condition.split(", ")
    record = {
        "condition": course,
        "lidar": lidar,
        "world": str(trial.course.world.seed),
        "seed": str(trial.course.seed),
        "fault": trial.fault,
        "harmed": trial.harmed,
    }
    (target / "drive.json").write_text(json.dumps(record), encoding="utf-8")
    return target


def read_drive(folder: Path) -> Drive:
    """Read a drive that is kept; OSError: it is not whole."""
    trial = json.loads((folder / "drive.json").read_text(encoding="utf-8"))
    paths = {
        name: replace(read_trajectory(folder / f"{name}.tum"), name=name)
        for name in BUILT_IN
        if (folder / f"{name}.tum").exists()
    }
    scans = pickle.loads((folder / "scans.pickle").read_bytes())  # noqa: S301  (our own)
    return Drive(folder.name, trial, scans, read_trajectory(folder / "truth.tum"), paths)


def moved_from(path: Trajectory, share: float, motion: Sequence[float]) -> Trajectory:
    """Return a path that is moved from a share of it on, by a motion in the robot's frame there."""
    first = int(share * len(path))
    at = path.poses[first]
    about = compose_poses(compose_poses(at, np.array(motion)), invert_poses(at))
    poses = path.poses.copy()
    poses[first:] = compose_poses(about, poses[first:])
    return Trajectory(path.stamps_s, poses)


def drifted(path: Trajectory, share: float) -> Trajectory:
    """Return a path whose every step is longer by a share."""
    start = np.append(path.poses[0, :2], 0.0)
    scale = np.array([1.0 + share, 1.0 + share, 1.0])
    return Trajectory(path.stamps_s, (path.poses - start) * scale + start)


# A true path made wrong.
WRONG: dict[str, Callable[[Trajectory], Trajectory]] = {
    "torn in two, 100 m apart": lambda path: moved_from(path, 0.5, (0.0, 100.0, 0.0)),
    "torn in two, 0.5 m apart": lambda path: moved_from(path, 0.5, (0.0, 0.5, 0.0)),
    "torn in two, 3 m apart": lambda path: moved_from(path, 0.5, (0.0, 3.0, 0.0)),
    "last 7 % shifted by 2 m": lambda path: moved_from(path, 0.93, (0.0, 2.0, 0.0)),
    "turned by 10 degrees half-way": lambda path: moved_from(path, 0.5, (0, 0, math.radians(10))),
    "drifted by 5 %": lambda path: drifted(path, 0.05),
    "standing still from a quarter on": lambda path: Trajectory(
        path.stamps_s, path.poses[np.arange(len(path)).clip(max=len(path) // 4)]
    ),
}


@dataclass
class Found:
    """What was found on one drive, or on a segment of one.

    Attributes:
        key: of the drive.
        condition, lidar, world, harmed: of it.
        scores: by path, the truth and the wrong ones among them.
        worse: verdict of each wrong path against the truth.
        contradicted: the paths that the scans contradict, each judged alone.
        tied: the best of truth and producers, and what cannot be told from it.
        ate_m: by producer, and of the path fused of them.
        taken: the producer whose path is taken.
        pairs: (better by evidence, of the two the nearer to the truth) of producers told apart.
    """

    key: str
    condition: str
    lidar: str
    world: str
    harmed: str
    scores: dict[str, float]
    worse: dict[str, str]
    contradicted: tuple[str, ...]
    tied: tuple[str, ...]
    ate_m: dict[str, float]
    taken: str
    pairs: list[tuple[str, str]] = field(default_factory=list)

    def chosen(self, *, with_fused: bool = False) -> str:
        """Return the path that scores best, of the producers' or with the fused one among them."""
        return max(self.candidates(with_fused=with_fused), key=self.scores.__getitem__)

    def candidates(self, *, with_fused: bool = False) -> list[str]:
        """Return the producers that made a path, and the fused path where asked for."""
        return [name for name in self.ate_m if with_fused or name != FUSED]

    def ratio(self, name: str, *, with_fused: bool = False) -> float:
        """ATE of a path over that of the best in hindsight; NaN where there is none.

        The best is one of the producers, or with the fused one among them.
        """
        best_m = min(self.ate_m[other] for other in self.candidates(with_fused=with_fused))
        return self.ate_m.get(name, math.nan) / best_m


def segments(
    scans: Sequence[LogScan], truth: Trajectory, is_cut: bool
) -> Iterator[tuple[Sequence[LogScan], Trajectory]]:
    """Yield the parts of a drive that are judged each for itself."""
    steps = np.hypot(*np.diff(truth.poses[:, :2], axis=0).T)
    cuts = [0, *(np.flatnonzero(steps > JUMP_M) + 1), len(truth)] if is_cut else [0, len(truth)]
    for first, last in itertools.pairwise(cuts):
        part = np.s_[first:last]
        yield scans[part], Trajectory(truth.stamps_s[part], truth.poses[part], TRUTH)


def between(path: Trajectory, first_s: float, last_s: float) -> Trajectory:
    """Return the poses of a path within a time."""
    kept = (path.stamps_s >= first_s - 1e-6) & (path.stamps_s <= last_s + 1e-6)
    return Trajectory(path.stamps_s[kept], path.poses[kept], path.name)


def judge_drive(folder: Path, device: ComputeDevice) -> Iterator[Found]:
    """Yield what is found on a drive, or on each segment of it."""
    drive = read_drive(folder)
    condition = drive.trial["condition"]
    for scans, truth in segments(drive.scans, drive.truth, condition == KIDNAPPING):
        span = truth.stamps_s[0], truth.stamps_s[-1]
        parts = {name: between(path, *span) for name, path in drive.paths.items()}
        parts = {name: path for name, path in parts.items() if len(path) > 1}
        wrong = {name: change(truth) for name, change in WRONG.items()}
        judged = judged_scans(scans)
        alone = score_paths(judged, parts, device)
        fused = {FUSED: fuse_weighed_paths(parts, alone)[0].trajectory}
        evidence = score_paths(judged, {TRUTH: truth, **parts, **fused, **wrong}, device)
        contest = evidence.of_paths((TRUTH, *parts))
        best, *others = contest.ranking()
        behind = [name for name in others if contest.compare(best, name).verdict == "better"]
        _, taken, _ = choose_path(evidence.of_paths((*parts, FUSED)), parts, FUSED)
        ate_m = {
            name: trajectory_errors(path, truth).ate.rmse for name, path in (parts | fused).items()
        }
        found = Found(
            drive.key,
            condition,
            drive.trial["lidar"],
            drive.trial["world"],
            drive.trial["harmed"],
            {name: score.consistency for name, score in evidence.scores.items()},
            {name: evidence.compare(name, TRUTH).verdict for name in WRONG},
            tuple(
                name
                for name in evidence.scores
                if any(part.away_m >= PART_M for part in find_displacements(evidence, name))
                or find_place_seen_before(evidence, name) is not None
                or find_contradiction(evidence, name) is not None
            ),
            (best, *(name for name in others if name not in behind)),
            ate_m,
            taken,
        )
        for a, b in itertools.combinations(parts, 2):
            verdict = evidence.compare(a, b).verdict
            if verdict != "cannot tell":
                best = a if verdict == "better" else b
                found.pairs.append((best, min((a, b), key=ate_m.__getitem__)))
        yield found


def clustered(ratios: F64, clusters: Sequence[str], statistic: Callable[[F64], float]) -> str:
    """Return a statistic with the interval of a bootstrap that draws whole clusters."""
    names = sorted(set(clusters))
    members = [np.flatnonzero([own == name for own in clusters]) for name in names]
    rng = np.random.default_rng(0)
    drawn = [
        statistic(
            ratios[np.concatenate([members[k] for k in rng.integers(0, len(names), len(names))])]
        )
        for _ in range(DRAWS // 5)
    ]
    low, high = np.quantile(drawn, (0.025, 0.975))
    return f"{statistic(ratios):.3f} [{low:.3f}, {high:.3f}]"


def print_validity(found: Sequence[Found], record: Path | None) -> None:
    """Print how often the truth is known, and how often which of two producers is nearer to it."""
    columns = ("what", "so in", "told for sure", "contradicted alone")
    table = Table(*columns, title="What the scans tell")
    for name in WRONG:
        below = sum(item.scores[name] < item.scores[TRUTH] for item in found)
        told = sum(item.worse[name] == "worse" for item in found)
        alone = sum(name in item.contradicted for item in found)
        what = f"true path, {name}, scores below the true path"
        table.add_row(what, *(f"{count} of {len(found)}" for count in (below, told, alone)))
    tied = sum(TRUTH in item.tied for item in found)
    alone = sum(TRUTH in item.contradicted for item in found)
    what = "the true path is the best, or cannot be told from it"
    table.add_row(what, f"{tied} of {len(found)}", "-", f"{alone} of {len(found)}")
    own = [(item.ate_m[name], name in item.contradicted) for item in found for name in item.ate_m]
    for low_m, high_m in itertools.pairwise((0.0, 0.1, 0.2, 0.5, math.inf)):
        flags = [flag for ate_m, flag in own if low_m <= ate_m < high_m]
        what = f"producers' and fused paths with an ATE of {low_m:g} to {high_m:g} m"
        table.add_row(what, "-", "-", f"{sum(flags)} of {len(flags)}")
    whole = [item for item in found if item.condition != KIDNAPPING]
    pairs = [pair for item in whole for pair in item.pairs]
    total = sum(math.comb(len(item.candidates()), 2) for item in whole)
    right = sum(best == nearer for best, nearer in pairs)
    what = "pairs of producers told apart, rightly so (ATE); no kidnappings"
    table.add_row(what, f"{right} of {len(pairs)}", f"{len(pairs)} of {total}", "-")
    console_for("evidence-validity", record, width=110).print(table)


def print_choice(name: str, record: Path | None, found: Sequence[Found], title: str) -> None:
    """Print what choosing by evidence is worth."""
    clusters = [f"{item.condition} {item.world}" for item in found]
    table = Table("choice", "geometric mean", "90th percentile", "largest", title=title)
    of_four = [item.ratio(item.chosen(with_fused=True), with_fused=True) for item in found]
    rows = {
        "producer taken, nearest to the fused path": np.array(
            [item.ratio(item.taken) for item in found]
        ),
        "producer that scores best": np.array([item.ratio(item.chosen()) for item in found]),
        "the same, fused path among them": np.array(of_four),
        "always fused": np.array([item.ratio(FUSED) for item in found]),
    }
    rows |= {f"always {name}": np.array([item.ratio(name) for item in found]) for name in BUILT_IN}
    for choice, ratios in rows.items():
        has = np.isfinite(ratios)
        own = [cluster for cluster, one in zip(clusters, has, strict=True) if one]
        words = [
            clustered(ratios[has], own, of)
            for of in (scipy.stats.gmean, partial(np.quantile, q=0.9))
        ]
        table.add_row(choice, *words, f"{ratios[has].max():.2f}")
    console_for(name, record, width=110).print(table)


def main() -> None:
    parser = bench_parser(__doc__)
    parser.add_argument("--drives", type=Path, required=True, help="folder that keeps the drives")
    parser.add_argument("--worlds", default="1,101", help="seeds of the worlds, with commas")
    parser.add_argument("--lidars", default="kinect,hokuyo,rplidar")
    parser.add_argument("--make", action="store_true", help="make the drives that are not there")
    parser.add_argument("--json", type=Path, help="write what was found on each drive")
    parser.add_argument("--device", default="auto")
    arguments = parser.parse_args()
    device = open_device(arguments.device)
    worlds = [int(word) for word in arguments.worlds.split(",")]
    found: list[Found] = []
    for trial in drive_trials(worlds, lidars=arguments.lidars.split(",")):
        folder = arguments.drives / key_of(trial)
        if arguments.make:
            make_drive(trial, arguments.drives, device)
        if (folder / "drive.json").exists():
            found += judge_drive(folder, device)
    record = arguments.record
    print_validity(found, record)
    whole = [item for item in found if item.condition != KIDNAPPING]
    kidnapped = [item for item in found if item.condition == KIDNAPPING]
    print_choice(
        "evidence-choice", record, whole, f"ATE to the best in hindsight, {len(whole)} drives"
    )
    if kidnapped:
        title = f"The same in {len(kidnapped)} segments of kidnappings"
        print_choice("evidence-kidnapped", None, kidnapped, title)
    if arguments.json:
        arguments.json.write_text(json.dumps([vars(item) for item in found], indent=1))


if __name__ == "__main__":
    main()
