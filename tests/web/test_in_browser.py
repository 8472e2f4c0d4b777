"""The page itself in headless Chromium, on a server without ROS."""

from __future__ import annotations

from typing import Any

import numpy as np

from slamfusion.geometry import Pose2
from slamfusion.grid import OccupancyGrid
from slamfusion.palette import DISAGREEMENT_RGB, FREE_RGB, OTHERS, WALL_RGB
from slamfusion.web.scene import Scene
from slamfusion.web.server import PageServer
from tests.support.browser import becomes, browser_page

TOKEN = "0123456789abcdef01234567"  # noqa: S105 - of this test
WALL, FREE = (*WALL_RGB, 255), (*FREE_RGB, 255)


def room(wall_row: int, *, name: str = "fused", x: float = 0.0) -> OccupancyGrid:
    """A free room of 60 x 90 cells with one wall."""
    cells = np.zeros((60, 90), dtype=np.int8)
    cells[wall_row : wall_row + 4] = 100
    return OccupancyGrid(cells, 0.05, Pose2(x, 0.0, 0.0), name)


def status(scene: Scene, **inputs: tuple[bool, list[float] | None]) -> None:
    told = [
        {"name": name, "votes": votes, "reason": "", "score": 0.5, "transform": place}
        for name, (votes, place) in inputs.items()
    ]
    scene.put_status(told, poses=[], headline="as told", level="good", figures={})


def leaves_and_comes_again(page: Any, scene: Scene) -> None:
    """An input that is removed leaves no row, no layer and no choice; it may come again."""
    scene.remove("a")
    status(scene)
    page.wait_for_selector('#layers li[data-name="a"]', state="detached")
    page.wait_for_selector('#inputs li[data-name="a"]', state="detached")
    assert page.locator('#second option[value="a"]').count() == 0
    scene.put_map("a", room(20, name="a", x=7.0), "input")
    status(scene, a=(True, [-7.0, 0.0, 0.0]))
    page.wait_for_selector('#layers li[data-name="a"]')
    page.wait_for_selector('#inputs li[data-name="a"][data-votes="true"]')


def disagreement_is_of_no_input(page: Any, scene: Scene) -> None:
    """Where nobody agreed is drawn in a colour of its own, which also stands in the list."""
    scene.put_map("agreement", room(10), "agreement")
    agreement = page.locator('#layers li[data-name="agreement"]')
    agreement.locator("input[type=checkbox]").check()
    agreement.locator("input[type=range]").fill("1")
    for name in ("fused", "a"):
        page.uncheck(f'#layers li[data-name="{name}"] input[type=checkbox]')
    becomes(page, (*DISAGREEMENT_RGB, round(0.9 * 255)), "agreement", 40, 5)
    becomes(page, (0, 0, 0, 0), "agreement", 12, 5)
    swatch = agreement.locator("i").evaluate("item => getComputedStyle(item).backgroundColor")
    assert swatch == f"rgb{DISAGREEMENT_RGB}"
    agreement.locator("input[type=checkbox]").uncheck()
    page.check('#layers li[data-name="fused"] input[type=checkbox]')


def test_the_page_follows_looks_back_compares_and_comes_back() -> None:
    scene = Scene("first", is_live=True)
    server = PageServer(scene, token=TOKEN, command=lambda name: (True, f"{name}: done"))
    with browser_page() as page:
        page.goto(server.url)
        scene.put_map("fused", room(10), "fused")
        page.wait_for_selector('#layers li[data-name="fused"]')
        page.click("#pixels")
        becomes(page, WALL, "fused", 12, 5)
        becomes(page, FREE, "fused", 40, 5)

        # What moves is drawn; the slider goes back to what was, and to now again.
        page.wait_for_timeout(300)
        scene.put_map("fused", room(38), "fused")
        becomes(page, WALL, "fused", 40, 5)
        page.evaluate(
            """() => {
              const slider = document.querySelector("#slider");
              slider.value = slider.min;
              slider.dispatchEvent(new Event("input"));
            }"""
        )
        becomes(page, WALL, "fused", 12, 5)
        becomes(page, FREE, "fused", 40, 5)
        page.click("#now")
        becomes(page, WALL, "fused", 40, 5)

        # An input lies where its transform says, in its colour; a cell names who says what.
        scene.put_map("a", room(20, name="a", x=7.0), "input")
        status(scene, a=(True, [-7.0, 0.0, 0.0]))
        page.wait_for_selector('#inputs li[data-name="a"][data-votes="true"]')
        page.fill('#layers li[data-name="a"] input[type=range]', "1")
        becomes(page, (*OTHERS[0], 255), "a", 22, 50)
        page.check("#difference")
        page.select_option("#first", "fused")
        page.select_option("#second", "a")
        # A wall of one map alone has that map's colour, and so have the words below.
        becomes(page, WALL, "fused", 39, 5)
        becomes(page, (*OTHERS[0], 255), "a", 22, 5)
        swatch = page.locator("#difference-legend .two")
        background = swatch.evaluate("item => getComputedStyle(item).backgroundColor")
        assert background == f"rgb{OTHERS[0]}"
        page.uncheck("#difference")

        disagreement_is_of_no_input(page, scene)

        page.click("#save")
        page.wait_for_selector("#answer.good")
        assert page.text_content("#answer") == "✓ save: done"

        leaves_and_comes_again(page, scene)

        # The server dies and begins again: another scene, the same page and token.
        server.close()
        page.wait_for_selector("body[data-connected=false]")
        again = Scene("second", is_live=True)
        other = PageServer(again, port=server.port, token=TOKEN, command=lambda _: (True, "again"))
        again.put_map("fused", room(5), "fused")
        page.wait_for_selector("body[data-connected=true]", timeout=15_000)
        becomes(page, WALL, "fused", 6, 5)
        becomes(page, FREE, "fused", 40, 5)
        assert page.locator('#layers li[data-name="a"]').count() == 0
        page.click("#save")
        page.wait_for_selector("#answer.good")
        assert page.text_content("#answer") == "✓ again"
        other.close()
