"""What a job says last: how the map is used, and what to do next."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path


def print_next_steps(map_file: Path, steps: Sequence[str]) -> None:
    """Print how nav2 and RViz load a map, and what can be done now.

    Args:
        map_file: its YAML.
        steps: each what for and a command or file, e.g. ``look: out/report/report.html``.
    """
    where = shlex.quote(f"yaml_filename:={map_file.absolute()}")
    server = f"ros2 run nav2_map_server map_server --ros-args -p {where}"
    print(f"nav2, RViz: {server}")
    print("            (then: ros2 run nav2_util lifecycle_bringup map_server)")
    for number, step in enumerate(steps):
        print(f"{'' if number else 'next:':<12}{step}")
