"""Thresholds of the graph SLAM: when tracking is lost, what closes a loop, how a robot is found.

All are expert fields: the defaults hold for a robot indoors that drives up to about one metre in a
second and is seen by a laser of some hundred beams.
"""

from __future__ import annotations

from dataclasses import dataclass

from slamfusion.config.core import Checked, option
from slamfusion.errors import ConfigError


@dataclass(frozen=True)
class GraphTrackingConfig(Checked):
    """From how scans fit the local map: is the robot tracked, is tracking lost, is it kidnapped?

    A match is worth its score where the local map has seen something, in the running mean score.
    One bad scan or two are a door or a crowd. Right after a reset of the odometry one is enough:
    the robot was perhaps switched off and moved.
    """

    bad_share: float = option(
        0.6,
        "a match worth less than this share of the usual one is bad: the scan is searched far "
        "around, and a new submap begins where several are",
        low=0.0,
        high=1.0,
        level="expert",
    )
    reset_share: float = option(
        0.8,
        "the same right after a reset of the odometry, where one such scan is a kidnapped robot",
        low=0.0,
        high=1.0,
        level="expert",
    )
    lost_scans: int = option(
        4,
        "scans in a row, no place of which is sure, after which the robot is kidnapped",
        low=1,
        high=10_000,
        level="expert",
    )
    failed_bad: int = option(
        3,
        "bad scans among the last ones after which tracking has failed",
        low=1,
        high=10_000,
        level="expert",
    )
    failed_scans: int = option(
        10, "how many of the last scans count", unit="scans", low=1, high=10_000, level="expert"
    )
    most_unseen: float = option(
        0.8,
        "a scan with this share of its hits where the local map has seen nothing is not bad",
        low=0.0,
        high=1.0,
        level="expert",
    )
    search_m: float = option(
        1.5,
        "a robot that tracking may have lost is searched this far around where it is expected",
        unit="m",
        low=0.05,
        high=20.0,
        level="expert",
    )
    search_rad: float = option(
        0.8, "the same for its heading", unit="rad", low=0.01, high=3.2, level="expert"
    )
    expected_m: float = option(
        0.4,
        "a bad match that is best this near to where odometry has the robot is there: the world "
        "has changed, not the place",
        unit="m",
        low=0.0,
        high=20.0,
        level="expert",
    )
    expected_rad: float = option(
        0.12, "the same for its heading", unit="rad", low=0.0, high=3.2, level="expert"
    )

    def __post_init__(self) -> None:
        """Refuse a failure that needs more bad scans than are looked at."""
        super().__post_init__()
        if self.failed_bad > self.failed_scans:
            message = (
                f"failed_bad ({self.failed_bad}) must not be above failed_scans "
                f"({self.failed_scans}): tracking would never fail"
            )
            raise ConfigError(message)


