"""Claims about pictures on their own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from slamfusion.io.images import encode_image, read_image
from tests.io.pictures import bmp24


@pytest.mark.parametrize("image_format", ["pgm", "png", "bmp"])
def test_a_grey_picture_survives(tmp_path: Path, image_format: str) -> None:
    array = np.arange(12, dtype=np.uint8).reshape(3, 4)
    path = tmp_path / f"a.{image_format}"
    path.write_bytes(encode_image(array, image_format))
    assert read_image(path).tolist() == array.tolist()


def test_a_bmp_may_be_stored_top_down(tmp_path: Path) -> None:
    usual = bmp24([[10, 20], [30, 40]])
    upside_down = usual[:22] + (-2).to_bytes(4, "little", signed=True) + usual[26:]
    (tmp_path / "a.bmp").write_bytes(upside_down)
    assert read_image(tmp_path / "a.bmp")[..., 0].tolist() == [[30, 40], [10, 20]]
