"""The parameter file is that of the code, without ROS."""

from __future__ import annotations

import yaml

from docs.generate.marks import COMMAND
from docs.generate.ros import parameter_file
from slamfusion.ros.interface import NODES
from tests.cli.command import ROOT

PARAMETER_FILE = ROOT / "launch_scripts" / "slamfusion.yaml"


def test_the_parameter_file_is_up_to_date():
    wanted = parameter_file()
    assert PARAMETER_FILE.read_text() == wanted, f"run: {COMMAND}"
    nodes = {key.rpartition("/")[2]: value for key, value in yaml.safe_load(wanted).items()}
    assert tuple(nodes) == NODES
    assert all(value["ros__parameters"] for value in nodes.values())
