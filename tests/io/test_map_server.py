"""Claims about loading and saving maps in the map server's format."""

from __future__ import annotations

import gzip
import math
import os
import tempfile
from pathlib import Path

import cv2
import hypothesis.extra.numpy as arrays
import numpy as np
import numpy.typing as npt
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from slamfusion.config import NormalizeConfig
from slamfusion.errors import MapFileError, MemoryBudgetError, SlamFusionError
from slamfusion.geometry import Pose2
from slamfusion.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, face_cells, trinary_cells
from slamfusion.io import files, images, load_map, save_map
from tests.io.pictures import bmp24, chunk, pgm, png, write_map
from tests.support.datasets import load_entry, map_entries
from tests.support.examples import examples

ROWS = [[254, 0, 205], [0, 254, 254]]  # top row first
CELLS = [[100, 0, 0], [0, 100, -1]]  # bottom row first
TINY = pgm(ROWS)


def values_of(path: Path) -> list[list[int]]:
    return load_map(path).cells.tolist()


def shade_of(value: int) -> float:
    """Occupancy of a grey as a map server reckons it."""
    return 1.0 - value / 255


def test_row_zero_of_the_picture_is_the_top_of_the_map(tmp_path: Path) -> None:
    grid = load_map(write_map(tmp_path, TINY))
    assert grid.cells.tolist() == CELLS
    assert grid.name == "map"
    # The lower-left corner of the lower-left pixel stands at the origin (1, 2).
    assert grid.cell_centres(np.array([0]), np.array([0])) == pytest.approx(
        np.array([[1.025, 2.025]])
    )
    # The only unknown pixel is the top right one: row 1, column 2.
    row, col = np.argwhere(grid.cells == -1)[0]
    assert grid.cell_centres(np.array([row]), np.array([col])) == pytest.approx(
        np.array([[1.125, 2.075]])
    )


def test_origin_yaw_turns_the_map_about_its_corner(tmp_path: Path) -> None:
    grid = load_map(write_map(tmp_path, TINY, origin="[1, 2, 1.5707963267948966]"))
    assert grid.origin == Pose2(1.0, 2.0, math.pi / 2)
    assert grid.cell_centres(np.array([0]), np.array([2])) == pytest.approx(
        np.array([[1.0 - 0.025, 2.0 + 0.125]])
    )


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("map.pgm", TINY),
        ("map.pgm", pgm(ROWS, plain=True)),
        ("map.pgm", pgm([[v * 257 for v in row] for row in ROWS], 65535)),
        ("map.pgm", pgm([[v * 257 for v in row] for row in ROWS], 65535, plain=True)),
        ("map.png", png([bytes(row) for row in ROWS], 3)),
        ("map.png", png([bytes(v for w in row for v in (w, w, w)) for row in ROWS], 3, colour=2)),
        ("map.bmp", bmp24(ROWS)),
        # Stored top down: rows in the other order, and a negative height.
        ("map.bmp", bmp24(ROWS[::-1])[:22] + b"\xfe\xff\xff\xff" + bmp24(ROWS[::-1])[26:]),
    ],
)
def test_every_format_gives_the_same_cells(
    tmp_path: Path, name: str, data: bytes, packed: bool
) -> None:
    path = write_map(tmp_path, data, name)
    if packed:
        (tmp_path / name).unlink()
        (tmp_path / f"{name}.gz").write_bytes(gzip.compress(data))
    assert values_of(path) == CELLS


@pytest.mark.parametrize("packed", [False, True])
def test_a_bare_picture_stands_at_the_map_origin(tmp_path: Path, packed: bool) -> None:
    path = tmp_path / ("room.pgm.gz" if packed else "room.pgm")
    path.write_bytes(gzip.compress(TINY) if packed else TINY)
    grid = load_map(path, resolution=0.1)
    assert grid.cells.tolist() == CELLS
    assert (grid.resolution, grid.origin, grid.name) == (0.1, Pose2(), "room")
    assert load_map(tmp_path / "room.pgm", resolution=0.1).name == "room"


def test_an_absolute_image_path_is_followed(tmp_path: Path) -> None:
    (tmp_path / "pictures").mkdir()
    (tmp_path / "pictures" / "x.pgm").write_bytes(TINY)
    path = write_map(tmp_path, TINY, image=str(tmp_path / "pictures" / "x.pgm"))
    (tmp_path / "map.pgm").unlink()
    assert values_of(path) == CELLS


