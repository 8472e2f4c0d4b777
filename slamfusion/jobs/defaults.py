"""Defaults of a job where they are not those of all."""

from __future__ import annotations

from dataclasses import replace

from slamfusion.config import SMALLEST, FusionConfig, RunConfig, VoteConfig, VoteMode

# How the maps of a drive vote where no map can be drawn of it; see docs/concepts/voting.md.
RUN_VOTE: VoteMode = "consensus"
# Of ``run_log``. The map that all scans draw at the fused path is nearer to the truth than any vote
# on maps, and than the best producer's own drawn alike; see docs/concepts/paths.md.
RUN_DEFAULTS = replace(
    RunConfig(), fusion=replace(FusionConfig(), vote=replace(VoteConfig(), mode="drawn"))
)
# How [F16] fuses: a majority in which unknown is a value, in the frame and box of the smallest map.
LIKE_PAPER = RunConfig(
    fusion=FusionConfig(
        vote=VoteConfig(mode="majority", unknown="value", extent="reference"), reference=SMALLEST
    )
)
