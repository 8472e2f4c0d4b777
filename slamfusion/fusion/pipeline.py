"""The fusion, step by step: normalise, align every pair, agree on a group, vote."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from statistics import median

import numpy as np
import numpy.typing as npt

from slamfusion.compute import ComputeDevice
from slamfusion.compute.lattice import fixed_poses
from slamfusion.config import FusionConfig
from slamfusion.errors import AlignmentError, ConfigError, GridError
from slamfusion.fusion.align import align_features, rejected_alignment, track_features
from slamfusion.fusion.consistency import Group, largest_group, path_transform
from slamfusion.fusion.features import GridFeatures
from slamfusion.fusion.implied import ImpliedPairs, words_over
from slamfusion.fusion.normalize import (
    NormalizedGrid,
    check_resampling,
    common_resolution,
    lattice_box,
    normalize_grid,
)
from slamfusion.fusion.records import Alignment, FusionResult, InputRecord
from slamfusion.fusion.start import Starts
from slamfusion.fusion.vote import (
    agreement_weights,
    check_votes,
    double_reach_cells,
    margin_cells,
    vote_grids,
)
from slamfusion.geometry import Pose2
from slamfusion.grid import FREE, OCCUPIED, UNKNOWN, CellBox, OccupancyGrid

__all__ = [
    "AlignedGroup",
    "align_group",
    "choose_reference",
    "fuse_grids",
    "vote_again",
    "warp_onto",
]

Progress = Callable[[str, int, int], None]
# Told an alignment, its reference and its moving grid; returns what is believed in its place.
SecondLook = Callable[[Alignment, GridFeatures, GridFeatures], Alignment]

REFERENCE_AREA_SHARE = 0.5
# [F16]: any two of three decide, so one input has nobody to agree with.
MINIMUM_INPUTS = 2
# Of more pairs most share nothing: what is refused is not searched once more.
THOROUGH_PAIRS = 15


def fuse_grids(
    grids: Sequence[OccupancyGrid],
    config: FusionConfig,
    device: ComputeDevice,
    progress: Progress | None = None,
    second_look: SecondLook | None = None,
    starts: Starts | None = None,
    in_part: Collection[str] = (),
) -> FusionResult:
    """Bring the grids into one frame and let them vote.

    Args:
        grids: one or more, of distinct names, any frames and resolutions.
        config: every setting of the fusion.
        device: computes.
        progress: called with what is being done, how many steps are done, and of how many.
        second_look: what else is known of a pair: given each alignment, returns the one that is
            believed; None: the walls alone decide.
        starts: where the inputs are expected; a pair of which both are is searched only there.
        in_part: names of inputs that do not show all of their place: they are not the reference,
            whose box the fused map may have, where there is another.

    Returns:
        The fused map and everything needed to judge it. A single grid is its own fusion.

    Raises:
        AlignmentError: fewer than two of several inputs agree; ``pairs`` holds the alignments.
        ConfigError: the reference named in the config is none of the inputs, or the mode no vote.
        MemoryBudgetError: the grids are too large for the memory that is free.
    """
    began = time.perf_counter()
    check_votes(config.vote)
    _check_inputs(grids, config)
    resolution = common_resolution(list(grids), config.normalize)
    reasons: dict[str, str] = {}
    features: dict[str, GridFeatures] = {}
    for grid in grids:
        try:
            normalized = normalize_grid(grid, resolution, config.normalize, device)
        except GridError as error:
            reasons[grid.name] = str(error)
            continue
        features[grid.name] = GridFeatures(normalized, device)
    names = [grid.name for grid in grids]
    group = align_group(
        features, reasons, config, device, names, progress, second_look, starts, in_part
    )
    reasons |= {name: reason for name, (reason, _) in group.left_out.items()}
    shown = {name: alignment for name, (_, alignment) in group.left_out.items()}
    rejected = {
        grid.name: InputRecord(grid, shown.get(grid.name), False, reasons[grid.name])
        for grid in grids
        if grid.name in reasons
    }
    result = _vote(grids, group.reference, group.alignments, features, rejected, config, device)
    return replace(result, pairs=group.pairs, time_s=time.perf_counter() - began)


def vote_again(result: FusionResult, config: FusionConfig, device: ComputeDevice) -> FusionResult:
    """Return the vote of the same inputs under the same alignments with other settings.

    Args:
        result: of ``fuse_grids``.
        config: its ``vote`` may differ from that of the result.
        device: computes.
    """
    began = time.perf_counter()
    grids = [record.grid for record in result.inputs]
    resolution = common_resolution(grids, config.normalize)
    alignments, features = {}, {}
    for record in result.accepted:
        if record.alignment is not None:
            normalized = normalize_grid(record.grid, resolution, config.normalize, device)
            features[record.name] = GridFeatures(normalized, device)
            alignments[record.name] = record.alignment
    rejected = {record.name: record for record in result.rejected}
    voted = _vote(grids, result.reference, alignments, features, rejected, config, device)
    return replace(voted, pairs=result.pairs, time_s=time.perf_counter() - began)


@dataclass(frozen=True, eq=False)
class AlignedGroup:
    """Inputs that fit together, and how.

    Attributes:
        reference: name of the reference.
        alignments: each member's alignment to the reference; the reference's own is the identity.
        left_out: why every other input is no member, and the alignment that shows it.
        pairs: every pair that was aligned.
    """

    reference: str
    alignments: dict[str, Alignment]
    left_out: dict[str, tuple[str, Alignment | None]]
    pairs: tuple[Alignment, ...]


def align_group(
    features: dict[str, GridFeatures],
    reasons: dict[str, str],
    config: FusionConfig,
    device: ComputeDevice,
    names: Sequence[str],
    progress: Progress | None = None,
    second_look: SecondLook | None = None,
    starts: Starts | None = None,
    in_part: Collection[str] = (),
) -> AlignedGroup:
    """Align every pair, find the largest group that fits together, and choose its reference.

    Args:
        features: the inputs that can be aligned, by name, all at one resolution.
        reasons: why the other inputs cannot.
        config: settings of the search; ``reference`` may name the reference.
        device: computes.
        names: all inputs, in order.
        progress, second_look, starts, in_part: see ``fuse_grids``.

    Raises:
        AlignmentError: fewer than two of several inputs agree; ``pairs`` holds the alignments.
        ConfigError: the reference named in the config is no member.
    """
    pairs = _align_pairs(features, config, device, progress, second_look, starts or Starts())
    implied = ImpliedPairs(features, len(pairs), device)
    group = _agree(names, features, pairs, reasons, implied)
    whole = [name for name in group.members if name not in in_part]
    candidates = whole if whole and config.reference is None else group.members
    reference = choose_reference(candidates, features, config.reference, names)
    alignments = _to_reference(reference, group, features, pairs, device)
    left_out = {
        name: _left_out(name, reference, group, pairs, implied)
        for name in features
        if name not in group.members
    }
    return AlignedGroup(reference, alignments, left_out, tuple(pairs))


def _check_inputs(grids: Sequence[OccupancyGrid], config: FusionConfig) -> None:
    """Refuse no inputs, names given twice, and more cells than memory."""
    if not grids:
        message = "wanted at least one map to fuse, found none"
        raise AlignmentError(message)
    names = [grid.name for grid in grids]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        message = f"inputs need distinct names; given twice: {', '.join(twice)}"
        raise ConfigError(message)
    check_resampling(grids, config.normalize, "fusing")


def _align_pairs(
    features: dict[str, GridFeatures],
    config: FusionConfig,
    device: ComputeDevice,
    progress: Progress | None,
    second_look: SecondLook | None,
    starts: Starts,
) -> list[Alignment]:
    """Align every pair, the larger known box to the smaller."""
    couples = list(itertools.combinations(features.values(), 2))
    is_thorough, pairs = len(couples) <= THOROUGH_PAIRS, []
    for done, (a, b) in enumerate(couples):
        reference, moving = (a, b) if math.prod(a.shape) <= math.prod(b.shape) else (b, a)
        if progress is not None:
            progress(f"{moving.grid.name} to {reference.grid.name}", done, len(couples))
        start = starts.between(reference.grid.name, moving.grid.name)
        pair = align_features(
            reference, moving, config.align, device, start,
            pairs=len(couples), thorough=is_thorough,
        )  # fmt: skip
        pairs.append(pair if second_look is None else second_look(pair, reference, moving))
    if progress is not None:
        progress("vote", len(couples), len(couples))
    return pairs


def _agree(
    names: Sequence[str],
    features: dict[str, GridFeatures],
    pairs: Sequence[Alignment],
    reasons: dict[str, str],
    implied: ImpliedPairs,
) -> Group:
    """Return the largest group that fits together, or raise with every input's reason."""
    if len(names) == 1 and features:
        return Group((names[0],), 0.0)
    centres, resolution = {}, 1.0
    for name, feature in features.items():
        resolution = feature.grid.grid.resolution
        own = np.array(feature.centre) * resolution
        x, y = feature.grid.grid.origin.transform(own)
        centres[name] = (float(x), float(y))
    usable = [name for name in names if name in features]
    group = Group((), 0.0)
    if usable:
        group = largest_group(usable, pairs, centres, resolution, implied.stands)
    if len(group.members) < MINIMUM_INPUTS:
        found = [f"{pair.moving} to {pair.reference}: {pair.reason}" for pair in pairs]
        words = "; ".join([*reasons.values(), *found])
        listed = ", ".join(names)
        message = f"no two of the inputs {listed} align, so nothing is fused ({words})"
        raise AlignmentError(message, tuple(pairs))
    return group