@pytest.mark.parametrize("negate", ["1", "true", "True", "yes"])
def test_negate_turns_white_into_walls(tmp_path: Path, negate: str) -> None:
    picture = pgm([[255 - v for v in row] for row in ROWS])
    assert values_of(write_map(tmp_path, picture, negate=negate)) == CELLS


RAW = pgm([[0, 1, 99, 100, 101, 205, 255]])
PALETTE = chunk(b"PLTE", bytes([0, 0, 0, 205, 205, 205, 254, 254, 254]))
# Means of colours 85, 170 and 255: occupied (2/3 > 0.65), unknown, free.
RGB = bytes([0, 0, 255, 255, 255, 0, 255, 255, 255])
# Means with alpha 63.75, 0, 190.5 and 217.5: occupied, occupied, unknown, free.
RGBA = bytes([0, 0, 0, 255, 0, 0, 0, 0, 254, 254, 254, 0, 205, 205, 205, 255])
# Occupancies of the greys 51 and 204 are exactly these thresholds: both stay unknown.
STRICT = {"occupied_thresh": repr(shade_of(51)), "free_thresh": repr(shade_of(204))}
NO_RULES = {"negate": "", "occupied_thresh": "", "free_thresh": ""}


@pytest.mark.parametrize(
    ("data", "says", "cells"),
    [
        (TINY, NO_RULES, CELLS),
        (pgm([[50, 51, 52, 203, 204, 205]]), STRICT, [[100, -1, -1, -1, -1, 0]]),
        (pgm([[205]]), {}, [[-1]]),
        (pgm([[205]]), {"free_thresh": "0.25"}, [[0]]),
        (RAW, {"mode": "raw"}, [[0, 1, 99, 100, -1, -1, -1]]),
        (RAW, {"mode": "raw", "negate": "1"}, [[0, 1, 99, 100, -1, -1, -1]]),
        # Another maximum is scaled.
        (pgm([[0, 1, 2]], 2), {}, [[100, -1, 0]]),
        (pgm([[0, 500, 1000]], 1000), {}, [[100, -1, 0]]),
        (pgm([[0, 7, 15]], 15, plain=True), {}, [[100, -1, 0]]),
        # 0.65 of white lies between these neighbours, which share their upper byte.
        (pgm([[22937, 22938]], 65535), {}, [[100, -1]]),
        # Comments may stand anywhere in the header.
        (b"P5 # one\n#two 7 7\n3#three\n 2\r\n# four\n255\n" + bytes(ROWS[0] + ROWS[1]), {}, CELLS),
        (png([RGB], 3, colour=2), {}, [[100, -1, 0]]),
        (png([RGBA], 4, colour=6), {}, [[100, 100, -1, 0]]),
        # In the mode scale the transparent is unknown, also as the one grey of a PNG.
        (png([bytes([0, 0, 0, 255, 0, 0, 0, 254])], 2, 8, 6), {"mode": "scale"}, [[100, -1]]),
        (
            png([bytes([0] * 6 + [255] * 2 + [0] * 6 + [254] * 2)], 2, 16, 6),
            {"mode": "scale"},
            [[100, -1]],
        ),
        (
            png([bytes([0, 64, 255])], 3, extra=chunk(b"tRNS", b"\x00\x40")),
            {"mode": "scale"},
            [[100, -1, 0]],
        ),
        # Palettes and shallow greys are expanded.
        (png([bytes([0, 1, 2])], 3, colour=3, extra=PALETTE), {}, [[100, -1, 0]]),
        (png([b"\x1b"], 4, 2), {}, [[100, 100, -1, 0]]),
        (png([b"\x40"], 2, 1), {}, [[100, 0]]),
    ],
)
def test_greys_colours_and_rules_give_the_cells_of_a_map_server(
    tmp_path: Path, data: bytes, says: dict[str, str], cells: list[list[int]]
) -> None:
    name = "map.pgm" if data.startswith(b"P") else "map.png"
    assert values_of(write_map(tmp_path, data, name, **says)) == cells


