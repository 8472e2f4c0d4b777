"""What alignment and fusion answer: plain records, shared by the tables, JSON and the report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from slamfusion.align.decide import DecisionKind, MatchEvidence, Strength, strength_of
from slamfusion.geometry import B8, F64, I8, Pose2
from slamfusion.grid import IDENTITY, OccupancyGrid
from slamfusion.json_values import POSE, printed_as
from slamfusion.vote.tiles import GridLayer


@dataclass(frozen=True)
class RunnerUp:
    """The best distinct peak of a search other than its answer."""

    transform: Pose2 = field(metadata=POSE)
    """Pose of the moving map's frame in the reference's."""
    score: float
    """On the scale of the alignment's score."""
    ratio: float
    """Score over the answer's; near 1 the place looks alike under both."""


@dataclass(frozen=True, kw_only=True)
class Alignment:
    """One moving map against one reference map."""

    moving: str = field(metadata=printed_as("name"))
    """The moving map."""
    reference: str
    """The reference map."""
    accepted: bool = False
    """Whether the alignment is accepted."""
    reason: str
    """Why (not)."""
    transform: Pose2 = field(default=IDENTITY, metadata=POSE)
    """Transform of a point of the moving map's frame into the reference's."""
    score: float = 0.0
    """Symmetric wall score, 1 for identical maps; larger is better."""
    overlap: float = 0.0
    """Cells known in both over known cells of the smaller map, 0 to 1."""
    error: float = 0.0
    """[F16] map error over the reference's known box; smaller is better."""
    runner_up: RunnerUp | None = None
    """The best distinct peak other than the answer; null when there is none."""
    time_s: float = 0.0
    """Wall time, seconds."""
    statistics: dict[str, float] = field(default_factory=dict)
    """Further numbers of the answer, by name."""
    yaw_profile: F64 | None = field(default=None, repr=False)
    """(K, 2): yaw in rad (of ``transform``) and the most evidence there, as a share of the most
    anywhere."""
    evidence: MatchEvidence | None = field(default=None, metadata=printed_as("match_evidence"))
    """How much evidence supports it; null where nothing could be searched."""
    decision: DecisionKind = field(default="not searched", metadata=printed_as("match_decision"))
    """What was decided: accepted, or why not, in one of a few words."""
    strength: Strength | None = field(init=False)
    """How good an accepted match is: by the share of the common walls that it explains, strong from
    0.85 on, fair from 0.7 on, else weak; null: not accepted, or nothing was searched."""

    def __post_init__(self) -> None:
        found = self.evidence if self.accepted else None
        object.__setattr__(self, "strength", None if found is None else strength_of(found.share))


@dataclass(frozen=True)
class Bent:
    """A map whose walls do not agree with those of the others."""

    share: float
    """Share of its walls that agree, 0 to 1."""
    x: float
    """Where it agrees least, in the frame of the fused map, metres."""
    y: float
    """Its y, metres."""

    @property
    def place(self) -> str:
        """Where it agrees least, in words."""
        return f"x {self.x:.1f}, y {self.y:.1f} m"

    @property
    def words(self) -> str:
        """How far it agrees, and where least."""
        return (
            f"bent, agrees with the others on {100.0 * self.share:.0f} % of its walls; "
            f"worst at {self.place}"
        )


@dataclass(frozen=True)
class InputRecord:
    """One input of a fusion: its grid, what became of it, and its cells on the fused lattice.

    Attributes:
        alignment: against the reference; the reference's own is the identity. None when the
            grid could not be searched at all (e.g. all unknown); then ``reason`` says why.
        reason: why (not); one line.
        layer: what it says on the fused lattice; None when it did not vote.
        copy_of: the input that this one is a copy of, which votes for both; None: it is none.
    """

    grid: OccupancyGrid
    alignment: Alignment | None
    accepted: bool
    reason: str
    layer: GridLayer | None = None
    copy_of: str | None = None

    @property
    def name(self) -> str:
        """The input's name."""
        return self.grid.name

    @property
    def aligned(self) -> I8 | None:
        """(H, W) int8 in {-1, 0, 1} on all of the fused lattice; None when it did not vote."""
        return None if self.layer is None else self.layer.aligned()

    @property
    def dissent(self) -> B8 | None:
        """(H, W) bool, where this input voted and was outvoted; None when it did not vote."""
        return None if self.layer is None else self.layer.dissent()


