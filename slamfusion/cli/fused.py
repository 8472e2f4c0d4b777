"""How a fusion is shown as tables; shared by ``fuse`` and ``run``."""

from __future__ import annotations

import math
import shlex
from collections.abc import Sequence
from typing import TYPE_CHECKING

from slamfusion.cli.output import is_verbose, notice, print_table, say
from slamfusion.jobs.documents import number

if TYPE_CHECKING:
    from slamfusion.align.records import (
        Alignment,
        Fusion,
        FusionResult,
        InputRecord,
        StoredFusion,
    )
    from slamfusion.jobs.records import DoubledWalls

PAIR_COLUMNS = (
    "reference ",
    "input ",
    "accepted ",
    "dx [m]",
    "dy [m]",
    "yaw [deg]",
    "score",
    "overlap",
    "runner-up ratio",
)


def print_fusion(
    result: FusionResult | StoredFusion, doubled: DoubledWalls | None, wanted: str | None
) -> None:
    """Print how each input lies to the reference, how many were fused and in whose frame.

    ``--verbose`` adds why each was accepted, and where the inputs are, ready to paste.
    """
    from slamfusion.jobs.fuse_documents import fusion_sentences  # noqa: PLC0415  (loads slowly)

    print_table(
        PAIR_COLUMNS[1:],
        [_row(record, result.reference) for record in result.inputs],
        notes=[
            "" if record.accepted and not is_verbose() else record.reason
            for record in result.inputs
        ],
        title=f"Alignment to {result.reference}" + (f", on {result.device}" * is_verbose()),
    )
    fused, added = fusion_sentences(result, doubled, wanted)
    say(fused)
    if not is_verbose():
        return
    say(added)
    for group in (result, *result.others):
        print(f"poses of the inputs in the frame of {group.reference}, as starts:")
        print("   " + "".join(f" {_start_words(pair)}" for pair in _alignments(group)))
        print("and as transforms:")
        for pair in _alignments(group):
            if pair.moving != pair.reference:
                print(f"    {_transform_words(pair)}")


def _alignments(result: Fusion) -> list[Alignment]:
    """Return how each input that was fused lies to the reference."""
    found = [record.alignment for record in result.accepted]
    return [pair for pair in found if pair is not None]


def _start_words(pair: Alignment) -> str:
    """Return the option ``--start`` that expects a map where it was found."""
    motion = pair.transform
    x, y, yaw = number(motion.x), number(motion.y), number(math.degrees(motion.yaw_rad), 2)
    return shlex.join(["--start", f"{pair.moving}={x},{y},{yaw}deg"])


def _transform_words(pair: Alignment) -> str:
    """Return the command that publishes a map's frame in that of the reference."""
    motion = pair.transform
    return shlex.join(
        [
            *("ros2", "run", "tf2_ros", "static_transform_publisher"),
            *("--x", f"{motion.x:.4f}", "--y", f"{motion.y:.4f}"),
            *("--yaw", f"{motion.yaw_rad:.6f}"),
            *("--frame-id", pair.reference, "--child-frame-id", pair.moving),
        ]
    )


def tell_left_out(result: FusionResult | StoredFusion) -> None:
    """Name on stderr the inputs without a vote, bent ones, and what the map was cut off from."""
    from slamfusion.jobs.fuse_documents import left_out_sentences  # noqa: PLC0415  (loads slowly)

    for sentence in left_out_sentences(result):
        notice(sentence)


def print_pairs(pairs: Sequence[Alignment], device: str) -> None:
    """Print the pairs of maps of which nothing was fused."""
    print_table(
        PAIR_COLUMNS,
        [[pair.reference, *_cells(pair, _accepted(pair))] for pair in pairs],
        notes=[pair.reason for pair in pairs],
        title=f"Nothing was fused (on {device})",
    )


def _accepted(found: Alignment) -> str:
    """Return whether an alignment is accepted, and if so how good it is, where that is known."""
    return found.strength or ("yes" if found.accepted else "NO")


def _row(record: InputRecord, reference: str) -> list[str]:
    """Return an input's row of the alignment table."""
    accepted = "yes" if record.accepted else "NO"
    if record.accepted and record.alignment is not None:
        accepted = _accepted(record.alignment)
    if record.name == reference:
        accepted = "reference"
    if record.copy_of is not None:
        accepted = "copy"
    if record.alignment is None:
        return [record.name, accepted, *["-"] * (len(PAIR_COLUMNS) - 3)]
    return [record.name, *_cells(record.alignment, accepted)[1:]]


def _cells(found: Alignment, accepted: str) -> list[str]:
    """Return an alignment's cells of the table, from the input's name on."""
    return [
        found.moving,
        accepted,
        number(found.transform.x),
        number(found.transform.y),
        number(math.degrees(found.transform.yaw_rad), 2),
        number(found.score),
        number(found.overlap),
        number(None if found.runner_up is None else found.runner_up.ratio, 2),
    ]