GREY_ROWS = [[254, 205, 0], [205, 205, 254]]


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("map.pgm", pgm(GREY_ROWS)),
        ("map.pgm", pgm([[v * 257 for v in row] for row in GREY_ROWS], 65535)),
        ("map.png", png([bytes(v for w in r for v in (w, w, w)) for r in GREY_ROWS], 3, colour=2)),
        (
            "map.png",
            png([bytes(v for w in r for v in (w, w, w, 255)) for r in GREY_ROWS], 3, colour=6),
        ),
        ("map.png", png([bytes(v for w in r for v in (w, 255)) for r in GREY_ROWS], 3, colour=4)),
    ],
)
def test_unknown_that_reads_as_free_is_counted_and_can_be_mended(
    tmp_path: Path, name: str, data: bytes
) -> None:
    path = write_map(tmp_path, data, name, free_thresh="0.25")
    told: list[str] = []
    assert load_map(path, warn=told.append).cells.tolist() == [[0, 0, 0], [0, 0, 100]]
    (sentence,) = told
    assert sentence.startswith(f"{path}: 3 cells of grey 205")
    assert "--legacy-unknown" in sentence
    mended = load_map(path, warn=told.append, legacy_unknown=True)
    assert mended.cells.tolist() == [[-1, -1, 0], [0, -1, 100]]
    assert len(told) == 1


def test_a_saved_map_that_is_negated_by_mistake_is_named(tmp_path: Path) -> None:
    path = write_map(tmp_path, pgm(GREY_ROWS), negate="1")
    told: list[str] = []
    for legacy_unknown in (False, True):
        grid = load_map(path, warn=told.append, legacy_unknown=legacy_unknown)
        assert grid.cells.tolist() == [[100, 100, 100], [100, 100, 0]]
    assert told[0].startswith(f"{path}: 3 cells of grey 205")
    assert told[0].endswith("because 'negate' is set; write negate: 0 if the walls are black")
    assert told == told[:1] * 2


def test_scale_is_linear_between_the_thresholds(tmp_path: Path) -> None:
    greys = list(range(256))
    path = write_map(tmp_path, pgm([greys]), mode="scale", free_thresh="0.2", occupied_thresh="0.7")
    expected = [min(max(round((shade_of(v) - 0.2) / 0.5 * 100), 0), 100) for v in greys]
    assert values_of(path) == [expected]


@pytest.mark.parametrize(
    ("text", "number"), [("1e-3", 0.001), ("5.0e-2", 0.05), ("0.050000", 0.05), ("'0.05'", 0.05)]
)
def test_numbers_are_read_as_they_are_written(tmp_path: Path, text: str, number: float) -> None:
    assert load_map(write_map(tmp_path, TINY, resolution=text)).resolution == number


