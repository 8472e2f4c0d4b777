"""``LiveState``: the state with which a live fusion resumes in the same fused frame.

As bytes: one line with the kind and version, one with the SHA-256 of the rest, and a zlib stream of
one line of JSON and the cells of both grids. Nothing is unpacked before its digest is checked, and
nothing in it is code.
"""

from __future__ import annotations

import hashlib
import json
import math
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from slamfusion.errors import SlamFusionError
from slamfusion.geometry import Pose2, row_of
from slamfusion.grid import CellBox, OccupancyGrid
from slamfusion.vote.lattice import Lattice

KIND = b"slamfusion live state"
VERSION = 2
# Most of a fused map is alike; more effort makes it hardly smaller.
ZLIB_LEVEL = 1


class StateError(SlamFusionError):
    """Bytes are no state, or an unusable one."""


@dataclass(frozen=True, eq=False)
class LiveState:
    """The fused frame, where the inputs lie in it, and the last fused map.

    Attributes:
        lattice: of the fused frame; metres per cell, and the pose of its cell [0, 0].
        fused: cells -1 unknown, 0 free, 100 occupied, on the lattice.
        agreement: share of the votes in percent, -1 without; the same cells.
        transforms: every accepted input's map frame into the fused frame, metres, by name.
        reference: name of the reference input; empty without.
        scores: search score of a pair of names, with which tracked scores are compared.
        stamp_s: of the newest map in ``fused``, seconds; 0 if all were saved maps.
        box: the cells of the lattice that ``fused`` covers.
    """

    lattice: Lattice
    fused: OccupancyGrid
    agreement: OccupancyGrid
    transforms: Mapping[str, Pose2]
    reference: str = ""
    scores: Mapping[frozenset[str], float] = field(default_factory=dict)
    stamp_s: float = 0.0
    box: CellBox = field(init=False)

    def __post_init__(self) -> None:
        """Check sizes and finite numbers; StateError otherwise."""
        first, shape = self.lattice.cell_of(self.fused), self.fused.cells.shape
        if not all(map(math.isfinite, (self.stamp_s, *self.scores.values()))):
            raise StateError("a state with numbers that are not finite")
        if first is None or shape != self.agreement.cells.shape:
            raise StateError(f"a state with maps off its lattice, or of two sizes: {shape}")
        object.__setattr__(self, "box", CellBox(0, 0, *shape).moved(*first))

    def to_bytes(self) -> bytes:
        """Return the state as bytes, the same for equal states."""
        record = {
            "resolution": self.lattice.resolution,
            "origin": row_of(self.lattice.origin).tolist(),
            "first": [self.box.row0, self.box.col0],
            "shape": list(self.box.shape),
            "transforms": {name: row_of(pose).tolist() for name, pose in self.transforms.items()},
            "reference": self.reference,
            "scores": [[*sorted(pair), score] for pair, score in self.scores.items()],
            "stamp_s": self.stamp_s,
        }
        head = json.dumps(record, allow_nan=False).encode() + b"\n"
        cells = self.fused.cells.tobytes() + self.agreement.cells.tobytes()
        body = zlib.compress(head + cells, ZLIB_LEVEL)
        return KIND + b" %d\n%s\n" % (VERSION, hashlib.sha256(body).hexdigest().encode()) + body

    @classmethod
    def from_bytes(cls, data: bytes) -> LiveState:
        """Return the state that ``to_bytes`` wrote; StateError for other or damaged bytes."""
        head, _, rest = data.partition(b"\n")
        if not is_state(data):
            raise StateError("this is no state of a live fusion")
        version = head.removeprefix(KIND).strip()
        if version != b"%d" % VERSION:
            found = version.decode(errors="replace")[:20]
            raise StateError(f"wanted a state of version {VERSION}, found {found!r}")
        digest, _, body = rest.partition(b"\n")
        if hashlib.sha256(body).hexdigest().encode() != digest:
            raise StateError("the state is damaged or not whole: its digest is another")
        try:
            line, _, cells = zlib.decompress(body).partition(b"\n")
            record = json.loads(line)
            shape = (2, *(int(side) for side in record["shape"]))
            row, col = (int(index) for index in record["first"])
            lattice = Lattice(float(record["resolution"]), Pose2(*map(float, record["origin"])))
            both = np.frombuffer(cells, dtype=np.int8).reshape(shape)
            fused, agreement = (
                OccupancyGrid(own, lattice.resolution, lattice.corner(row, col), name)
                for own, name in zip(both, ("fused", "agreement"), strict=True)
            )
            return cls(
                lattice,
                fused,
                agreement,
                {
                    str(name): Pose2(*map(float, numbers))
                    for name, numbers in record["transforms"].items()
                },
                str(record["reference"]),
                {frozenset((str(a), str(b))): float(score) for a, b, score in record["scores"]},
                float(record["stamp_s"]),
            )
        except (ArithmeticError, ValueError, KeyError, TypeError, zlib.error) as error:
            message = f"the state cannot be understood: {type(error).__name__}: {error}"
            raise StateError(message) from None


def is_state(data: bytes) -> bool:
    """Return whether bytes start as a state of any version does, damaged or not."""
    return data.startswith(KIND + b" ")
