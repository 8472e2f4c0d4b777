"""Settings of the fusion: normalise, align, vote, evaluate; and of fusing live maps."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, TypeAlias

from slamfusion.config.core import Checked, option
from slamfusion.errors import ConfigError

# How maps vote; and how a fused map comes to be, by such a vote or drawn from scans.
VoteMode: TypeAlias = Literal["consensus", "majority"]
FusionMode: TypeAlias = Literal[VoteMode, "drawn"]

# What a setting calls the map with the smallest known box.
SMALLEST = "smallest"


@dataclass(frozen=True)
class NormalizeConfig(Checked):
    """From occupancy in percent to unknown / free / occupied on one resolution."""

    occupied_percent: float = option(
        65.0, "a cell at or above this is occupied", low=0.0, high=100.0
    )
    free_percent: float = option(25.0, "a cell at or below this is free", low=0.0, high=100.0)
    resolution: float | None = option(
        None,
        "cell size to bring every input to; default: the finest input's",
        unit="m",
        low=1e-4,
        flag="--fused-resolution",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.free_percent >= self.occupied_percent:
            raise ConfigError(
                f"free_percent ({self.free_percent:g}) must be below "
                f"occupied_percent ({self.occupied_percent:g}); change one of them"
            )


@dataclass(frozen=True)
class AlignConfig(Checked):
    """The search for the rigid motion between two grids, and when to believe it."""

    window_yaw_rad: float = option(
        math.pi, "search yaw within +- this of the start", low=0.0, high=math.pi
    )
    window_m: float | None = option(
        None, "search shifts within this of the start; default: everywhere", low=0.0
    )
    step: int | None = option(
        None,
        "run the fixed-step search of [F16] with this first step instead; never onto a true map",
        unit="cells",
        low=1,
    )
    shared_frame: bool = option(
        False,
        "the maps share their start frame: of equally good answers prefer one near the identity",
    )
    coarse_cells: int = option(
        60, "cells on the longest side of the coarsest grid", low=16, high=512, level="expert"
    )


@dataclass(frozen=True)
class VoteConfig(Checked):
    """How aligned grids decide a cell."""

    mode: FusionMode = option(
        "consensus",
        "consensus: maps that agree decide, walls are voted for with a tolerance; majority of each "
        "cell, as in [F16]; or drawn (run alone) from all scans at the fused path",
    )
    unknown: Literal["auto", "value", "abstain"] = option(
        "auto", "majority: unknown as a value, as an abstention, or auto: a value with three voters"
    )
    extent: Literal["reference", "union"] = option(
        "union",
        "fused cells: the union of all maps that fit, or those of the reference alone; drawn is "
        "always a union",
    )


@dataclass(frozen=True)
class FusionConfig(Checked):
    """Normalise, align, agree on a group, vote."""

    normalize: NormalizeConfig = NormalizeConfig()
    align: AlignConfig = AlignConfig()
    vote: VoteConfig = VoteConfig()
    reference: str | None = option(
        None,
        "reference map: a name, an index from 0, or smallest (the smallest known box); default: "
        "the first that fits, live the smallest",
    )
    require_all: bool = option(False, "fail when any input is rejected")
    keep_duplicates: bool = option(
        False, "saved maps of equal cells, resolution and origin each have a vote, as in [F16]"
    )


@dataclass(frozen=True)
class LiveConfig(Checked):
    """Fusing maps that arrive again and again."""

    minimum_inputs: int = option(
        2,
        "inputs that must agree before anything is fused; 1 takes a single input as it is",
        low=1,
        high=32,
    )
    stale_after_s: float = option(
        30.0, "an input does not vote if its last map is older than another's by more", low=0.1
    )
    extent: Literal["reference", "union"] = option(
        "union", "fused cells: those of the reference, or of all inputs that ever voted"
    )
    search_share: float = option(
        0.7,
        "an input is searched again when it explains less than this share of the common walls that "
        "it explained when it was searched",
    )
    search_pause_s: float = option(2.0, "least time between full searches of one input", low=0.0)
    jump_m: float = option(
        0.5,
        "a transform that moves an input's centre this far must be found twice in a row",
        low=0.0,
    )
    confirm_s: float = option(
        3.0,
        "a map that jumped and has not changed since is searched again after this time, or after "
        "its second message, in another way; it is accepted if that finds the same",
        low=0.0,
        level="expert",
    )


@dataclass(frozen=True)
class EvaluateConfig(Checked):
    """Measures of a map against the truth."""

    tolerance_m: float = option(0.1, "a wall this near a true wall counts as found", low=0.0)