def assert_refused(path: Path, *words: str, resolution: float | None = None) -> str:
    before = sorted(path.parent.rglob("*")) if path.parent.exists() else []
    with pytest.raises(SlamFusionError) as caught:
        load_map(path, resolution=resolution)
    message = str(caught.value)
    assert "\n" not in message
    assert "; " in message, f"no mend in {message!r}"
    for word in (path.stem.split(".")[0], *words):
        assert word in message, f"{word!r} not in {message!r}"
    if path.parent.exists():
        assert sorted(path.parent.rglob("*")) == before
    return message


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"image": ""}, ("'image'", "missing", "add it")),
        ({"resolution": ""}, ("'resolution'", "missing")),
        ({"origin": ""}, ("'origin'", "missing")),
        ({"image": "''"}, ("'image'", "name the picture")),
        ({"image": "[a, b]"}, ("'image'",)),
        ({"image": "gone.pgm"}, ("gone.pgm", "no such file")),
        ({"resolution": ".nan"}, ("'resolution'", "positive", ".nan")),
        ({"resolution": "nan"}, ("'resolution'", "positive", "nan")),
        ({"resolution": ".inf"}, ("'resolution'", "finite", ".inf")),
        ({"resolution": "1e999"}, ("'resolution'", "inf")),
        ({"resolution": "0"}, ("'resolution'", "found 0")),
        ({"resolution": "-0.05"}, ("'resolution'", "-0.05")),
        ({"resolution": "five"}, ("'resolution'", "five", "write for example 0.05")),
        ({"resolution": "[0.05]"}, ("'resolution'",)),
        ({"origin": "[0.0, 0.0]"}, ("'origin'", "three", "[0.0, 0.0]")),
        ({"origin": "[0, 0, .nan]"}, ("'origin'", "finite", ".nan")),
        ({"origin": "[0, 0, east]"}, ("'origin'", "east")),
        ({"origin": "7"}, ("'origin'", "7")),
        ({"resolution": "0.00005"}, ("resolution", "0.0001 to 100", "5e-05")),
        ({"resolution": "50.0e+1"}, ("0.0001 to 100", "500")),
        ({"origin": "[1.0e+12, 0, 0]"}, ("'origin'", "x of the origin", "1e+07", "1e+12")),
        ({"origin": "[0, -1.1e+7, 0]"}, ("'origin'", "y of the origin", "-1.1e+07")),
        ({"origin": "[0, 0, 90]"}, ("'origin'", "yaw", "12.57 radians", "90", "degrees?")),
        ({"origin": "{x: 1}"}, ("'origin'",)),
        ({"free_thresh": "1.5"}, ("'free_thresh'", "[0, 1]", "1.5")),
        ({"occupied_thresh": "65"}, ("'occupied_thresh'", "[0, 1]", "65")),
        ({"occupied_thresh": ".nan"}, ("'occupied_thresh'", ".nan")),
        ({"occupied_thresh": "most"}, ("'occupied_thresh'", "most")),
        ({"free_thresh": "0.65"}, ("'free_thresh' (0.65)", "below")),
        ({"mode": "binary"}, ("'mode'", "trinary, scale or raw", "binary")),
        ({"negate": "2"}, ("'negate'", "0 or 1", "2")),
        ({"negate": "maybe"}, ("'negate'", "maybe")),
        ({"occupied_thresh": "", "occupied_tresh": "0.6"}, ("occupied_tresh", "'occupied_thresh'")),
    ],
)
def test_a_bad_yaml_value_is_named_with_its_mend(
    tmp_path: Path, changes: dict[str, str], words: tuple[str, ...]
) -> None:
    assert_refused(write_map(tmp_path, TINY, **changes), "map.yaml", *words)


def test_swapped_thresholds_give_the_message_of_the_style_guide(tmp_path: Path) -> None:
    path = write_map(tmp_path, TINY, free_thresh="0.7")
    assert assert_refused(path) == (
        f"{path}: 'free_thresh' (0.70) must be below 'occupied_thresh' (0.65); "
        "swap them or omit both for defaults"
    )


@pytest.mark.parametrize(
    ("data", "found"),
    [
        (b"", "found nothing; give"),
        (b"just words", "found 'just words'; give"),
        (b"- a\n- list\n", "found [a, list]; give"),
        (b"services: {}\nx: 1\n", "found [services, x]; give"),
        (b"image: [unclosed\n", "not YAML"),
    ],
)
def test_what_is_no_map_yaml_is_refused_in_one_line(
    tmp_path: Path, data: bytes, found: str
) -> None:
    path = tmp_path / "map.yaml"
    path.write_bytes(data)
    assert_refused(path, "map.yaml", found)


@pytest.mark.parametrize(
    ("name", "data", "words"),
    [
        ("map.pgm", b"", ("wanted a PGM, PNG or BMP", "save the map again")),
        ("map.pgm", b"hello, I am text\n", ("wanted a PGM, PNG or BMP", "hello")),
        ("map.pgm", TINY[:-1], ("truncated",)),
        ("map.pgm", TINY[:8], ("header",)),
        ("map.pgm", b"P5\n0 4\n255\n", ("with pixels", "0 4")),
        ("map.pgm", b"P5\n-3 2\n255\n123456", ("with pixels", "-3 2")),
        ("map.pgm", b"P5\n3 2\n0\n123456", ("maxval",)),
        ("map.pgm", b"P5\n3 2\n99999\n123456", ("maxval",)),
        ("map.pgm", pgm(ROWS, plain=True)[:-6], ("not enough image data",)),
        ("map.pgm", b"P2\n2 1\n255\n12 abc\n", ("damaged",)),
        ("map.pgm", b"P2\n2 1\n255\n12 -1\n", ("damaged",)),
        ("map.pgm", b"Pf\n1 1\n1.0\nabcd", ("damaged",)),
        ("map.jpg", b"\xff\xd8\xff\xe0 a photo", ("found a file that starts with", "convert")),
        ("map.tif", b"II*\x00 scan", ("II*",)),
        ("map.gif", b"GIF89a", ("GIF",)),
        ("map.png", png([b"\x01\x02"], 2)[:30], ("PNG",)),
        ("map.png", png([b"\x01\x02"], 2)[:-12], ("truncated PNG",)),
        ("map.png", png([b"\x01\x02"], 2)[:-20] + b"\x00" * 20, ("checksum",)),
        ("map.png", png([b"\x01\x02"], 2)[:20], ("damaged",)),
        ("map.png", png([], 2), ("with pixels",)),
        ("map.png", png([b"\x01\x02"], 2, depth=5), ("PNG",)),
        ("map.bmp", bmp24(ROWS)[:-13], ("truncated",)),
        ("map.bmp", bmp24(ROWS)[:20], ("damaged",)),
    ],
)
def test_a_bad_picture_is_named_with_its_mend(
    tmp_path: Path, name: str, data: bytes, words: tuple[str, ...]
) -> None:
    assert_refused(write_map(tmp_path, data, name), name, *words)
    (tmp_path / name).unlink()
    (tmp_path / f"{name}.gz").write_bytes(gzip.compress(data))
    if data:
        assert_refused(tmp_path / "map.yaml", name, *words)


