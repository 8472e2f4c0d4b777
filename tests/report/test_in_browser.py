"""The report in headless Chromium, from its file: nothing is blank, and its maps can be touched."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from slamfusion.config import RunConfig
from slamfusion.jobs.fuse import FusedMaps, write_fusion_report
from slamfusion.palette import AGREED_WALL_RGB, OTHERS, WALL_RGB
from tests.report.drawn import colours_of, evaluation, fusion, room
from tests.support.browser import PIXEL, becomes, browser_page

pytestmark = pytest.mark.once

NASTY = "<img src=x onerror='window.ran=1'><script>window.ran = 2</script>"
# A cell of the wall that every room has, on an axis-aligned lattice of one origin.
WALL = (4, 30)


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    errors = (evaluation(room("fused", 0)),)
    maps = FusedMaps(RunConfig(), fusion(rejected_name=NASTY), None, errors)
    return write_fusion_report(maps, tmp_path_factory.mktemp("report"))


@pytest.fixture(scope="module")
def page(report: Path) -> Iterator[Any]:
    """Open the report once; an error of its script, or of its policy, fails the tests."""
    with browser_page(width=1360, height=1600) as opened:
        opened.goto(report.as_uri())
        opened.wait_for_selector("body[data-drawn=true]")
        yield opened


def test_every_picture_decodes_and_no_name_runs(report: Path, page: Any) -> None:
    assert page.title() == "SLAMfusion report"
    sizes = page.evaluate("[...document.images].map(image => image.naturalWidth)")
    assert len(sizes) == report.read_text(encoding="utf-8").count("<img ")
    assert min(sizes) > 100
    assert page.evaluate("window.ran ?? 'nothing ran'") == "nothing ran"


def test_the_page_is_not_blank(page: Any) -> None:
    image = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)
    assert image.shape[1] == 1360
    assert len(colours_of(image)) > 200
    # The headline's bar is drawn in the colour of a warning: one input was rejected.
    assert tuple(int(value) for value in image[3, 700, ::-1]) == (0x9A, 0x5B, 0x00)


def test_layers_are_shown_compared_and_asked(page: Any) -> None:
    page.click("#pixels")
    rejected = page.locator("#layers li").last
    assert rejected.get_attribute("data-name") == NASTY
    assert not rejected.locator("input[type=checkbox]").is_checked()
    for name in ("room 1", "room 2"):
        page.uncheck(f'#layers li[data-name="{name}"] input[type=checkbox]')
    page.fill('#layers li[data-name="room 0"] input[type=range]', "1")
    becomes(page, (*OTHERS[0], 255), "fused", *WALL)
    page.uncheck('#layers li[data-name="room 0"] input[type=checkbox]')
    becomes(page, (*WALL_RGB, 255), "fused", *WALL)
    page.uncheck('#layers li[data-name="fused"] input[type=checkbox]')
    becomes(page, (0, 0, 0, 0), "fused", *WALL)
    page.check('#layers li[data-name="fused"] input[type=checkbox]')

    # The cell under the pointer, in metres of the fused frame; who said what.
    for _ in range(6):
        page.click("#closer")
    box = page.locator("#map").bounding_box()
    x, y = page.evaluate("document.querySelector('#map').view.pixelOf('fused', 4, 30)")
    page.mouse.move(box["x"] + x, box["y"] + y)
    said = page.text_content("#cell")
    assert said.startswith("x -1.4")
    assert "y 500.2" in said
    assert "fused: wall, agreement: 100 %, room 0: wall, room 1: " in said
    assert NASTY not in said

    # By keys: the cross stands in the middle, and asks there.
    page.focus("#map")
    page.keyboard.press("0")
    page.keyboard.press("ArrowLeft")
    found = re.match(r"x (-?[\d.]+) m", page.text_content("#cell"))
    page.keyboard.press("ArrowRight")
    again = re.match(r"x (-?[\d.]+) m", page.text_content("#cell"))
    assert float(found[1]) < float(again[1])

    # Two maps against each other: a wall of both.
    page.click("#pixels")
    page.check("#difference")
    page.select_option("#second", "room 0")
    becomes(page, (*AGREED_WALL_RGB, 255), "fused", *WALL)
    page.uncheck("#difference")


def test_a_phone_is_wide_enough_and_paper_shows_the_pictures(page: Any) -> None:
    page.set_viewport_size({"width": 400, "height": 800})
    wide = "document.documentElement.scrollWidth - window.innerWidth"
    assert page.evaluate(wide) <= 0, "the page is wider than its window"
    assert page.is_visible("#viewer")
    page.emulate_media(media="print")
    assert not page.is_visible("#viewer")
    assert page.is_visible("img >> nth=0")
    page.emulate_media(media="screen")
    assert page.evaluate(PIXEL, ["fused", *WALL])
