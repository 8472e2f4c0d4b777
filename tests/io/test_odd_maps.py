"""Maps as other programs and machines leave them: read, and what is odd about them is said."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import PIL.Image
import pytest

from slamfusion.config import NormalizeConfig
from slamfusion.errors import MapFileError
from slamfusion.evaluation.wall_faces import face_cells
from slamfusion.grid import FREE, OCCUPIED, UNKNOWN, trinary_cells
from slamfusion.io.map_server import load_map

GREYS = np.repeat(np.array([[254, 205, 0]], dtype=np.uint8), 4, axis=0)
RIGHT = [FREE, UNKNOWN, OCCUPIED]


def written(folder: Path, pixels: np.ndarray, image: str = "map.png") -> Path:
    PIL.Image.fromarray(pixels).save(folder / "map.png")
    path = folder / "map.yaml"
    path.write_text(
        f"image: '{image}'\nresolution: 0.05\norigin: [0.0, 0.0, 0.0]\nnegate: 0\n"
        "occupied_thresh: 0.65\nfree_thresh: 0.196\n",
        encoding="utf-8",
    )
    return path


def with_alpha(colours: int) -> np.ndarray:
    """The greys as a paint program saves them: ``colours`` channels, and opaque."""
    return np.dstack([*[GREYS] * colours, np.full_like(GREYS, 255)])


@pytest.mark.parametrize("colours", [1, 3])
def test_unknown_that_alpha_makes_free_is_counted(tmp_path: Path, colours: int) -> None:
    path = written(tmp_path, with_alpha(colours))
    said: list[str] = []
    assert load_map(path, warn=said.append).cells[0].tolist() == [FREE, FREE, OCCUPIED]
    assert len(said) == 1
    assert "4 cells of grey 205" in said[0]
    assert "--legacy-unknown" in said[0]
    mended = load_map(path, legacy_unknown=True, warn=said.append)
    assert mended.cells[0].tolist() == RIGHT
    assert len(said) == 1


def test_colours_without_alpha_need_no_word(tmp_path: Path) -> None:
    said: list[str] = []
    path = written(tmp_path, np.dstack([GREYS] * 3))
    assert load_map(path, warn=said.append).cells[0].tolist() == RIGHT
    assert said == []


@pytest.mark.parametrize("image", ["/home/a/maps/map.png", "C:\\maps\\map.png", "maps/map.png"])
def test_a_picture_of_another_machine_lies_beside_the_yaml(tmp_path: Path, image: str) -> None:
    said: list[str] = []
    path = written(tmp_path, GREYS, image)
    assert load_map(path, warn=said.append).cells[0].tolist() == RIGHT
    assert len(said) == 1
    assert "map.png next to the YAML" in said[0]


@pytest.mark.parametrize("image", ["/home/a/maps/other.png", "C:\\", "maps/"])
def test_a_picture_that_is_nowhere_is_named_as_the_yaml_does(tmp_path: Path, image: str) -> None:
    with pytest.raises(MapFileError, match="'image' names"):
        load_map(written(tmp_path, GREYS, image))


# A wall of two cells, drawn with a fringe of one grey cell on one side and of two on the other.
FRINGED = np.repeat(np.array([[254, 254, 120, 0, 0, 60, 200, 254, 254]], dtype=np.uint8), 4, axis=0)


@pytest.mark.parametrize("channels", ["grey", "colour", "alpha"])
def test_a_fringe_of_grey_is_settled_at_half_where_maps_are_measured(
    tmp_path: Path, channels: str
) -> None:
    opaque = np.full_like(FRINGED, 255)
    pixels = {
        "grey": FRINGED,
        "colour": np.dstack([FRINGED] * 3),
        "alpha": np.dstack([FRINGED] * 3 + [opaque]),
    }[channels]
    path = written(tmp_path, pixels)
    plain, settled = load_map(path).cells[0], load_map(path, settle_edges=True).cells[0]
    assert plain[2] == UNKNOWN
    assert settled.tolist() == [FREE] * 2 + [OCCUPIED] * 4 + [FREE] * 3
    said: list[str] = []
    grid = load_map(path, settle_edges=True, warn=said.append)
    assert [text for text in said if "8 grey cells" in text]
    marked = face_cells(trinary_cells(grid.cells, NormalizeConfig()))
    assert np.flatnonzero(marked[0]).tolist() == [2, 5]


def test_probabilities_beside_walls_are_settled_too(tmp_path: Path) -> None:
    path = written(tmp_path, FRINGED)
    path.write_text(path.read_text(encoding="utf-8") + "mode: scale\n", encoding="utf-8")
    classes = trinary_cells(load_map(path, settle_edges=True).cells, NormalizeConfig())[0]
    assert classes.tolist() == [0, 0, 1, 1, 1, 1, 0, 0, 0]


@pytest.mark.parametrize(
    "row",
    [
        [254, 205, 0, 0, 205, 205, 254],  # what map savers write for unknown
        [254, 120, 120, 120, 0, 0, 0],  # too wide for a fringe
        [254, 254, 120, 254, 254, 0, 0],  # beside no wall
    ],
)
def test_other_grey_cells_stay_as_they_are(tmp_path: Path, row: list[int]) -> None:
    path = written(tmp_path, np.repeat(np.array([row], dtype=np.uint8), 4, axis=0))
    assert np.array_equal(load_map(path, settle_edges=True).cells, load_map(path).cells)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("a.posegraph", r"slam_toolbox.*map_saver_cli"),
        ("a.pbstream", r"Cartographer.*cartographer_pbstream_to_ros_map"),
        ("map.JSON", r"vacuum.*PNG.*--resolution"),
        ("plan.dwg", r"drawing.*PNG.*--resolution"),
        ("a.mcap", r"a log.*slamfusion run"),
    ],
)
def test_what_is_no_map_is_named_with_how_to_get_one(tmp_path: Path, name: str, words: str) -> None:
    (tmp_path / name).write_bytes(b"{}")
    with pytest.raises(MapFileError, match=words):
        load_map(tmp_path / name)