def test_damaged_gzip_is_refused(tmp_path: Path) -> None:
    packed = gzip.compress(pgm([list(range(250))] * 50))
    for data in (packed[:-10], packed[:25], packed[:40] + b"\x55" * 20 + packed[60:]):
        path = tmp_path / "map.pgm.gz"
        path.write_bytes(data)
        assert_refused(path, "gzip", resolution=0.05)


def test_a_gzip_bomb_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(images, "GZIP_LIMIT", 2**20)
    path = tmp_path / "bomb.pgm.gz"
    path.write_bytes(gzip.compress(TINY + bytes(2**20)))
    assert_refused(path, "unpacks to more than 1.0 MiB", "gunzip", resolution=0.05)


@pytest.mark.parametrize(
    ("name", "head"),
    [
        ("vast.pgm", b"P5 4000000 4000000 255\n"),
        ("vast.pgm", b"P2 4000000 4000000 255\n"),
        ("vast.pgm.gz", gzip.compress(b"P5 4000000 4000000 255\n", mtime=0)),
        ("vast.png", png([b"\x00"], 4_000_000, height=4_000_000)),
        ("vast.bmp", bmp24(ROWS)[:18] + b"\x00\x09\x3d\x00" * 2 + bmp24(ROWS)[26:]),
    ],
)
def test_a_picture_beyond_memory_is_refused_with_numbers(
    tmp_path: Path, name: str, head: bytes
) -> None:
    path = tmp_path / name
    path.write_bytes(head)
    with pytest.raises(MemoryBudgetError, match=r"4000000 x 4000000.*TiB of memory.*GiB|MiB"):
        load_map(path, resolution=0.05)


def test_a_picture_of_another_map_is_refused(tmp_path: Path) -> None:
    """Before, the cells of one map were read with the cell size and origin of another."""
    path, picture = save_map(grid_of(CELLS), tmp_path / "out")
    _, other = save_map(grid_of([[0, 100, -1]]), tmp_path / "other")
    whole = picture.read_bytes()
    other.replace(picture)
    assert_refused(path, "out.pgm", "belongs to another map or was edited", "'pixels_sha256'")
    picture.write_bytes(whole[:-1] + b"\x07")
    assert_refused(path, "out.pgm")
    lines = path.read_text().splitlines()[:-1]
    path.write_text("\n".join(lines))
    assert load_map(path).cells.shape == (2, 3)


def test_a_saved_map_may_be_packed(tmp_path: Path) -> None:
    path, picture = save_map(grid_of(CELLS), tmp_path / "out")
    (tmp_path / "out.pgm.gz").write_bytes(gzip.compress(picture.read_bytes()))
    picture.unlink()
    assert values_of(path) == CELLS


