"""Defaults of a job where they are not those of all."""

from __future__ import annotations

from dataclasses import replace

from slamfusion.config import FusionConfig, RunConfig, VoteConfig, VoteMode

__all__ = ["RUN_DEFAULTS", "RUN_VOTE"]

# How the maps of a drive vote. On recorded and simulated drives the consensus is nearest to the
# truth and doubles no walls; see docs/concepts/voting.md.
RUN_VOTE: VoteMode = "consensus"
# Of ``run_log``.
RUN_DEFAULTS = replace(
    RunConfig(), fusion=replace(FusionConfig(), vote=replace(VoteConfig(), mode=RUN_VOTE))
)
