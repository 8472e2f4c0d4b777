"""Alignments that answer what a test says, so that each threshold is met to the last digit.

What is decided with the answers (believed, doubted, searched again, handed over) is the real thing;
only the search over cells is left out, and the clock that measures it.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from slamfusion.align.cancel import CancelToken
from slamfusion.align.decide import DecisionKind
from slamfusion.align.records import Alignment
from slamfusion.fusion.live import align
from slamfusion.fusion.live.align import Aligner
from slamfusion.fusion.live.lattice import Layer
from slamfusion.fusion.live.track import Track
from slamfusion.geometry import Pose2
from slamfusion.vote.lattice import Lattice

# A quarter of a metre is a power of two: limits in cells and in metres are equal to the digit.
CELL_M = 0.25


def found(
    x: float = 0.0,
    y: float = 0.0,
    yaw_rad: float = 0.0,
    *,
    accepted: bool = True,
    score: float = 0.8,
    reason: str = "",
    **statistics: float,
) -> Alignment:
    """Return what an alignment gave: the pose of the moving frame in the reference's, and more."""
    words = reason or ("walls match" if accepted else "walls do not match")
    pose = Pose2(x, y, yaw_rad)
    return Alignment("", "", pose, accepted, words, score, 0.6, 0.0, None, 0.0, dict(statistics))


MISFIT = found(accepted=False, score=0.0)


@dataclass
class Asked:
    """One alignment that was asked for.

    Attributes:
        what: ``track``, ``search`` or ``mirror``.
        names: of the reference and the moving map, joined: ``ab``.
        start: where it was to begin.
        cancel: what it was told to ask.
    """

    what: str
    names: str
    start: Pose2 | None = None
    cancel: CancelToken | None = None


@dataclass
class Script:
    """The answers by ``reference`` + ``moving``, and what was asked.

    Attributes:
        tracked: of tracking; without an answer a map fits where it lay.
        searched: of searches; without an answer nothing is found. An exception is raised.
        mirrored: pairs that fit better mirrored.
        takes_s: seconds of each search.
        now_s: the clock that measures it.
    """

    tracked: dict[str, Alignment | Exception] = field(default_factory=dict)
    searched: dict[str, Alignment | Exception] = field(default_factory=dict)
    mirrored: set[str] = field(default_factory=set)
    takes_s: float = 0.0
    now_s: float = 1000.0
    asked: list[Asked] = field(default_factory=list)

    def track_pair(
        self, reference: Any, moving: Any, device: object, start: Pose2, cancel: Any = None
    ) -> Alignment:
        del device
        asked = self._ask("track", reference, moving, start, cancel)
        return _answer(self.tracked.get(asked.names, replace(found(), transform=start)), asked)

    def align_pair(
        self,
        reference: Any,
        moving: Any,
        config: object,
        device: object,
        start: Pose2 | None = None,
        cancel: CancelToken | None = None,
        *,
        thorough: bool = True,
        image_after: Collection[DecisionKind] | None = None,
    ) -> Alignment:
        del config, device
        # Maps that grow are searched often: what is refused now may not be soon.
        assert not thorough
        assert image_after == align.MAY_BE_IMAGE
        asked = self._ask("search", reference, moving, start, cancel)
        self.now_s += self.takes_s
        if cancel is not None:
            cancel.check()
        return _answer(self.searched.get(asked.names, MISFIT), asked)

    def gain_of_image(self, aligner: object, reference: Any, moving: Any, *_: object) -> float:
        del aligner
        asked = self._ask("mirror", reference, moving, None, None)
        return 2.0 if asked.names in self.mirrored else 0.5

    def _ask(
        self, what: str, reference: Any, moving: Any, start: Pose2 | None, cancel: Any
    ) -> Asked:
        names = reference.grid.name + moving.grid.name
        self.asked.append(Asked(what, names, start, cancel))
        return self.asked[-1]

    def said(self, *kinds: str) -> list[str]:
        """Return what was asked since the last time, ``track ab``; of some kinds only."""
        out = [f"{one.what} {one.names}" for one in self.asked if not kinds or one.what in kinds]
        self.asked.clear()
        return out

    def perf_counter(self) -> float:
        return self.now_s


def _answer(given: Alignment | Exception, asked: Asked) -> Alignment:
    if isinstance(given, Exception):
        raise given
    reference, moving = asked.names[:-1], asked.names[-1]
    return replace(given, reference=reference, moving=moving)


def follow_script(patch: pytest.MonkeyPatch) -> Script:
    """Return a script that every aligner goes by while the patch lasts."""
    script = Script()
    for name in ("track_pair", "align_pair", "gain_of_image"):
        patch.setattr(align, name, getattr(script, name))
    patch.setattr(align, "time", script)
    patch.setattr(Aligner, "features", lambda _, track, __=None: _named(track.name))
    return script


def _named(name: str) -> SimpleNamespace:
    return SimpleNamespace(grid=SimpleNamespace(name=name))


def voter(name: str, transform: Pose2 | None = None, **more: Any) -> Track:
    """Return an input that votes; its known box is about the origin of its frame.

    It has 100 walls, and 100 cells of 0.25 m.
    """
    lattice = Lattice(CELL_M, Pose2())
    given = {
        "version": 1,
        "walls": 100,
        "is_live": True,
        "is_steady": True,
        "accepted": True,
        "reason": "votes",
        "layer": Layer(np.zeros((10, 10), dtype=np.int8), lattice),
    }
    return Track(name, transform=transform or Pose2(), **{**given, **more})