@dataclass(frozen=True)
class GraphClosureConfig(Checked):
    """Where a loop closure is looked for, what speaks against one, and when it is believed.

    Old submaps fit a little worse than the growing one, and the robot may be at their border. Where
    it may be anywhere more is asked for: more places fit, the fewer hits count. The least and the
    further drift are those of matched scans, with room to spare; how often and how many submaps are
    searched is what a node may cost.
    """

    least_drift_m: float = option(
        0.3,
        "drift since a submap that the robot has just left",
        unit="m",
        low=0.0,
        high=100.0,
        level="expert",
    )
    drift_share: float = option(
        0.02,
        "further drift for each metre since a submap was last tied to the robot",
        low=0.0,
        high=1.0,
        level="expert",
    )
    local_drift_m: float = option(
        0.8,
        "drift up to which the matcher's own search finds a closure; beyond, a whole window is "
        "searched",
        unit="m",
        low=0.0,
        high=100.0,
        level="expert",
    )
    retry_nodes: int = option(
        2, "nodes between two searches of one submap", low=1, high=10_000, level="expert"
    )
    tries_per_node: int = option(
        2, "submaps searched at a node, the nearest ones", low=1, high=1000, level="expert"
    )
    mean_share: float = option(
        0.75,
        "response that a closure needs, as a share of the running mean score",
        low=0.0,
        high=1.0,
        level="expert",
    )
    mean_share_anywhere: float = option(
        0.85,
        "the same where the robot may be anywhere, and where tracking may have lost it",
        low=0.0,
        high=1.0,
        level="expert",
    )
    most_unseen: float = option(
        0.6,
        "share of a scan's hits that may lie where the older submap has seen nothing",
        low=0.0,
        high=0.95,
        level="expert",
    )
    most_unseen_anywhere: float = option(
        0.3, "the same where the robot may be anywhere", low=0.0, high=0.95, level="expert"
    )
    rival_share: float = option(
        0.93,
        "another place with this share of a closure's response makes it ambiguous",
        low=0.1,
        high=1.0,
        level="expert",
    )
    small_step_m: float = option(
        0.4,
        "a closure that moves the robot by no more is believed alone",
        unit="m",
        low=0.0,
        high=100.0,
        level="expert",
    )
    small_step_rad: float = option(
        0.1, "the same for its heading", unit="rad", low=0.0, high=3.2, level="expert"
    )
    agreement_m: float = option(
        0.3,
        "closures that put the robot nearer to each other than this say the same",
        unit="m",
        low=0.01,
        high=100.0,
        level="expert",
    )
    agreement_rad: float = option(
        0.05, "the same for its heading", unit="rad", low=0.001, high=3.2, level="expert"
    )
    agreeing_nodes: int = option(
        2,
        "nodes whose closures must say the same before one that moves the robot far is believed",
        low=2,
        high=1000,
        level="expert",
    )
    wait_nodes: int = option(
        12, "nodes for which a closure waits for others", low=1, high=100_000, level="expert"
    )


@dataclass(frozen=True)
class GraphRelocalizationConfig(Checked):
    """The search for a kidnapped robot in the map of before: near odometry, then anywhere.

    A hypothesis must outlive rooms that are copies of each other; a door or a person may hide a
    place once or twice. One of few hits is no rival: where it has the robot there is nothing to
    test it on.
    """

    kidnapped_drift_m: float = option(
        1.2,
        "a kidnapped robot is searched first this far around where odometry has it",
        unit="m",
        low=0.0,
        high=100.0,
        level="expert",
    )
    local_searches: int = option(
        12,
        "searches there in vain, one for each node, after which it may be anywhere",
        low=0,
        high=100_000,
        level="expert",
    )
    odometry_nodes: int = option(
        3,
        "nodes whose closures there must say the same before the robot is relocalized by them",
        low=2,
        high=1000,
        level="expert",
    )
    odometry_m: float = option(
        0.8,
        "way between the first and the last of these",
        unit="m",
        low=0.0,
        high=1000.0,
        level="expert",
    )
    inside_m: float = option(
        0.5,
        "a hypothesis this near to where the robot was in an old submap is tested on it",
        unit="m",
        low=0.01,
        high=100.0,
        level="expert",
    )
    hypothesis_drift_m: float = option(
        0.6,
        "error of where a hypothesis has the robot",
        unit="m",
        low=0.0,
        high=100.0,
        level="expert",
    )
    borne_out_nodes: int = option(
        14,
        "nodes that must fit before a hypothesis is believed",
        low=1,
        high=100_000,
        level="expert",
    )
    borne_out_m: float = option(
        4.0,
        "way between the first and the last of them: longer than rooms go on alike",
        unit="m",
        low=0.0,
        high=10_000.0,
        level="expert",
    )
    misses: int = option(
        3,
        "misses in a row after which a hypothesis is given up",
        low=1,
        high=10_000,
        level="expert",
    )
    rival_hits: int = option(
        2,
        "a hypothesis of fewer hits is no rival of the best one",
        low=1,
        high=10_000,
        level="expert",
    )
    rival_share: float = option(
        0.4,
        "neither is one with a smaller share of the best one's hits",
        low=0.0,
        high=1.0,
        level="expert",
    )