def test_a_missing_file_a_folder_and_a_device_are_told_apart(tmp_path: Path) -> None:
    assert_refused(tmp_path / "gone.yaml", "gone.yaml", "no such file")
    assert_refused(tmp_path / "gone.pgm", "gone.pgm", "no such file", resolution=0.1)
    for name in ("folder", "folder.yaml", "folder.pgm"):
        (tmp_path / name).mkdir()
        assert_refused(
            tmp_path / name, name, "a folder", resolution=0.1 if "y" not in name else None
        )
    (tmp_path / "map.pgm").mkdir()
    (tmp_path / "map.yaml").write_text("image: map.pgm\nresolution: 1\norigin: [0, 0, 0]\n")
    assert_refused(tmp_path / "map.yaml", "map.pgm", "a folder")
    os.mkfifo(tmp_path / "pipe.yaml")
    assert_refused(tmp_path / "pipe.yaml", "a pipe")
    with pytest.raises(MapFileError, match="/dev/null: wanted a file, found a device"):
        load_map("/dev/null")


def test_names_the_system_cannot_hold_are_refused(tmp_path: Path) -> None:
    names = ("a\x00b.yaml", "x" * 300 + ".yaml", "x" * 300 + ".pgm")
    for name in (*names, "a\x00b/map.yaml", "\ud800/map.yaml", "x" * 300 + "/map.yaml"):
        with pytest.raises(MapFileError, match="; "):
            load_map(tmp_path / name)


def test_an_image_alone_needs_a_resolution_and_a_yaml_none(tmp_path: Path) -> None:
    path = write_map(tmp_path, TINY)
    assert_refused(tmp_path / "map.pgm", "map.pgm", "--resolution", "YAML")
    assert_refused(path, "map.yaml", "--resolution", resolution=0.05)


@pytest.mark.parametrize("resolution", [0.0, -1.0, math.nan, math.inf])
def test_the_given_resolution_is_checked(tmp_path: Path, resolution: float) -> None:
    (tmp_path / "map.pgm").write_bytes(TINY)
    assert_refused(tmp_path / "map.pgm", "'resolution'", resolution=resolution)


def grid_of(cells: npt.ArrayLike, **arguments: object) -> OccupancyGrid:
    values = {"resolution": 0.05, **arguments}
    return OccupancyGrid(np.array(cells, dtype=np.int8), **values)


def test_saving_writes_254_0_and_205(tmp_path: Path) -> None:
    yaml_path, image_path = save_map(grid_of(CELLS, origin=Pose2(1, 2)), tmp_path / "out")
    assert (yaml_path, image_path) == (tmp_path / "out.yaml", tmp_path / "out.pgm")
    assert image_path.read_bytes() == b"P5\n3 2\n255\n" + bytes(ROWS[0] + ROWS[1])
    assert yaml_path.read_text() == (
        "image: out.pgm\nmode: trinary\nresolution: 0.05\norigin: [1.0, 2.0, 0.0]\n"
        "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\npixels_sha256: "
        "fd84fa8548604df2ba2ec1ca329f9fcd28759dc767ff50b4bd4056172eb21055\n"
    )
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out.pgm", "out.yaml"]


PERCENTS = [[0, 19, 20, 25, 26, 64, 65, 100, -1]]


@pytest.mark.parametrize(
    "thresholds", [NormalizeConfig(), NormalizeConfig(free_percent=10.0, occupied_percent=99.5)]
)
def test_the_classes_that_vote_are_saved(tmp_path: Path, thresholds: NormalizeConfig) -> None:
    grid = grid_of(PERCENTS)
    save_map(grid, tmp_path / "out", classes=thresholds)
    votes = trinary_cells(grid.cells, thresholds)
    for reader in (thresholds, NormalizeConfig()):
        assert np.array_equal(trinary_cells(load_map(tmp_path / "out.yaml").cells, reader), votes)


def test_scale_writes_the_greys_of_nav2(tmp_path: Path) -> None:
    # Read from what GraphicsMagick 1.3.40 writes for nav2's saver.
    save_map(grid_of([[0, 2, 4, 40, 50, 99, 100, -1]]), tmp_path / "out", mode="scale")
    pixels = cv2.imread(str(tmp_path / "out.png"), cv2.IMREAD_UNCHANGED)
    assert pixels[0, :, 0].tolist() == [255, 249, 244, 153, 127, 2, 0, 127]
    assert pixels[0, :, 3].tolist() == [255] * 7 + [0]


