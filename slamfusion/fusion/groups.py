"""Inputs that fit together: align pairs, find the largest group, choose its frame."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import median

import numpy as np

from slamfusion.align.features import GridFeatures
from slamfusion.align.pair import Pair
from slamfusion.align.records import Alignment
from slamfusion.align.starts import named_input
from slamfusion.config import SMALLEST
from slamfusion.errors import AlignmentError, ConfigError
from slamfusion.fusion.grouping import FusionSetup, GroupSearch, MapGroup, placed
from slamfusion.geometry import F64, Pose2, wrap_angles

REFERENCE_AREA_SHARE = 0.5
# [F16]: any two of three decide, so one input has no other to agree with.
LEAST_FUSED = 2


@dataclass(frozen=True, eq=False)
class Members:
    """Inputs that fit together, and how.

    Attributes:
        reference: name of the member in whose frame and lattice the fused map is.
        alignments: each member's alignment to the reference; the reference's own is the identity.
    """

    reference: str
    alignments: dict[str, Alignment]

    def part(self, names: Sequence[str]) -> Members:
        """Return some of the members, in the frame of the reference or of the first of them."""
        reference = self.reference if self.reference in names else names[0]
        into = self.alignments[reference].transform.inverse()
        alignments = {
            name: replace(
                self.alignments[name],
                reference=reference,
                transform=into.compose(self.alignments[name].transform),
            )
            for name in names
        }
        return Members(reference, alignments)


@dataclass(frozen=True, eq=False)
class AlignedGroup(Members):
    """The largest group of inputs that fit together, and the outcome of the others.

    Attributes:
        left_out: why every other input is no member, and the alignment that shows it.
        others: further groups of two or more, the larger first.
    """

    left_out: dict[str, tuple[str, Alignment | None]]
    pairs: tuple[Alignment, ...]
    others: tuple[Members, ...] = ()


def align_group(
    features: dict[str, GridFeatures],
    reasons: dict[str, str],
    setup: FusionSetup,
    names: Sequence[str],
) -> AlignedGroup:
    """Align pairs, find the groups that fit together, and choose their frames.

    Every pair of up to six inputs is aligned; of more inputs the promising pairs: see ``grouping``.

    Args:
        features: the inputs that can be aligned, by name, all at one resolution.
        reasons: why the other inputs cannot.
        names: all inputs, in order.

    Raises:
        AlignmentError: fewer than two of several inputs agree; ``pairs`` holds the alignments.
        ConfigError: the reference named in the config is no member.
    """
    config, search = setup.config, GroupSearch(features, setup)
    try:
        found, pairs = search.run()
    finally:
        search.close()
    search.tell("vote", search.done)
    least = 1 if len(names) == 1 else LEAST_FUSED
    found = [group for group in found if len(group) >= least]
    if not found:
        told = [f"{name}: {reason}" for name, reason in reasons.items()]
        told += [f"{pair.moving} to {pair.reference}: {pair.reason}" for pair in pairs]
        words = "; ".join(told) or "where starts put them no two can meet"
        listed = ", ".join(names)
        message = f"no two of the inputs {listed} align, so nothing is fused ({words})"
        raise AlignmentError(message, tuple(pairs))
    group, *rest = found
    reference = choose_reference(list(group), features, config.reference, names)
    alignments = _to_reference(reference, group, features, pairs)
    wanted = None if named_input(config.reference, names) in names else config.reference
    others = []
    for other in rest:
        own = choose_reference(list(other), features, wanted, names)
        others.append(Members(own, _to_reference(own, other, features, pairs)))
    groups = [Members(reference, alignments), *others]
    left_out = {name: _left_out(name, groups, pairs) for name in features if name not in group}
    return AlignedGroup(reference, alignments, left_out, tuple(pairs), tuple(others))


def choose_reference(
    members: Sequence[str],
    features: Mapping[str, GridFeatures],
    wanted: str | None,
    names: Sequence[str],
) -> str:
    """Return the name of the member in whose frame and lattice the fused map is.

    Args:
        members: of the group, in the order of the inputs.
        wanted: the setting: a name or an index of the inputs, or ``SMALLEST``; None: the first
            member.
        names: all inputs, in order.
    """
    name = named_input(wanted, names)
    if name == SMALLEST and name not in names:
        # The smallest box that knows half the group's median known area.
        typical = median(features[one].known_cells for one in members)
        grown = [
            one for one in members if features[one].known_cells >= REFERENCE_AREA_SHARE * typical
        ]
        return min(grown, key=lambda one: math.prod(features[one].shape))
    if name is not None:
        if name not in members:
            state = "was rejected" if name in names else "is none of them"
            raise ConfigError(
                f"reference {wanted!r} {state}; the inputs that fit together are "
                f"{', '.join(members)}"
            )
        return name
    return members[0]


def _to_reference(
    reference: str,
    group: MapGroup,
    features: Mapping[str, GridFeatures],
    pairs: Sequence[Alignment],
) -> dict[str, Alignment]:
    """Return each member's alignment to the reference, the reference's own the identity."""
    direct = {frozenset((pair.reference, pair.moving)): pair for pair in pairs if pair.accepted}
    back = group[reference].inverse()
    out = {}
    for name in group:
        if name == reference:
            out[name] = Alignment(
                moving=name, reference=name, accepted=True, reason="the reference", score=1.0,
                overlap=1.0,
            )  # fmt: skip
            continue
        transform = back.compose(group[name])
        pair = direct.get(frozenset((reference, name)))
        if pair is not None:
            own = _most_supported(name, pair, group, pairs)
            if own.reference != reference:
                own = _in_frame_of(reference, back.compose(group[own.reference]), own)
            out[name] = replace(own, transform=transform)
        else:
            out[name] = placed(Pair(features[reference], features[name]), transform)
    return out


def _most_supported(
    name: str, own: Alignment, group: MapGroup, pairs: Sequence[Alignment]
) -> Alignment:
    """Return the alignment that says how well a member fits.

    That is its own to the reference, unless walls of another member support it more: the reference
    may be bent.
    """
    members = set(group)
    partners = [
        pair for pair in pairs if pair.accepted and name in {pair.reference, pair.moving} <= members
    ]
    best = max(partners, key=lambda pair: (_rank(pair), pair.score))
    return _from_the_side_of(name, best if _rank(best) > _rank(own) else own)


def _in_frame_of(reference: str, motion: Pose2, pair: Alignment) -> Alignment:
    """Return a pair in the frame of ``reference``; ``motion`` maps the pair's own to it."""
    told = _mapped(pair, motion.compose, lambda yaws: wrap_angles(yaws + motion.yaw_rad))
    return replace(told, reference=reference, reason=f"to {pair.reference}: {pair.reason}")


