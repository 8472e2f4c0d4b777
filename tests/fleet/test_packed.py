"""Values that travel, and what is kept of them."""

from __future__ import annotations

import numpy as np

from slamfusion.fleet.packed import Kept, pack


def test_a_value_travels_whole_and_small() -> None:
    value = {"cells": np.zeros((100, 100), dtype=np.int8), "name": "a"}
    packed = pack(value)
    assert len(packed.data) < 500
    back = packed.unpack()
    assert np.array_equal(back["cells"], value["cells"])
    assert back["name"] == "a"
    assert pack(back).key == packed.key
    assert pack({**value, "name": "b"}).key != packed.key


def test_what_was_asked_for_last_is_kept() -> None:
    made: list[str] = []
    kept: Kept[str] = Kept(len, most=5)

    def get(value: str) -> None:
        assert kept.get(value, lambda: made.append(value) or value) == value
        kept.shrink()

    for value in ("aa", "bb", "aa", "cc", "aa", "bb"):
        get(value)
    assert made == ["aa", "bb", "cc", "bb"]
    assert len(kept) == 2


def test_so_many_are_kept_however_large_they_are() -> None:
    kept: Kept[str] = Kept(len, most=1, least=2)
    for value in ("aaa", "bbb", "ccc"):
        kept.get(value, value.lower)
    kept.shrink()
    assert len(kept) == 2
    assert kept.get("bbb", str) == "bbb"
