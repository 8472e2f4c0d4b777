"""Map over map in a browser: the scene that a page shows, its front end, and the live page.

The front end's files are here, one by one or as a single script for a page that has no server.
"""

from __future__ import annotations

import importlib.resources
import re

FRAGMENT = re.compile(r"<!-- (\w+\.html) -->")
# The modules of the viewer, each after those that it imports. Their names differ.
VIEWER = ("maps.js", "panels.js", "view.js", "stage.js", "time.js")
IMPORT = re.compile(r"^import .*;\n", re.MULTILINE)
EXPORT = re.compile(r"^export ", re.MULTILINE)


def front_end() -> dict[str, str]:
    """Return the texts of the front end by file name; pages have the fragments that they name."""
    folder = importlib.resources.files("slamfusion.web") / "static"
    files = {item.name: item.read_text(encoding="utf-8") for item in folder.iterdir()}
    files["index.html"] = FRAGMENT.sub(lambda found: files[found[1]], files["index.html"])
    return files


def bundled(script: str) -> str:
    """Return a module that imports from the viewer as one script without imports."""
    files = front_end()
    whole = "".join([*(files[name] for name in VIEWER), script])
    return EXPORT.sub("", IMPORT.sub("", whole))
