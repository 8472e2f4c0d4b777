"""Draw data/readme.png: the three sample maps, laid over each other, and the map they vote for.

Run as ``python data/make_readme_picture.py [FILE]``.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from slamfusion.compute import open_device
from slamfusion.config import FusionConfig
from slamfusion.fusion import fuse_grids
from slamfusion.grid import FREE, OCCUPIED
from slamfusion.io import load_map, write_atomic

DATA = Path(__file__).resolve().parent
NAMES = ("map_a", "map_b", "map_c")
# Blue, green, red in OpenCV's order; legible to most colour-blind eyes, and dark where all agree.
COLOURS = ((178, 114, 0), (115, 158, 0), (0, 94, 213))
HEIGHT, GAP, CAPTION = 220, 16, 34

Picture = npt.NDArray[np.uint8]


def paint(cells: npt.NDArray[np.int8], wall: tuple[int, int, int] = (30, 30, 30)) -> Picture:
    """Paint cells: walls in a colour, free white, unknown light grey; row 0 at the bottom."""
    picture = np.full((*cells.shape, 3), 232, dtype=np.uint8)
    picture[cells == FREE] = 255
    picture[cells == OCCUPIED] = wall
    return np.flipud(picture)


def overlay(layers: list[npt.NDArray[np.int8]]) -> Picture:
    """Lay the walls of aligned maps over each other; each takes light away in its own colour."""
    light = np.full((*layers[0].shape, 3), 1.0)
    for layer, colour in zip(layers, COLOURS, strict=True):
        light[layer == 1] *= np.array(colour) / 255.0
    light[np.all([layer == -1 for layer in layers], axis=0)] = 232 / 255
    return np.flipud((255 * light).astype(np.uint8))


def panel(picture: Picture, caption: str) -> Picture:
    """Scale a picture to the row's height and write its caption below."""
    scale = HEIGHT / picture.shape[0]
    width = round(picture.shape[1] * scale)
    scaled = cv2.resize(picture, (width, HEIGHT), interpolation=cv2.INTER_AREA)
    framed = np.full((HEIGHT + CAPTION, width, 3), 255, dtype=np.uint8)
    framed[:HEIGHT] = scaled
    cv2.putText(
        framed,
        caption,
        (2, HEIGHT + 24),
        cv2.FONT_HERSHEY_SIMPLEX,
        0.6,
        (60, 60, 60),
        1,
        cv2.LINE_AA,
    )
    return framed


def main(path: Path = DATA / "readme.png") -> None:
    """Fuse the sample and write the picture."""
    grids = [load_map(DATA / "sample" / f"{name}.yaml") for name in NAMES]
    result = fuse_grids(grids, FusionConfig(), open_device())
    aligned = [record.aligned for record in result.inputs if record.aligned is not None]
    panels = [
        panel(paint(grid.cells, colour), grid.name)
        for grid, colour in zip(grids, COLOURS, strict=True)
    ]
    panels.append(panel(overlay(aligned), "aligned"))
    panels.append(panel(paint(result.fused.cells), "fused by vote"))
    gap = np.full((HEIGHT + CAPTION, GAP, 3), 255, dtype=np.uint8)
    row = np.hstack([piece for item in panels for piece in (item, gap)][:-1])
    encoded = cv2.imencode(".png", row, [cv2.IMWRITE_PNG_COMPRESSION, 9])[1]
    write_atomic(path, encoded.tobytes())
    print(f"wrote {path}")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:2]))
