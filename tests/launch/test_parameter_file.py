"""The parameter file and the tables are those of the code, without ROS."""

from __future__ import annotations

import pytest
import yaml

from slamfusion.cli.ros_tables import NODES, TABLES, parameter_file, with_tables
from tests.cli.command import ROOT

PARAMETER_FILE = ROOT / "launch_scripts" / "slamfusion.yaml"


def test_the_parameter_file_is_up_to_date():
    wanted = parameter_file()
    assert PARAMETER_FILE.read_text() == wanted, "run: python -m slamfusion.cli.ros_tables"
    nodes = {key.rpartition("/")[2]: value for key, value in yaml.safe_load(wanted).items()}
    assert tuple(nodes) == NODES
    assert all(value["ros__parameters"] for value in nodes.values())


@pytest.mark.parametrize("name", TABLES)
def test_a_table_that_is_behind_is_brought_up_to_date(name: str):
    begin = f"<!-- {name}: written by `python -m slamfusion.cli.ros_tables` -->"
    end = f"<!-- end of {name} -->"
    done = with_tables(f"before\n{begin}\nof yesterday\n{end}\nafter")
    assert "of yesterday" not in done
    assert done.startswith("before\n")
    assert done.endswith("\nafter")
    assert with_tables(done) == done
    assert len(TABLES[name]().splitlines()) > 4
