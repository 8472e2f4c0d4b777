"""Claims about pictures on their own."""

from __future__ import annotations

from pathlib import Path

from slamfusion.io.images import read_image
from tests.io.pictures import bmp24


def test_a_bmp_may_be_stored_top_down(tmp_path: Path) -> None:
    usual = bmp24([[10, 20], [30, 40]])
    upside_down = usual[:22] + (-2).to_bytes(4, "little", signed=True) + usual[26:]
    (tmp_path / "a.bmp").write_bytes(upside_down)
    assert read_image(tmp_path / "a.bmp")[..., 0].tolist() == [[30, 40], [10, 20]]
