"""Claims about pictures on their own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from slamfusion.errors import MapFileError
from slamfusion.io import save_image
from slamfusion.io.images import encode_image, read_image
from tests.io.pictures import bmp24


def test_a_grey_picture_survives(tmp_path: Path) -> None:
    array = np.arange(12, dtype=np.uint8).reshape(3, 4)
    save_image(tmp_path / "a.png", array)
    assert read_image(tmp_path / "a.png").pixels.tolist() == array.tolist()


def test_colours_are_red_green_blue(tmp_path: Path) -> None:
    array = np.zeros((1, 3, 3), dtype=np.uint8)
    array[0, 0, 0] = array[0, 1, 1] = array[0, 2, 2] = 255
    save_image(tmp_path / "deep" / "a.png", array)
    back = cv2.imread(str(tmp_path / "deep" / "a.png"), cv2.IMREAD_COLOR)
    assert back is not None
    assert back[..., ::-1].tolist() == array.tolist()


@pytest.mark.parametrize(
    "array",
    [
        np.zeros((2, 2), dtype=np.float32),
        np.zeros((2, 2, 2, 2), dtype=np.uint8),
        np.zeros((0, 4), dtype=np.uint8),
        np.zeros((2, 2, 2), dtype=np.uint8),
    ],
)
def test_what_is_no_picture_is_refused(tmp_path: Path, array: npt.NDArray[Any]) -> None:
    with pytest.raises(MapFileError, match=r"a\.png: .*found|a\.png: cannot encode"):
        save_image(tmp_path / "a.png", array)
    assert list(tmp_path.iterdir()) == []


def test_an_unknown_format_cannot_be_encoded() -> None:
    with pytest.raises(MapFileError, match="out: cannot encode"):
        encode_image(np.zeros((1, 1), np.uint8), "nonsense", "out")


def test_a_bmp_may_be_stored_top_down(tmp_path: Path) -> None:
    usual = bmp24([[10, 20], [30, 40]])
    upside_down = usual[:22] + (-2).to_bytes(4, "little", signed=True) + usual[26:]
    (tmp_path / "a.bmp").write_bytes(upside_down)
    assert read_image(tmp_path / "a.bmp").pixels[..., 0].tolist() == [[30, 40], [10, 20]]


def test_a_bmp_of_os2_is_refused_by_name(tmp_path: Path) -> None:
    usual = bmp24([[10, 20], [30, 40]])
    short = b"BM" + (26 + 16).to_bytes(4, "little") + bytes(4) + (26).to_bytes(4, "little")
    short += (12).to_bytes(4, "little") + bytes([2, 0, 2, 0, 1, 0, 24, 0]) + usual[54:]
    (tmp_path / "b.bmp").write_bytes(short)
    with pytest.raises(MapFileError, match=r"b\.bmp: .*OS/2; convert it to PNG"):
        read_image(tmp_path / "b.bmp")