def _mapped(
    pair: Alignment, into: Callable[[Pose2], Pose2], turned: Callable[[F64], F64]
) -> Alignment:
    """Return a pair with its transforms, and the yaws of its profile, mapped."""
    runner_up, profile = pair.runner_up, pair.yaw_profile
    if runner_up is not None:
        runner_up = replace(runner_up, transform=into(runner_up.transform))
    if profile is not None:
        profile = np.column_stack((turned(profile[:, 0]), profile[:, 1]))
        profile = profile[np.argsort(profile[:, 0])]
    return replace(pair, transform=into(pair.transform), runner_up=runner_up, yaw_profile=profile)


def _rank(pair: Alignment) -> int:
    """Return how good an accepted alignment is, as a number."""
    return (None, "weak", "fair", "strong").index(pair.strength)


def _left_out(
    name: str, groups: Sequence[Members], pairs: Sequence[Alignment]
) -> tuple[str, Alignment | None]:
    """Return why an input is not in the first group, and the alignment that shows it.

    That is the best one to a reference if any, else the best of the failed. Of a map that is in no
    group those with every group count: it may show the place of any.
    """
    if any(name in group.alignments for group in groups):
        groups = groups[:1]
    references = [group.reference for group in groups]
    members = {other for group in groups for other in group.alignments}
    mine = [
        _from_the_side_of(name, pair)
        for pair in pairs
        if name in {pair.reference, pair.moving} and {pair.reference, pair.moving} & members
    ]
    if not mine:
        return f"no pair of it with the maps around {references[0]} was promising", None
    shown = max(mine, key=lambda pair: (pair.reference in references, pair.score))
    return f"to {shown.reference}: {shown.reason}", shown


def _from_the_side_of(name: str, pair: Alignment) -> Alignment:
    """Return the pair with ``name`` as the moving grid; scores are symmetric, the error is not."""
    if pair.moving == name:
        return pair
    back = _mapped(pair, Pose2.inverse, np.negative)
    return replace(back, reference=pair.moving, moving=name)
