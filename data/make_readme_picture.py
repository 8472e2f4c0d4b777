"""Draw data/readme.png: the three sample maps, laid over each other, and the map they vote for.

Run as ``python data/make_readme_picture.py [FILE]``.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from slamfusion.compute import open_device
from slamfusion.config import FusionConfig, NormalizeConfig
from slamfusion.fusion import fuse_grids
from slamfusion.grid import trinary_cells
from slamfusion.io import load_map, write_atomic
from slamfusion.palette import NAMED, Rgb, colours_of
from slamfusion.report.canvas import Classes
from slamfusion.report.maps import overlay_rgb

DATA = Path(__file__).resolve().parent
NAMES = ("map_a", "map_b", "map_c")
HEIGHT, GAP, CAPTION = 220, 16, 34

Picture = npt.NDArray[np.uint8]


def panel(layers: Sequence[Classes], colours: Sequence[Rgb], caption: str) -> Picture:
    """Lay maps over each other, scaled to the row's height, and write a caption below."""
    picture = np.flipud(overlay_rgb(layers, colours))[..., ::-1]  # as OpenCV has colours
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
    colours = list(colours_of(NAMES).values())
    panels = [
        panel([trinary_cells(grid.cells, NormalizeConfig())], [colour], grid.name)
        for grid, colour in zip(grids, colours, strict=True)
    ]
    panels.append(panel(aligned, colours, "aligned"))
    fused = np.sign(result.fused.cells).astype(np.int8)
    panels.append(panel([fused], [NAMED["fused"]], "fused by vote"))
    gap = np.full((HEIGHT + CAPTION, GAP, 3), 255, dtype=np.uint8)
    row = np.hstack([piece for item in panels for piece in (item, gap)][:-1])
    encoded = cv2.imencode(".png", row, [cv2.IMWRITE_PNG_COMPRESSION, 9])[1]
    write_atomic(path, encoded.tobytes())
    print(f"wrote {path}")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:2]))
