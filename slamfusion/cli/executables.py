"""The programs that ``ros2 run slamfusion ...`` and the launch files start: one for each node."""

from __future__ import annotations

import sys
from pathlib import Path

from slamfusion.cli.main import main

# A program is called by its node's name and this.
SUFFIX = "_node"


def node() -> None:
    """Run the node that this program is named after, with its arguments; never returns."""
    name = Path(sys.argv[0]).name.removesuffix(SUFFIX)
    given = sys.argv[1:]
    if given in (["-h"], ["--help"]):
        main(["node", "--help"])
    main(["node", name, *given])