@dataclass(frozen=True, kw_only=True)
class Fusion:
    """The outcome for the inputs of a fusion, whose map may be in a store.

    Attributes:
        reference: name of the reference input, whose frame and lattice the fused map has.
        inputs: one record per input, in the order given.
        pairs: every pair that was aligned, also between rejected inputs.
        phantom_cells: occupied in the fused map by vote, occupied in no input.
        weights: vote weight of each accepted input, by name, 0 to 1.
        wall_agreement: share of its walls that agree with the other maps', by name, 0 to 1; of the
            accepted inputs, where the vote weighs them.
        bent: the accepted inputs whose walls do not agree, by name.
        time_s: wall time of the whole fusion.
        left_out_m2: area that inputs know outside of the box that the fused map was cut to, square
            metres, by name; empty where nothing was cut.
        others: fusions of further groups of inputs, which share nothing that could be found with
            those of this one; the larger first. Their inputs are the members of the group.
    """

    reference: str
    inputs: tuple[InputRecord, ...]
    pairs: tuple[Alignment, ...] = ()
    phantom_cells: int
    weights: dict[str, float]
    wall_agreement: dict[str, float] = field(default_factory=dict)
    bent: dict[str, Bent] = field(default_factory=dict)
    device: str
    time_s: float = 0.0
    left_out_m2: Mapping[str, float] = field(default_factory=dict)
    others: tuple[Fusion, ...] = ()

    @property
    def accepted(self) -> tuple[InputRecord, ...]:
        """The inputs that voted."""
        return tuple(record for record in self.inputs if record.accepted)

    @property
    def doubtful(self) -> tuple[InputRecord, ...]:
        """The inputs that voted though much contradicts them."""
        found = [(record, record.alignment) for record in self.accepted]
        return tuple(record for record, own in found if own is not None and own.strength == "weak")

    @property
    def rejected(self) -> tuple[InputRecord, ...]:
        """The inputs that do not fit; copies of others are none of them."""
        return tuple(own for own in self.inputs if not own.accepted and own.copy_of is None)

    @property
    def copies(self) -> tuple[InputRecord, ...]:
        """The inputs for which another votes that is the same map."""
        return tuple(record for record in self.inputs if record.copy_of is not None)

    @property
    def bent_sentences(self) -> tuple[str, ...]:
        """One sentence for each bent map; one for both where there are two."""
        if len(self.bent) == len(self.accepted) == 2:
            (first, found), (second, _) = self.bent.items()
            share = f"{100.0 * found.share:.0f} % of their walls"
            worst = f"worst at {found.place}: one of them is bent"
            return (f"{first} and {second} agree on only {share}, {worst}",)
        limit = "; it votes only where it agrees"
        return tuple(
            f"{name}: {found.words}{limit if name in self.weights else ''}"
            for name, found in self.bent.items()
        )

    @property
    def remarks(self) -> list[tuple[str, str]]:
        """What has no vote, is doubtful or bent, or was cut off: each a subject and its text."""
        groups = (self, *self.others)
        said = (
            ("was rejected:", "", self.rejected),
            ("is a copy:", "; --keep-duplicates counts each", self.copies),
            ("may not belong here:", "", [own for group in groups for own in group.doubtful]),
        )
        return [
            *(
                (f"{own.name} {what}", own.reason + advice)
                for what, advice, records in said
                for own in records
            ),
            *(("", words) for group in groups for words in group.bent_sentences),
            *(
                (
                    f"the box of {group.reference} leaves out:",
                    f"{area:.1f} m2 of {name}; --extent union keeps it",
                )
                for group in groups
                for name, area in group.left_out_m2.items()
            ),
        ]


@dataclass(frozen=True, kw_only=True)
class FusionResult(Fusion):
    """A fused map and everything needed to judge it.

    Attributes:
        fused: cells in {-1, 0, 100}; frame and lattice of the reference.
        agreement: cells 0..100 or -1 on the same lattice.
    """

    fused: OccupancyGrid
    agreement: OccupancyGrid
    others: tuple[FusionResult, ...] = ()
