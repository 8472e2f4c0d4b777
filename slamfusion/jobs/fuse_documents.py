"""What is said of a fusion of maps: its JSON document, and sentences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from slamfusion.align.records import Alignment, Bent, Fusion, FusionResult, InputRecord
from slamfusion.config import RunConfig
from slamfusion.errors import AlignmentError, counted
from slamfusion.evaluation.doubled_walls import doubled_wall_share, fused_doubled_shares
from slamfusion.evaluation.map_error import MapError
from slamfusion.grid import OccupancyGrid
from slamfusion.jobs.inputs import NO_FILES, GivenMaps
from slamfusion.jobs.outputs import AGREEMENT_END
from slamfusion.jobs.records import Circumstances
from slamfusion.json_values import FLAT, flat_or_null


@dataclass(frozen=True, eq=False, kw_only=True)
class Evaluation(MapError):  # noqa: N818  (a measure, no exception)
    """A map's errors, and the alignment with the truth that they rest on."""

    aligned: bool
    """Whether the alignment is accepted; a map that is used as it is counts as aligned."""
    alignment: Alignment | None
    """The alignment with the truth; null: the map was taken as it lies."""

    @property
    def why_not(self) -> str:
        """Why the map could not be aligned; empty if it counts as aligned."""
        return "" if self.alignment is None or self.aligned else self.alignment.reason


@dataclass(frozen=True, kw_only=True)
class FusedInput:
    """An input of a fusion; where it was not aligned with the reference, without numbers."""

    alignment: Alignment | None = field(default=None, metadata=flat_or_null(Alignment))
    agreement: float | None = None
    """Share of its walls that agree with the other maps, 0 to 1; null: nothing to compare."""
    weight: float = 0.0
    """Of its vote in all, 0 to 1; less or more where its walls agree less or more."""
    bent: Bent | None = None
    """Where it agrees least, if it is bent; null: it agrees with the others."""
    name: str
    """The input."""
    reference: str | None = None
    """The input whose frame the fused map has; null where nothing was fused."""
    accepted: bool = False
    """Whether it voted."""
    reason: str
    """Why (not)."""

    @classmethod
    def of(cls, record: InputRecord, result: Fusion) -> FusedInput:
        """Describe an input: its alignment, its vote, and the outcome."""
        found = record.alignment
        return cls(
            # Strong, fair or weak is an input that votes.
            alignment=None if found is None else replace(found, accepted=record.accepted),
            agreement=result.wall_agreement.get(record.name),
            weight=result.weights.get(record.name, 0.0),
            bent=result.bent.get(record.name),
            name=record.name,
            reference=result.reference if found is None else found.reference,
            accepted=record.accepted,
            reason=record.reason,
        )


@dataclass(frozen=True)
class DoubledWalls:
    """Shares of the wall cells that have a parallel wall close by, the trace of a slip."""

    inputs: dict[str, float]
    """Of each input as it was given, by name; 0 to 1."""
    fused: float
    """Of the fused map, 0 to 1."""
    added_by_fusion: float
    """Of the fused map's wall cells, doubled there and in no input; 0 to 1."""

    @classmethod
    def of(
        cls, result: FusionResult, config: RunConfig, known: Mapping[str, float] | None = None
    ) -> DoubledWalls:
        """Measure a fusion."""
        known, normalize = known or {}, config.fusion.normalize
        shares = {
            record.name: known[record.name]
            if record.name in known
            else doubled_wall_share(record.grid.classified(normalize).cells == 1)
            for record in result.inputs
        }
        layers = (record.layer for record in result.accepted if record.layer is not None)
        aligned = ((layer.on(layer.box) == 1, layer.box) for layer in layers)
        return cls(shares, *fused_doubled_shares(result.fused.cells, aligned))

    def of_maps(self, fused: str) -> dict[str, float]:
        """Return the shares by the names of the maps, of which the fused one has this."""
        return self.inputs | {fused: self.fused}


@dataclass(frozen=True, eq=False, kw_only=True)
class FusionRecord:
    """The result of a fusion; null and empty values where nothing was fused."""

    inputs: Sequence[FusedInput]
    """The inputs, in the order given."""
    reference: str | None = None
    """The input whose frame and lattice the fused map has."""
    fused_count: int = 0
    """Inputs that voted."""
    phantom_cells: int | None = None
    """Cells occupied in the fused map by vote, and in no input."""
    left_out_m2: Mapping[str, float] = field(default_factory=dict)
    """Area that inputs know outside of the box of --extent reference, square metres, by input."""
    doubled_wall_share: DoubledWalls | None = None
    """Shares of the wall cells that have a parallel wall close by."""
    weights: Mapping[str, float] = field(default_factory=dict)
    """Weight of each voter, 0 to 1, by name; a drawn map votes and is no input."""
    pairs: Sequence[Alignment]
    """Every pair that was aligned, also between rejected inputs."""
    copies: Mapping[str, str] = field(default_factory=dict)
    """Inputs that are the same map as another, by name, and which of them votes for both."""

    @classmethod
    def of(cls, result: Fusion, doubled: DoubledWalls | None) -> FusionRecord:
        """Describe a fusion; with doubled walls where they were measured."""
        copies = {record.name: record.copy_of for record in result.copies}
        return cls(
            inputs=[FusedInput.of(record, result) for record in result.inputs],
            reference=result.reference,
            fused_count=len(result.accepted),
            phantom_cells=result.phantom_cells,
            left_out_m2=result.left_out_m2,
            doubled_wall_share=doubled,
            weights=result.weights,
            pairs=result.pairs,
            copies={name: other for name, other in copies.items() if other is not None},
        )

    @classmethod
    def failed(
        cls, grids: Sequence[OccupancyGrid], pairs: Sequence[Alignment], reason: str
    ) -> FusionRecord:
        """Describe maps of which nothing was fused."""
        inputs = [
            FusedInput(name=grid.name, reason=_reason(grid.name, pairs, reason)) for grid in grids
        ]
        return cls(inputs=inputs, pairs=pairs)