def choose_reference(
    members: Sequence[str],
    features: dict[str, GridFeatures],
    wanted: str | None,
    names: Sequence[str],
) -> str:
    """Return the name of the reference among the group.

    The smallest known box among members with at least half the group's median known area; a name
    or an index of the inputs overrides it.

    Raises:
        ConfigError: the wanted one is no input, or was rejected.
    """
    if wanted is not None:
        name = wanted
        if wanted not in names and wanted.isdecimal() and int(wanted) < len(names):
            name = names[int(wanted)]
        if name not in members:
            state = "was rejected" if name in names else "is none of them"
            message = (
                f"reference {wanted!r} {state}; the inputs that fit together are "
                f"{', '.join(members)}"
            )
            raise ConfigError(message)
        return name
    typical = median(features[name].known_cells for name in members)
    grown = [
        name for name in members if features[name].known_cells >= REFERENCE_AREA_SHARE * typical
    ]
    return min(grown, key=lambda name: math.prod(features[name].shape))


def _to_reference(
    reference: str,
    group: Group,
    features: dict[str, GridFeatures],
    pairs: Sequence[Alignment],
    device: ComputeDevice,
) -> dict[str, Alignment]:
    """Return each member's alignment to the reference, the reference's own the identity.

    A pair aligned directly is taken as it is; one aligned the other way round, or connected over
    others only, is refined from the transform that is known and keeps what the search said of it.
    """
    direct = {(pair.reference, pair.moving): pair for pair in pairs if pair.accepted}
    out = {}
    for name in group.members:
        if name == reference:
            out[name] = _own(features[name])
        elif (reference, name) in direct:
            out[name] = direct[reference, name]
        else:
            start = path_transform(name, reference, group.members, pairs)
            if start is None:  # pragma: no cover - a group is connected by construction
                message = f"{name} has no path of accepted pairs to {reference}"
                raise AlignmentError(message, tuple(pairs))
            tracked = track_features(features[reference], features[name], device, start)
            other = direct.get((name, reference))
            if other is not None:
                other = _from_the_side_of(name, other)
                tracked = replace(
                    tracked,
                    runner_up=other.runner_up,
                    bound_gap=other.bound_gap,
                    time_s=other.time_s + tracked.time_s,
                    yaw_profile=other.yaw_profile,
                    statistics=other.statistics | tracked.statistics,
                )
            reason = words_over(name, tracked) if other is None else other.reason
            out[name] = replace(tracked, accepted=True, reason=reason)
    return out