def test_raw_writes_percent_and_255(tmp_path: Path) -> None:
    save_map(grid_of([[0, 37, 100, -1]]), tmp_path / "out", mode="raw")
    assert (tmp_path / "out.pgm").read_bytes().endswith(bytes([0, 37, 100, 255]))


SHAPES = st.tuples(st.integers(1, 9), st.integers(1, 9))
TRINARY = arrays.arrays(np.int8, SHAPES, elements=st.sampled_from([-1, 0, 100]))
PERCENT = arrays.arrays(np.int8, SHAPES, elements=st.integers(-1, 100))
KNOWN = arrays.arrays(np.int8, SHAPES, elements=st.integers(0, 100))
COORDINATES = st.floats(-1e7, 1e7)
YAWS = st.floats(-4.0 * math.pi, 4.0 * math.pi)
RESOLUTIONS = st.one_of(st.sampled_from([0.05, 0.1, 1e-4]), st.floats(1e-4, 100.0))


@settings(deadline=None, max_examples=examples(150))
@given(st.data())
def test_save_then_load_is_identity(data: st.DataObject) -> None:
    mode = data.draw(st.sampled_from(["trinary", "scale", "raw"]))
    image_format = data.draw(st.sampled_from(["pgm", "png", "bmp"]))
    cells = {"trinary": TRINARY, "raw": PERCENT, "scale": PERCENT}[mode]
    if mode == "scale" and image_format != "png":
        cells = KNOWN
    thresholds = {"free_thresh": 0.0, "occupied_thresh": 1.0} if mode == "scale" else {}
    origin = Pose2(data.draw(COORDINATES), data.draw(COORDINATES), data.draw(YAWS))
    grid = OccupancyGrid(data.draw(cells), data.draw(RESOLUTIONS), origin, "out")
    with tempfile.TemporaryDirectory() as folder:
        path, _ = save_map(
            grid, Path(folder) / "out", mode=mode, image_format=image_format, **thresholds
        )
        again = load_map(path)
        first = path.read_bytes()
        save_map(again, Path(folder) / "out", mode=mode, image_format=image_format, **thresholds)
        assert path.read_bytes() == first
    assert np.array_equal(again.cells, grid.cells)
    assert (again.resolution, again.origin, again.name) == (grid.resolution, origin, "out")


@settings(deadline=None, max_examples=examples(50))
@given(
    rows=arrays.arrays(np.uint8, SHAPES),
    negate=st.booleans(),
    occupied=st.floats(0.5, 1.0),
    free=st.floats(0.0, 0.49),
)
def test_any_grey_is_classed_by_the_written_rule(
    rows: npt.NDArray[np.uint8], negate: bool, occupied: float, free: float
) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = write_map(
            Path(folder),
            pgm(rows.tolist()),
            negate=str(int(negate)),
            occupied_thresh=repr(occupied),
            free_thresh=repr(free),
        )
        found = values_of(path)
    shade = rows[::-1] / 255.0
    occupancy = shade if negate else 1.0 - shade
    expected = np.where(occupancy > occupied, 100, np.where(occupancy < free, 0, -1))
    assert found == expected.tolist()


def test_numbers_are_written_so_that_any_yaml_reader_finds_numbers(tmp_path: Path) -> None:
    grid = grid_of([[0]], resolution=1e-4, origin=Pose2(-1e-5, 1e7, -0.1))
    path, _ = save_map(grid, tmp_path / "out")
    assert "-1.0e-05" in path.read_text()
    values = yaml.safe_load(path.read_text())
    assert values["resolution"] == 1e-4
    assert values["origin"] == [-1e-5, 1e7, -0.1]


@pytest.mark.parametrize("name", ["map_0.05", "a: b", "#x", "ünïcode", "sp ace", "yes", "it's"])
def test_any_file_name_survives(tmp_path: Path, name: str) -> None:
    path, _ = save_map(grid_of(CELLS), tmp_path / name)
    assert path.name == f"{name}.yaml"
    assert values_of(path) == CELLS
    assert load_map(path).name == name


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"mode": "binary"}, "trinary, scale or raw"),
        ({"image_format": "jpg"}, "pgm, png or bmp"),
        ({"free_thresh": 0.7}, "must be below"),
        ({"occupied_thresh": 1.5}, r"\[0, 1\]"),
        ({"free_thresh": 0.25}, "would not load as free"),
        ({"occupied_thresh": 1.0}, "would not load as free"),
        ({"mode": "scale", "image_format": "pgm"}, "use png"),
        ({"mode": "scale", "image_format": "bmp"}, "use png"),
        ({"grid": grid_of(CELLS, resolution=1e-5)}, "resolution must lie in"),
        ({"grid": grid_of(CELLS, origin=Pose2(0.0, 1e9))}, "y of the origin"),
    ],
)
def test_what_would_not_load_back_is_not_saved(
    tmp_path: Path, arguments: dict[str, object], words: str
) -> None:
    with pytest.raises(MapFileError, match=words):
        save_map(**{"grid": grid_of(CELLS), "stem": tmp_path / "out", **arguments})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("stem", ["/dev/full", "/dev/null", "/", "..", "."])
