"""Inputs that fit together: align pairs, find the largest group, choose its reference."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from statistics import median

import numpy as np
import numpy.typing as npt

from slamfusion.compute import ComputeDevice
from slamfusion.config import FusionConfig
from slamfusion.errors import AlignmentError, ConfigError
from slamfusion.fusion.align import align_features, rejected_alignment, track_features
from slamfusion.fusion.consistency import Group, largest_group, path_transform
from slamfusion.fusion.features import GridFeatures
from slamfusion.fusion.implied import ImpliedPairs, words_over
from slamfusion.fusion.records import Alignment
from slamfusion.fusion.start import Starts, named_input

__all__ = [
    "LEAST_FUSED",
    "AlignedGroup",
    "Progress",
    "SecondLook",
    "align_group",
    "choose_reference",
]

# Told what is being done, how many steps are done, and of how many.
Progress = Callable[[str, int, int], None]
# Told an alignment, its reference and its moving grid; returns what is believed in its place.
SecondLook = Callable[[Alignment, GridFeatures, GridFeatures], Alignment]

REFERENCE_AREA_SHARE = 0.5
# [F16]: any two of three decide, so one input has nobody to agree with.
LEAST_FUSED = 2
# Of more pairs most share nothing: what is refused is not searched once more.
THOROUGH_PAIRS = 15


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
    if len(group.members) < LEAST_FUSED:
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
    name = named_input(wanted, names)
    if name is not None:
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