def _turned(profile: npt.NDArray[np.float64] | None) -> npt.NDArray[np.float64] | None:
    """Return a yaw profile as the inverse transform sees it."""
    if profile is None:
        return None
    turned = profile * np.array([-1.0, 1.0])
    return np.asarray(turned[np.argsort(turned[:, 0])])


def _own(features: GridFeatures) -> Alignment:
    """Return the reference's own record."""
    record = rejected_alignment(features, features, "the reference", 0.0)
    return replace(record, accepted=True, score=1.0, overlap=1.0)


def _left_out(
    name: str,
    reference: str,
    group: Group,
    pairs: Sequence[Alignment],
    implied: ImpliedPairs,
) -> tuple[str, Alignment | None]:
    """Return why an input is not in the group, in one line, and the alignment that shows it.

    The one to the reference where there is one, else the best of the failed.
    """
    mine = [
        pair
        for pair in pairs
        if name in {pair.reference, pair.moving}
        and {pair.reference, pair.moving} & set(group.members)
    ]
    mine.sort(key=lambda pair: (reference not in {pair.reference, pair.moving}, -pair.score))
    failed = [pair for pair in mine if not pair.accepted]
    if failed:
        shown = _from_the_side_of(name, failed[0])
        return f"to {shown.reference}: {shown.reason}{implied.words_against(failed[0])}", shown
    reason = "its transforms to the others do not close (a to b to c to a)"
    return reason, _from_the_side_of(name, mine[0]) if mine else None


