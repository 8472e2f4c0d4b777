"""Start poses: where maps are expected to lie.

Starts are poses of map frames in one frame that all of them share (``known_init_poses`` of ROS's
map_merge are the same). A pair of maps that both have one is searched only around the motion that
follows from the two, within the sum of their tolerances. A pair in which one map has none is
searched everywhere.

A single start is in the frame of the reference if one is named, else of the drive of the other
maps, else of the only other map.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

from slamfusion.config import START_M, START_RAD
from slamfusion.errors import StartError
from slamfusion.geometry import Pose2

PAIR = 2


@dataclass(frozen=True)
class StartPose:
    """Where a map frame is expected, and how far its map may lie from there.

    Attributes:
        pose: of the frame in a frame that several starts share, or in another map's; metres.
        metres: how far the centre of the map's known box may lie from where ``pose`` puts it, along
            x and along y.
        radians: how far the map may be turned from there.
    """

    pose: Pose2
    metres: float = START_M
    radians: float = START_RAD

    def __post_init__(self) -> None:
        """Raise ``StartError`` if a tolerance is negative or not finite."""
        if not (0.0 <= self.metres < math.inf and 0.0 <= self.radians < math.inf):
            message = f"tolerances of a start must be finite and at least 0, found {self.reach}"
            raise StartError(message)

    @classmethod
    def of(cls, values: Sequence[float]) -> StartPose:
        """Return a start of 3 or 5 numbers: x, y, yaw, and tolerances in m and rad."""
        return cls(Pose2(*values[:3]), *values[3:])

    @property
    def reach(self) -> str:
        """The tolerances as a sentence has them."""
        return f"{self.metres:g} m and {self.radians:g} rad"

    def inverse(self) -> StartPose:
        """Return where the other map's frame is expected in this one's."""
        return StartPose(self.pose.inverse(), self.metres, self.radians)

    def seen_from(self, other: StartPose) -> StartPose:
        """Return where this map's frame is expected in that of another; tolerances add up."""
        return StartPose(
            other.pose.inverse().compose(self.pose),
            self.metres + other.metres,
            self.radians + other.radians,
        )


# The start of a map at the origin of the shared frame.
_ORIGIN = StartPose(Pose2(), 0.0, 0.0)


@dataclass(frozen=True)
class Starts:
    """The starts of the inputs of one fusion.

    Attributes:
        given: by name of the input.
        frame: inputs in whose frame these are told; they lie at its origin.
        pairs: where a map frame is expected in another's, by the other's name and its own, for
            pairs without ``given`` starts.
    """

    given: Mapping[str, StartPose] = field(default_factory=dict)
    frame: frozenset[str] = frozenset()
    pairs: Mapping[tuple[str, str], StartPose] = field(default_factory=dict)

    def between(self, reference: str, moving: str) -> StartPose | None:
        """Return where the frame of ``moving`` is expected in ``reference``'s; None: unknown."""
        if not {reference, moving} & set(self.given):
            return self.pairs.get((reference, moving))
        still, moved = (
            self.given.get(name, _ORIGIN if name in self.frame else None)
            for name in (reference, moving)
        )
        return None if still is None or moved is None else moved.seen_from(still)


def named_input(wanted: str | None, names: Sequence[str]) -> str | None:
    """Return the input that a name or an index from 0 means; another word as it is."""
    if wanted is None or wanted in names or not wanted.isdecimal() or int(wanted) >= len(names):
        return wanted
    return names[int(wanted)]


def pose_of(start: Pose2 | StartPose | None) -> Pose2 | None:
    """Return a start without its tolerances."""
    return start.pose if isinstance(start, StartPose) else start


def place_starts(
    starts: Mapping[str, Sequence[float]],
    inputs: Sequence[str] | None,
    reference: str | None = None,
    drive: Collection[str] = (),
) -> Starts:
    """Check the configured starts against the inputs.

    Args:
        starts: 3 or 5 numbers by name, see ``StartPose.of``.
        inputs: names of all inputs in order; None: not known yet, so every name is accepted.
        reference: name or index of the reference that the settings ask for.
        drive: inputs of one drive, which share a frame.

    Raises:
        StartError: a start names no input, or a single start has no frame.
    """
    given = {name: StartPose.of(values) for name, values in starts.items()}
    if inputs is None:
        return Starts(given)
    for name in given:
        if name not in inputs:
            message = (
                f"a start names {name!r}, which is no input; the inputs are {', '.join(inputs)}"
            )
            raise StartError(message)
    if len(given) != 1 or len(inputs) < PAIR:
        return Starts(given)
    (only,) = given
    # The others at the origin of the frame that a single start is given in.
    named = named_input(reference, inputs)
    if named is not None and named in inputs and named != only and named not in drive:
        return Starts(given, frozenset({named}))
    frame = frozenset(drive) - {only}
    if not frame and len(inputs) == PAIR:
        frame = frozenset(inputs) - {only}
    if not frame:
        raise StartError(
            f"the start of {only!r} alone says nothing of where it lies to the other "
            f"{len(inputs) - 1} inputs; give one of theirs too, or name the reference"
        )
    return Starts(given, frame)