def test_a_device_is_never_a_place_for_a_map(stem: str) -> None:
    before = sorted(Path("/dev").iterdir())
    with pytest.raises(MapFileError, match="cannot write"):
        save_map(grid_of(CELLS), stem)
    assert sorted(Path("/dev").iterdir()) == before
    assert Path("/dev/full").is_char_device()


def test_saving_beyond_memory_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "available_memory", lambda: 1000)
    with pytest.raises(MemoryBudgetError, match=r"out\.pgm: saving a 3 x 2 map needs"):
        save_map(grid_of(CELLS), tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.datasets
def test_every_recorded_map_loads_and_survives_saving(tmp_path: Path) -> None:
    loaded = 0
    for entry in map_entries():
        grid = load_entry(entry)
        path, _ = save_map(grid, tmp_path / "again")
        assert np.array_equal(load_map(path).cells, grid.cells), entry.file
        loaded += 1
    assert loaded == len(map_entries()) > 60


# --- maps of other programs and machines ----------------------------------------------------------

GREYS = np.repeat(np.array([[254, 205, 0]], dtype=np.uint8), 4, axis=0)
RIGHT = [FREE, UNKNOWN, OCCUPIED]


def written(folder: Path, pixels: np.ndarray, **changes: str) -> Path:
    """Write a map whose picture has colour channels that are equal, and may have alpha."""
    return write_map(folder, cv2.imencode(".png", pixels)[1].tobytes(), "map.png", **changes)


def test_colours_without_alpha_need_no_word(tmp_path: Path) -> None:
    said: list[str] = []
    path = written(tmp_path, np.dstack([GREYS] * 3))
    assert load_map(path, warn=said.append).cells[0].tolist() == RIGHT
    assert said == []


@pytest.mark.parametrize("image", ["/home/a/maps/map.png", "C:\\maps\\map.png", "maps/map.png"])
def test_a_picture_of_another_machine_lies_beside_the_yaml(tmp_path: Path, image: str) -> None:
    said: list[str] = []
    path = written(tmp_path, GREYS, image=f"'{image}'")
    assert load_map(path, warn=said.append).cells[0].tolist() == RIGHT
    assert len(said) == 1
    assert "map.png next to the YAML" in said[0]


@pytest.mark.parametrize("image", ["/home/a/maps/other.png", "C:\\", "maps/"])
def test_a_picture_that_is_nowhere_is_named_as_the_yaml_does(tmp_path: Path, image: str) -> None:
    with pytest.raises(MapFileError, match="'image' names"):
        load_map(written(tmp_path, GREYS, image=f"'{image}'"))


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
    path = written(tmp_path, FRINGED, mode="scale")
    classes = trinary_cells(load_map(path, settle_edges=True).cells, NormalizeConfig())[0]
    assert classes.tolist() == [0, 0, 1, 1, 1, 1, 0, 0, 0]


@pytest.mark.parametrize(
    "row",
    [
        [254, 205, 0, 0, 205, 205, 254],  # what map savers write for unknown
        [254, 120, 120, 120, 0, 0, 0],  # too wide for a fringe
        [254, 254, 120, 254, 254, 0, 0],  # next to no wall
    ],
)
def test_other_grey_cells_stay_as_they_are(tmp_path: Path, row: list[int]) -> None:
    path = written(tmp_path, np.repeat(np.array([row], dtype=np.uint8), 4, axis=0))
    assert np.array_equal(load_map(path, settle_edges=True).cells, load_map(path).cells)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("a.tum", r"a path; .*--truth-trajectory of `run`"),
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
