"""The fusion, step by step: normalise, align every pair, agree on a group, vote."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace

from slamfusion.align.normalize import common_resolution, normalize_grid
from slamfusion.align.records import Alignment, FusionResult, InputRecord
from slamfusion.align.scale import wrong_resolution
from slamfusion.align.starts import Starts, named_input
from slamfusion.compute import ComputeDevice
from slamfusion.config import FusionConfig
from slamfusion.errors import AlignmentError, ConfigError
from slamfusion.fusion.grouping import FusionSetup, Progress, SecondLook
from slamfusion.fusion.groups import LEAST_FUSED, Members, align_group
from slamfusion.fusion.inputs import PreparedInputs, find_copies, odd_resolutions
from slamfusion.fusion.lattice_vote import Lattices, vote_in_memory
from slamfusion.grid import OccupancyGrid
from slamfusion.vote.tiles import check_votes

# Inputs that are checked for a wrong resolution: a second each.
LOOKED_AT = 4


def fuse_grids(
    grids: Sequence[OccupancyGrid],
    config: FusionConfig,
    device: ComputeDevice,
    progress: Progress | None = None,
    second_look: SecondLook | None = None,
    starts: Starts | None = None,
    executor: Executor | None = None,
) -> FusionResult:
    """Bring the grids into one frame and let them vote.

    Args:
        grids: one or more, of distinct names, any frames and resolutions.
        progress: called with the stage, the steps done and the total steps.
        second_look: receives each alignment and returns the one to use; None: the walls alone
            decide.
        starts: where the inputs are expected; a pair with starts of both is searched only there.
        executor: aligns pairs, on devices like this one, see ``slamfusion.fleet``; None: here.

    Returns:
        The fused map with its records. A single grid is its own fusion.

    Raises:
        AlignmentError: fewer than two of several inputs agree; ``pairs`` holds the alignments.
        ConfigError: the reference named in the config is none of the inputs, or the mode no vote.
        MemoryBudgetError: the grids are too large for the memory that is free.
    """
    began = time.perf_counter()
    setup = FusionSetup(config, device, progress, second_look, starts, executor)
    aligned = align_inputs(grids, setup)
    result = vote_in_memory(grids, aligned.groups, aligned.lattices, aligned.others, config, device)
    return replace(result, pairs=aligned.pairs, time_s=time.perf_counter() - began)


@dataclass(frozen=True, eq=False)
class AlignedInputs:
    """Inputs in one frame, before the vote.

    Attributes:
        groups: the largest group that fits together, and further ones.
        lattices: returns an input that votes at the common resolution.
        others: records of the inputs that are not in the largest group, by name.
    """

    groups: tuple[Members, ...]
    pairs: tuple[Alignment, ...]
    lattices: Lattices
    others: Mapping[str, InputRecord]


def align_inputs(grids: Sequence[OccupancyGrid], setup: FusionSetup) -> AlignedInputs:
    """Bring the grids into one frame; see ``fuse_grids``."""
    check_votes(setup.config.vote)
    if not grids:
        raise AlignmentError("wanted at least one map to fuse, found none")
    names = [grid.name for grid in grids]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ConfigError(f"inputs need distinct names; given twice: {', '.join(twice)}")
    odd = odd_resolutions({grid.name: grid.resolution for grid in grids})
    copies = _copies(grids, setup)
    voters = [grid for grid in grids if grid.name not in copies and grid.name not in odd]
    prepared = PreparedInputs(voters, setup)
    reasons = {name: reason for name, reason in odd.items() if name not in copies}
    reasons |= prepared.reasons
    try:
        group = align_group(prepared.features, reasons, setup, names)
    except AlignmentError as error:
        whole = [grid for grid in voters if grid.name not in prepared.reasons]
        wrong = _wrong_resolutions(whole, setup)
        if not wrong:
            raise
        words = "; ".join(f"{name}: {why}" for name, why in wrong.items())
        raise AlignmentError(f"{error}; {words}", error.pairs) from error
    finally:
        prepared.release()
    reasons |= {name: reason for name, (reason, _) in group.left_out.items()}
    for number, members in enumerate(group.others, start=2):
        for name in members.alignments:
            reasons[name] += f"; fused in group {number}: {', '.join(members.alignments)}"
    shown = {name: alignment for name, (_, alignment) in group.left_out.items()}
    by_name = {grid.name: grid for grid in grids}
    alone = set(shown) - {name for members in group.others for name in members.alignments}
    looked_at = [group.reference, *(name for name in shown if name in alone)]
    reasons |= _wrong_resolutions([by_name[name] for name in looked_at], setup)
    others = {
        grid.name: InputRecord(grid, shown.get(grid.name), False, reasons[grid.name])
        for grid in grids
        if grid.name in reasons
    }
    for grid in grids:
        if grid.name in copies:
            # At the voter's place, without a vote.
            voter = copies[grid.name]
            own = (group.alignments | shown).get(voter)
            own = None if own is None else replace(own, moving=grid.name)
            reason = f"the same map as {voter} (equal cells, resolution and origin): one voter"
            others[grid.name] = InputRecord(grid, own, False, reason, copy_of=voter)
    return AlignedInputs((group, *group.others), group.pairs, prepared.lattice, others)


def vote_again(result: FusionResult, config: FusionConfig, device: ComputeDevice) -> FusionResult:
    """Return the vote of the same inputs and alignments with other ``vote`` settings."""
    began = time.perf_counter()
    grids = [record.grid for record in result.inputs]
    resolution = common_resolution(grids, config.normalize)
    voters = {record.name: record for record in result.accepted if record.alignment is not None}
    normalized = {
        name: normalize_grid(record.grid, resolution, config.normalize, device)
        for name, record in voters.items()
    }
    alignments = {
        name: record.alignment for name, record in voters.items() if record.alignment is not None
    }
    rejected = {record.name: record for record in result.inputs if not record.accepted}
    members = Members(result.reference, alignments)
    voted = vote_in_memory(grids, [members], normalized.__getitem__, rejected, config, device)
    return replace(voted, pairs=result.pairs, time_s=time.perf_counter() - began)


def _wrong_resolutions(grids: Sequence[OccupancyGrid], setup: FusionSetup) -> dict[str, str]:
    """Return wrong resolutions in words, if that of the first map is right.

    Only for a few saved maps: the SLAMs of one drive have one resolution.
    """
    is_few, config = 1 < len(grids) <= 1 + LOOKED_AT, setup.config
    if setup.second_look is not None or not is_few or config.align.step:
        return {}
    reference, *left_out = grids
    words = {it.name: wrong_resolution(reference, it, config, setup.device) for it in left_out}
    return {name: said for name, said in words.items() if said is not None}


def _copies(grids: Sequence[OccupancyGrid], setup: FusionSetup) -> dict[str, str]:
    """Return the inputs without a vote as copies, and their voters; reject copies alone."""
    starts, config = setup.starts, setup.config
    if config.keep_duplicates:
        return {}
    names = [grid.name for grid in grids]
    known = {named_input(config.reference, names), *(starts.given if starts is not None else ())}
    copies = find_copies(grids, {name for name in known if name is not None})
    if copies and len(grids) - len(copies) < LEAST_FUSED:
        raise AlignmentError(
            f"{', '.join(names)} are the same map, and a vote needs two different ones; "
            "--keep-duplicates counts each copy"
        )
    return copies
