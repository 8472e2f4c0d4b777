"""The system's Chromium, driven by Playwright; a test that finds none fails."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from playwright.sync_api import sync_playwright

NAMES = ("chromium", "google-chrome", "chromium-browser")
# The colour, [red, green, blue, alpha], of a cell of a map on the stage; empty for none.
PIXEL = """([name, row, column]) => {
  const canvas = document.querySelector("#map");
  const at = canvas.view.pixelOf(name, row, column);
  if (at === null) return [];
  const [x, y] = at;
  return Array.from(canvas.getContext("2d").getImageData(x, y, 1, 1).data);
}"""


@contextmanager
def browser_page(width: int = 1280, height: int = 860) -> Iterator[Any]:
    """Open a window; an error of the page, or of its policy, fails the test at its end."""
    executable = next(filter(None, map(shutil.which, NAMES)), None)
    assert executable is not None, "no chromium on the PATH; apt-get install chromium"
    options = ["--no-sandbox"] if os.geteuid() == 0 else []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=executable, args=[*options, "--disable-dev-shm-usage"]
        )
        page = browser.new_page(viewport={"width": width, "height": height})
        wrong: list[str] = []
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on("console", lambda said: wrong.append(said.text) if "Policy" in said.text else None)
        try:
            yield page
        finally:
            browser.close()
        assert not wrong


def becomes(page: Any, colour: tuple[int, ...], name: str, row: int, column: int) -> None:
    """Wait until a cell of a map has a colour."""
    until_s = time.monotonic() + 10.0
    while (found := tuple(page.evaluate(PIXEL, [name, row, column]))) != colour:
        assert time.monotonic() < until_s, f"{name} {row} {column} is {found}, not {colour}"
        page.wait_for_timeout(50)
