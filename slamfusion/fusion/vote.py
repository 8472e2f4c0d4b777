"""Let aligned grids vote cell by cell: majority, consensus, weights, or the sum of log-odds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, get_args

import cv2
import numpy as np
import numpy.typing as npt

from slamfusion.compute.layout import MOST_INPUTS
from slamfusion.compute.votes import VoteDevice, Votes
from slamfusion.config import NormalizeConfig, VoteConfig, VoteMode
from slamfusion.errors import ConfigError, GridError
from slamfusion.fusion.records import VoteResult
from slamfusion.fusion.surfaces import REACH_CELLS, sharpen_fronts, wall_backs

__all__ = [
    "agreement_weights",
    "check_votes",
    "double_reach_cells",
    "log_odds_table",
    "margin_cells",
    "quantise_weights",
    "unknown_votes",
    "vote_grids",
    "vote_reach_cells",
]

I8 = npt.NDArray[np.int8]
I32 = npt.NDArray[np.int32]

# Divides by 2, 3, 4, 6, 7, 9 and 12: simple ratios of weights stay exact.
WEIGHT_MAX = 252
# Of an agreement of all cells: no vote outweighs the others without end.
WEIGHT_CEILING = 0.99
# One input alone never outweighs this many percent; 0 and 100 would outvote everyone for ever.
SUREST_PERCENT = 98
LOG_ODDS_ONE = 256
# The ways to vote in which walls are solid.
SOLID_MODES = ("consensus", "log-odds")


def vote_grids(
    stack: Sequence[I8],
    config: VoteConfig,
    device: VoteDevice,
    *,
    weights: Sequence[float] | None = None,
    percents: Sequence[I8] | None = None,
    thresholds: NormalizeConfig = NormalizeConfig(),  # noqa: B008 - frozen
    reach_cells: int = 0,
) -> VoteResult:
    """Fuse grids that lie on one lattice.

    ``majority``: every input has one vote in each cell. ``weighted``: votes count by weight. In
    both a tie for first place is occupied, and ``config.unknown`` says whether unknown is a value
    or abstains. ``consensus``: a majority of those that know the cell; but a wall that one input
    alone sees, a little beside a wall that two or more see, is that wall drawn twice, and is left
    out: maps that differ by a few cells make no doubled walls. ``log-odds``: an input votes with
    the log-odds of its occupancy, unknown and 50 % abstain; the cell is occupied or free where the
    sum is that of the thresholds, and between them occupied where an input alone says so (a tie),
    else unknown.

    With ``config.solid_walls`` the walls of the last two are solid (``surfaces``), but those of one
    grid alone, which is its own fusion: an unknown cell behind a wall, next to nothing free, is its
    back, occupied with no vote cast; and a cell before a wall that is two cells deep without it is
    free where an input says so.

    Args:
        stack: 1 to 32 of (H, W) int8 in {-1, 0, 1}.
        config: mode and the meaning of unknown; ``extent`` is the caller's.
        device: computes the vote.
        weights: one each input, finite and not negative; for ``weighted``.
        percents: the inputs' occupancy in percent on the same lattice, (H, W) int8, -1 unknown;
            for ``log-odds``.
        thresholds: what the inputs were normalised with; for ``log-odds``.
        reach_cells: how far from a wall its double may lie; for ``consensus``.

    Returns:
        The fused cells, the agreement (share of the votes cast, by weight where votes have one,
        in percent, rounded half up; -1 without votes), who was outvoted, and the phantom cells.
        Backs of walls are none of these: they are occupied, and their agreement is -1.

    Raises:
        GridError: no grid, more than 32, or grids that do not share one shape.
        ConfigError: the mode lacks its weights or percents, or is no vote.

    Source: [F16], the vote; any number of inputs, abstention, weights and log-odds are ours.
    """
    check_votes(config)
    grids = _dense(stack, "grids")
    if config.mode == "log-odds":
        votes = _vote_log_odds(grids, percents, thresholds, device)
    elif config.mode == "weighted":
        votes = _vote_weighted(grids, weights, config, device)
    elif config.mode == "consensus":
        return _solid(_vote_consensus(grids, reach_cells, device), grids, None, config)
    else:
        with_unknown = unknown_votes(config.unknown, [1] * len(grids))
        votes = device.vote_majority(grids, unknown_votes=with_unknown)
    voted = VoteResult(
        votes.fused, votes.agreement, _join_planes(votes.dissent), votes.phantom_cells
    )
    return _solid(voted, grids, percents, config) if config.mode == "log-odds" else voted


def check_votes(config: VoteConfig) -> None:
    """Refuse a mode in which maps do not vote.

    Raises:
        ConfigError: it is ``drawn``.
    """
    votes = get_args(VoteMode)
    if config.mode not in votes:
        message = (
            f"mode {config.mode!r} draws the map from the scans of a log, and here are maps alone; "
            f"take {', '.join(votes[:-1])} or {votes[-1]}, or a log and `slamfusion run`"
        )
        raise ConfigError(message)


def unknown_votes(rule: str, weights: Sequence[int]) -> bool:
    """Say whether unknown is a value (True) or abstains.

    ``auto``: a value with exactly three voters of whom any two outvote the third, so that a tie
    for first place needs three different cells, one of them occupied. With other voters free and
    unknown could tie alone, and the tie would put a wall where no input has one.

    Args:
        rule: ``auto``, ``value`` or ``abstain``.
        weights: one each voter.
    """
    if rule == "auto":
        return len(weights) == 3 and 2 * max(weights) < sum(weights)
    return rule == "value"


def quantise_weights(weights: Sequence[float]) -> I32:
    """Return weights as whole numbers 1 to 252, the largest being 252.

    Args:
        weights: finite, not negative, at least one above 0.

    Raises:
        ConfigError: anything else.
    """
    largest = max(weights)
    if not (all(math.isfinite(w) and w >= 0 for w in weights) and largest > 0):
        message = f"vote weights must be finite and not negative, one above 0; found {weights!r}"
        raise ConfigError(message)
    share = np.asarray(weights, dtype=np.float64) / largest
    whole: I32 = np.maximum(1, np.rint(WEIGHT_MAX * share)).astype(np.int32)
    return whole


def agreement_weights(aligned: Sequence[I8]) -> list[float]:
    """Return each input's weight: the log-odds of its agreement with the others, the largest 1.

    The agreement is the share of its known cells, among those that others know, where it says what
    most of the others say; independent voters of that reliability are best weighted by its
    log-odds.
    """
    stack = np.stack(aligned)
    occupied = (stack == 1).sum(axis=0, dtype=np.int16)
    free = (stack == 0).sum(axis=0, dtype=np.int16)
    raw = []
    for cells in stack:
        others = (occupied - (cells == 1)) - (free - (cells == 0))
        counted = (cells >= 0) & (others != 0)
        agree = counted & ((others > 0) == (cells == 1))
        share = agree.sum() / max(1, counted.sum())
        share = min(max(float(share), 1.0 - WEIGHT_CEILING), WEIGHT_CEILING)
        raw.append(max(0.05, math.log(share / (1.0 - share))))
    return [weight / max(raw) for weight in raw]


def log_odds_table() -> I32:
    """Return (101,) int32, log-odds by percent in units of 1/256, of 2 to 98 percent."""
    percent = np.arange(101).clip(100 - SUREST_PERCENT, SUREST_PERCENT)
    odds: I32 = np.rint(LOG_ODDS_ONE * np.log(percent / (100 - percent))).astype(np.int32)
    return odds


def double_reach_cells(config: VoteConfig, resolution: float) -> int:
    """Return ``reach_cells`` of a vote on cells of a size in metres; 0 for other modes."""
    return round(config.double_reach_m / resolution) if config.mode == "consensus" else 0


def vote_reach_cells(config: VoteConfig, resolution: float) -> int:
    """Return how far, in cells of a size in metres, a cell has a say in what others become."""
    own = REACH_CELLS if _has_solid_walls(config) else 0
    return double_reach_cells(config, resolution) + own


def margin_cells(config: VoteConfig, voters: int) -> int:
    """Return by how many cells a fused map is larger than its inputs: backs lie behind walls."""
    return 1 if _has_solid_walls(config) and voters > 1 else 0


def _has_solid_walls(config: VoteConfig) -> bool:
    return config.solid_walls and config.mode in SOLID_MODES


def _solid(
    voted: VoteResult, grids: list[I8], percents: Sequence[I8] | None, config: VoteConfig
) -> VoteResult:
    """Give walls their backs, and take away disputed cells before them.

    Args:
        voted: the bare vote.
        grids: the trinary voters.
        percents: their occupancy, whose log-odds are their votes; None: each has one vote.
        config: says whether walls are solid.
    """
    if not _has_solid_walls(config) or len(grids) == 1:
        return voted
    fused, agreement, dissent = voted.fused.copy(), voted.agreement.copy(), voted.dissent.copy()
    fused[wall_backs(fused)] = 1
    is_disputed = np.zeros(fused.shape, dtype=np.bool_)
    for grid in grids:
        is_disputed |= grid == 0
    cut = sharpen_fronts(fused, is_disputed)
    fused[cut] = 0
    # Of these cells alone: who voted for free, and how heavily.
    if percents is None:
        votes = [np.array([0, -1, 1])[grid[cut] + 1] for grid in grids]
    else:
        odds = np.append(log_odds_table(), 0)
        votes = [odds[percent[cut]] for percent in percents]
    for_free = np.sum([np.maximum(-vote, 0) for vote in votes], axis=0)
    cast = np.sum([np.abs(vote) for vote in votes], axis=0)
    agreement[cut] = _percent(for_free, np.maximum(cast, 1))
    dissent[cut] = _bits([vote > 0 for vote in votes], dissent.dtype)
    return VoteResult(fused, agreement, dissent, voted.phantom_cells)


def _vote_consensus(grids: list[I8], reach_cells: int, device: VoteDevice) -> VoteResult:
    """Vote of those that know, without walls beside those that several see."""
    votes = device.vote_majority(grids, unknown_votes=False)
    fused, agreement = votes.fused.copy(), votes.agreement.copy()
    dissent = _join_planes(votes.dissent).copy()
    occupied = np.zeros(fused.shape, dtype=np.uint8)
    free = np.zeros(fused.shape, dtype=np.uint8)
    for grid in grids:
        occupied += grid == 1
        free += grid == 0
    sure = (occupied >= 2).astype(np.uint8)
    near = cv2.dilate(sure, np.ones((3, 3), np.uint8))
    side = 2 * reach_cells + 1
    around = cv2.dilate(sure, np.ones((side, side), np.uint8))
    is_double = (fused == 1) & (occupied == 1) & (around == 1) & (near == 0)
    fused[is_double] = np.where(free[is_double] > 0, 0, -1)
    # One voted for the wall; all others that know the cell say that it is free.
    agreement[is_double] = _percent(free[is_double], free[is_double] + 1)
    dissent[is_double] = _bits([grid[is_double] == 1 for grid in grids], dissent.dtype)
    return VoteResult(fused, agreement, dissent, votes.phantom_cells)


def _vote_weighted(
    grids: list[I8], weights: Sequence[float] | None, config: VoteConfig, device: VoteDevice
) -> Votes:
    """Vote by weight."""
    if weights is None or len(weights) != len(grids):
        found = "none" if weights is None else f"{len(weights)}"
        message = f"mode 'weighted' wants {len(grids)} weights, one each input, found {found}"
        raise ConfigError(message)
    whole = quantise_weights(weights)
    with_unknown = unknown_votes(config.unknown, [int(w) for w in whole])
    return device.vote_weighted(grids, whole, unknown_votes=with_unknown)


def _vote_log_odds(
    grids: list[I8],
    percents: Sequence[I8] | None,
    thresholds: NormalizeConfig,
    device: VoteDevice,
) -> Votes:
    """Vote by the sum of log-odds."""
    if percents is None or [p.shape for p in percents] != [g.shape for g in grids]:
        message = "mode 'log-odds' wants the occupancy in percent of every input, cell by cell"
        raise ConfigError(message)
    return device.vote_log_odds(
        _dense(percents, "occupancies"),
        log_odds_table(),
        occupied_percent=math.ceil(thresholds.occupied_percent),
        free_percent=math.floor(thresholds.free_percent),
    )


def _dense(grids: Sequence[I8], what: str) -> list[I8]:
    """Return the grids with dense rows, checked."""
    if not 1 <= len(grids) <= MOST_INPUTS:
        message = f"a vote takes 1 to {MOST_INPUTS} {what}, found {len(grids)}"
        raise GridError(message)
    kinds = {(grid.shape, grid.dtype.name) for grid in grids}
    shape, dtype = next(iter(kinds))
    if len(kinds) > 1 or dtype != "int8" or len(shape) != 2 or 0 in shape:
        found = ", ".join(f"{dtype} {shape}" for shape, dtype in sorted(kinds))
        message = f"{what} that vote must be (H, W) int8 of one shape, found {found}"
        raise GridError(message)
    return [np.ascontiguousarray(grid) for grid in grids]


def _percent(part: npt.NDArray[Any], whole: npt.NDArray[Any]) -> I8:
    """Return shares in percent, rounded half up, (K,); the whole is nowhere 0."""
    return np.asarray(np.floor(100.0 * part / whole + 0.5), dtype=np.int8)


def _bits(
    flags: Sequence[npt.NDArray[np.bool_]], kind: np.dtype[Any]
) -> npt.NDArray[np.unsignedinteger[Any]]:
    """Return (K,) of a kind, bit n set where the n-th of the flags, (K,), is."""
    bits = np.zeros(flags[0].shape, dtype=kind)
    for index, flag in enumerate(flags):
        bits |= flag.astype(kind) << np.array(index, kind)
    return bits


def _join_planes(planes: npt.NDArray[np.uint8]) -> npt.NDArray[Any]:
    """Return (P, H, W) planes of 8 bits as (H, W) of the smallest unsigned type that holds them."""
    if len(planes) == 1:
        only: npt.NDArray[np.uint8] = planes[0]
        return only
    size = 2 if len(planes) <= 2 else 4
    joined = np.zeros((*planes.shape[1:], size), dtype=np.uint8)
    for n, plane in enumerate(planes):
        joined[..., n] = plane
    native: npt.NDArray[Any] = joined.view(f"<u{size}")[..., 0].astype(f"u{size}", copy=False)
    return native
