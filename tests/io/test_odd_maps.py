"""Maps as other programs and machines leave them: read, and what is odd about them is said."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import PIL.Image
import pytest

from slamfusion.errors import MapFileError
from slamfusion.grid import FREE, OCCUPIED, UNKNOWN
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
    assert "map.png beside the YAML" in said[0]


@pytest.mark.parametrize("image", ["/home/a/maps/other.png", "C:\\", "maps/"])
def test_a_picture_that_is_nowhere_is_named_as_the_yaml_does(tmp_path: Path, image: str) -> None:
    with pytest.raises(MapFileError, match="'image' names"):
        load_map(written(tmp_path, GREYS, image))
