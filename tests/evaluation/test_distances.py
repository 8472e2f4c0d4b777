"""Measured distances against a drawn corridor, and every way its file can be wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from slamfusion.config import NormalizeConfig
from slamfusion.errors import MapFileError
from slamfusion.evaluation.distances import MeasuredDistance, compare_distances, load_distances
from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from slamfusion.json_values import plain


@pytest.fixture
def corridor() -> OccupancyGrid:
    """Two walls along x, 20 cells of 0.1 m apart, between y = -1 and y = 1."""
    cells = np.zeros((23, 40), dtype=np.int8)
    cells[[1, 21]] = 100
    return OccupancyGrid(cells, 0.1, Pose2(0.0, -1.15), "corridor")


def test_the_distance_is_between_the_nearest_walls(corridor: OccupancyGrid) -> None:
    rows = [MeasuredDistance("width", (2.05, -0.9), (2.05, 1.2), 1.9)]
    result = compare_distances(corridor, rows, NormalizeConfig())
    row = result.rows[0]
    assert row.map_m == pytest.approx(2.0)
    assert row.error_m == pytest.approx(0.1)
    assert row.error_percent == pytest.approx(100 * 0.1 / 1.9)
    assert result.mean_absolute_error_m == pytest.approx(0.1)


def test_a_row_without_a_wall_says_so_and_does_not_count(corridor: OccupancyGrid) -> None:
    rows = [
        MeasuredDistance("width", (2.05, -1.0), (2.05, 1.0), 2.2),
        MeasuredDistance("nowhere", (2.05, -1.0), (2.05, 0.0), 1.0),
    ]
    result = compare_distances(corridor, rows, NormalizeConfig())
    assert result.rows[1].map_m is None
    assert result.rows[1].reason == "no wall within 0.5 m of point 2"
    assert result.mean_absolute_error_m == pytest.approx(0.2)
    values = plain(result)
    assert (values["rows_used"], values["rows_total"]) == (1, 2)


def test_csv_and_yaml_hold_the_same_rows(tmp_path: Path, corridor: OccupancyGrid) -> None:
    csv_file = tmp_path / "d.csv"
    csv_file.write_text(
        "name, x1, y1, x2, y2, distance_m\nhall, 2, -1, 2, 1, 2.0\n\n,0.05,-1,3.05,-1,3\n"
    )
    yaml_file = tmp_path / "d.yaml"
    yaml_file.write_text(
        "distances:\n"
        "- {name: hall, x1: 2, y1: -1, x2: 2, y2: 1, distance_m: 2.0}\n"
        "- {name: row 4, x1: 0.05, y1: -1, x2: 3.05, y2: -1, distance_m: 3}\n"
    )
    assert load_distances(csv_file) == load_distances(yaml_file)
    result = compare_distances(corridor, load_distances(csv_file), NormalizeConfig())
    assert [row.name for row in result.rows] == ["hall", "row 4"]
    assert result.mean_absolute_error_m == pytest.approx(0.0)


HEADER = "name,x1,y1,x2,y2,distance_m\n"


def test_a_bare_yaml_list_needs_no_name(tmp_path: Path) -> None:
    file = tmp_path / "d.yml"
    file.write_text("- {x1: 2, y1: -1, x2: 2, y2: 1, distance_m: 2.0}\n")
    assert load_distances(file)[0].name == "entry 1"


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("d.csv", "", "no distance in the file"),
        ("d.csv", HEADER, "no distance in the file"),
        ("d.csv", "name,x1,y1\n", "the header lacks x2, y2, distance_m"),
        ("d.csv", HEADER + "a,1,2,3\n", "row 2: wanted 6 values, found 4"),
        ("d.csv", HEADER + "a,1,2,3,4,long\n", "row 2: distance_m must be a number"),
        ("d.csv", HEADER + "a,1,nan,3,4,5\n", "row 2: y1 must be a number"),
        ("d.csv", HEADER + "a,1,2,3,4,0\n", "row 2: distance_m must be above 0"),
        ("d.csv", HEADER + 'a,1,2,3,4,"5\n', "not a CSV file"),
        ("d.yaml", "distances: 3\n", "wanted a list of distances, found int"),
        ("d.yaml", "- 3\n", "entry 1: wanted a mapping"),
        ("d.yaml", "- {x1: true}\n", "entry 1: x1 must be a number of metres, found True"),
        ("d.yaml", "- {y1: 0}\n", "entry 1: x1 must be a number of metres, found nothing"),
        ("d.yaml", "[\n", "not YAML"),
        ("d.yaml", "other: []\n", "no distance in the file"),
        ("d.csv", "\xff\xfe\x00", "not UTF-8"),
        ("d.txt", "", "come as .csv, .yaml or .yml"),
    ],
)
def test_a_bad_file_is_named_in_one_line(
    tmp_path: Path, name: str, text: str, message: str
) -> None:
    file = tmp_path / name
    file.write_bytes(text.encode("latin-1"))
    with pytest.raises(MapFileError) as caught:
        load_distances(file)
    assert message in str(caught.value)
    assert str(file) in str(caught.value)
    assert "\n" not in str(caught.value)