@dataclass(frozen=True, eq=False)
class FusedGroup:
    """Inputs that share ground, and the map that they became."""

    fused: str | None
    """YAML file of the fused map; null where it is in a store alone."""
    agreement: str | None
    """YAML file of the agreement map; null where it is in a store alone."""
    store: Path | None
    """Zarr store of both, with -o OUT.zarr; else null."""
    reference: str
    """The input whose frame and lattice the fused map has."""
    inputs: Sequence[Alignment]
    """How each of them lies to the reference."""
    left_out_m2: Mapping[str, float]
    """Area that inputs know outside of the box of --extent reference, square metres, by input."""
    weights: Mapping[str, float]
    """Weight of each vote, by input."""

    @classmethod
    def of(cls, result: Fusion, stem: Path | None, store: Path | None) -> FusedGroup:
        """Describe a group by its fusion and its files."""
        return cls(
            None if stem is None else f"{stem}.yaml",
            None if stem is None else f"{agreement_stem(stem)}.yaml",
            store,
            result.reference,
            [item.alignment for item in result.accepted if item.alignment is not None],
            result.left_out_m2,
            result.weights,
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class FuseDocument:
    """``slamfusion fuse``; exit code 1 where nothing was fused."""

    fusion: FusionRecord = field(metadata=FLAT)
    fused: str | None = None
    """YAML file of the fused map; null where nothing was fused, or it is in a store alone."""
    agreement: str | None = None
    """YAML file of the agreement map; null where nothing was fused, or it is in a store alone."""
    store: Path | None = None
    """Zarr store of both, with -o OUT.zarr; else null."""
    groups: Sequence[FusedGroup] = ()
    """Groups of inputs that share ground, the largest, which is listed above, first."""
    evaluations: Sequence[Evaluation] = ()
    """Errors of the inputs and of the fused map, with --truth."""
    given: GivenMaps = field(default=NO_FILES, metadata=FLAT)
    error: str | None = None
    """Why nothing was fused: maps that do not fit, or --require-all; null where it was."""
    circumstances: Circumstances = field(metadata=FLAT)
    time_s: float | None = None
    """Wall time of the fusion, seconds; null where nothing was fused."""

    @classmethod
    def failed(
        cls, error: AlignmentError, circumstances: Circumstances, given: GivenMaps = NO_FILES
    ) -> FuseDocument:
        """Describe maps of which nothing was fused."""
        return cls(
            fusion=FusionRecord.failed(error.grids, error.pairs, str(error)),
            given=given,
            error=str(error),
            circumstances=circumstances,
        )


def agreement_stem(stem: Path) -> Path:
    """Return the path, without suffix, of the agreement map beside a fused map."""
    return stem.with_name(stem.name + AGREEMENT_END)


def fusion_sentences(
    result: Fusion, doubled: DoubledWalls | None, wanted: str | None
) -> tuple[str, str]:
    """Say how many inputs were fused in whose frame; and what the vote added."""
    names = [record.name for record in result.inputs]
    before = names[: names.index(result.reference)]
    why = "the first map given"
    if wanted is not None:
        why = f"--reference {wanted}"
    elif before:
        why = f"the first map that fits; before it: {', '.join(before)}"
    text = f"Fused {len(result.accepted)} of {len(names)} maps in the frame of {result.reference}"
    text += f" ({why})."
    for other in result.others:
        apart = ", ".join(record.name for record in other.accepted)
        text += f" Fused apart from these, in the frame of {other.reference}: {apart}."
    share = "" if doubled is None else f"{doubled.added_by_fusion:.1%} of the walls doubled, "
    cells = f"{counted(result.phantom_cells, 'cell')} occupied in no input"
    return text, f"The vote: {cells}, {share}{result.time_s:.1f} s."


def unaligned_sentences(evaluations: Sequence[Evaluation]) -> list[str]:
    """Return why maps could not be aligned with the truth: they may be mirrored, for example."""
    return [f"not aligned: {item.name}: {item.why_not}" for item in evaluations if item.why_not]


def _reason(name: str, pairs: Sequence[Alignment], otherwise: str) -> str:
    """Return why an input found no partner: the reason of its best rejected pair."""
    rejected = [
        pair for pair in pairs if name in {pair.reference, pair.moving} and not pair.accepted
    ]
    if not rejected:
        return otherwise
    best = max(rejected, key=lambda pair: pair.score)
    other = best.reference if best.moving == name else best.moving
    return f"against {other}: {best.reason}"