def _from_the_side_of(name: str, pair: Alignment) -> Alignment:
    """Return the pair with ``name`` as the moving grid; scores are symmetric, the error is not."""
    if pair.moving == name:
        return pair
    runner_up = pair.runner_up
    if runner_up is not None:
        runner_up = replace(runner_up, transform=runner_up.transform.inverse())
    return replace(
        pair,
        reference=pair.moving,
        moving=name,
        transform=pair.transform.inverse(),
        runner_up=runner_up,
        yaw_profile=_turned(pair.yaw_profile),
    )


def warp_onto(
    grid: NormalizedGrid,
    cells: npt.NDArray[np.int8],
    transform: Pose2,
    lattice: OccupancyGrid,
    box: CellBox,
    device: ComputeDevice,
) -> npt.NDArray[np.int8]:
    """Return cells of one grid on the box of another's lattice, nearest cell, unknown outside.

    Args:
        grid: gives the origin and resolution of ``cells``.
        cells: (H, W) int8 on the grid's lattice.
        transform: maps the grid's map frame into the lattice's, metres.
        lattice: the grid whose lattice is the target.
        box: cells of that lattice; may reach beyond it.
        device: computes.
    """
    size = lattice.resolution
    into = grid.grid.origin.inverse().compose(transform.inverse()).compose(lattice.origin)
    corner = into.transform((box.col0 * size, box.row0 * size)) / size
    pose = fixed_poses((corner[0], corner[1], into.yaw_rad))
    shape = (box.height, box.width)
    warped = device.warp(device.upload(cells), pose, shape, UNKNOWN)
    return np.asarray(device.download(warped)[0])


def _vote(
    grids: Sequence[OccupancyGrid],
    reference: str,
    alignments: dict[str, Alignment],
    features: dict[str, GridFeatures],
    rejected: dict[str, InputRecord],
    config: FusionConfig,
    device: ComputeDevice,
) -> FusionResult:
    """Warp the accepted grids onto the fused lattice, vote, and write the records."""
    base = features[reference].grid
    box = CellBox(0, 0, *base.shape)
    if config.vote.extent == "union":
        boxes = [
            lattice_box(features[name].grid, pair.transform, base)
            for name, pair in alignments.items()
        ]
        box = CellBox(
            min(b.row0 for b in boxes),
            min(b.col0 for b in boxes),
            max(b.row1 for b in boxes),
            max(b.col1 for b in boxes),
        )
    margin = margin_cells(config.vote, len(alignments))
    box = CellBox(box.row0 - margin, box.col0 - margin, box.row1 + margin, box.col1 + margin)
    aligned, percents = [], []
    for name, pair in alignments.items():
        grid = features[name].grid
        aligned.append(warp_onto(grid, grid.cells, pair.transform, base.grid, box, device))
        if config.vote.mode == "log-odds":
            percents.append(
                warp_onto(grid, grid.grid.cells, pair.transform, base.grid, box, device)
            )
    weights = agreement_weights(aligned) if config.vote.mode == "weighted" else [1.0] * len(aligned)
    voted = vote_grids(
        aligned,
        config.vote,
        device,
        weights=weights,
        percents=percents or None,
        thresholds=config.normalize,
        reach_cells=double_reach_cells(config.vote, base.grid.resolution),
    )
    frame = base.grid.crop(box)
    cells = np.array([UNKNOWN, FREE, OCCUPIED], dtype=np.int8)[voted.fused + 1]
    fused = OccupancyGrid(cells, frame.resolution, frame.origin, "fused")
    agreement = OccupancyGrid(voted.agreement, frame.resolution, frame.origin, "agreement")
    slots = {name: index for index, name in enumerate(alignments)}
    records = []
    for given in grids:
        if given.name in slots:
            index = slots[given.name]
            pair = alignments[given.name]
            dissent = (voted.dissent >> np.array(index, voted.dissent.dtype)) & 1 != 0
            records.append(InputRecord(given, pair, True, pair.reason, aligned[index], dissent))
        else:
            records.append(rejected[given.name])
    return FusionResult(
        reference=reference,
        inputs=tuple(records),
        fused=fused,
        agreement=agreement,
        pairs=(),
        phantom_cells=voted.phantom_cells,
        weights={name: float(weights[index]) for name, index in slots.items()},
        device=device.name,
        time_s=0.0,
    )
