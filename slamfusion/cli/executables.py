"""The programs that ``ros2 run slamfusion ...`` and the launch files start: one for each node."""

from __future__ import annotations

import sys

from slamfusion.cli.main import main

__all__ = ["fusion_node", "gmapping_node", "graph_node", "player_node", "tinyslam_node"]


def tinyslam_node() -> None:
    """Run ``slamfusion node tinyslam``."""
    _run("tinyslam")


def gmapping_node() -> None:
    """Run ``slamfusion node gmapping``."""
    _run("gmapping")


def graph_node() -> None:
    """Run ``slamfusion node graph``."""
    _run("graph")


def fusion_node() -> None:
    """Run ``slamfusion node fusion``."""
    _run("fusion")


def player_node() -> None:
    """Run ``slamfusion node player``."""
    _run("player")


def _run(name: str) -> None:
    """Run a node with the arguments of this process; never returns."""
    given = sys.argv[1:]
    if given in (["-h"], ["--help"]):
        main(["node", "--help"])
    main(["node", name, *given])
