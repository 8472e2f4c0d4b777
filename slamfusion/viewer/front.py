"""The front end's files, one by one or as a single script for a page that has no server."""

from __future__ import annotations

import importlib.resources
import re

FRAGMENT = re.compile(r"<!-- (\w+\.html) -->")
# The only two forms in which our modules take from each other and give.
IMPORT = re.compile(r'^import (\{ \w+(?:, \w+)* \}) from "\./(\w+)\.js";$', re.MULTILINE)
EXPORT = re.compile(r"^export (?=(?:class|const|function) (\w+))", re.MULTILINE)
OTHER_FORM = re.compile(r"^(?:import|export)\b.*$", re.MULTILINE)


def front_end(package: str = "slamfusion.viewer") -> dict[str, str]:
    """Return the texts of a package's front end by file name."""
    folder = importlib.resources.files(package) / "static"
    return {item.name: item.read_text(encoding="utf-8") for item in folder.iterdir()}


def with_fragments(html: str) -> str:
    """Put the parts that several pages share in the places of ``<!-- NAME.html -->``."""
    files = front_end()
    return FRAGMENT.sub(lambda found: files[found[1]], html)


def bundled(script: str) -> str:
    """Return a module and all modules that it imports as one script without imports.

    Each module becomes a function of its own, so that their names do not meet.

    Args:
        script: imports from the modules of ``static`` alone.

    Raises:
        ValueError: a module imports or exports in a form that is not known here.
    """
    files = front_end()
    modules: dict[str, str] = {}

    def take(text: str) -> str:
        for _, name in IMPORT.findall(text):
            if name not in modules:
                modules[name] = ""  # a circle would end here
                source = files[f"{name}.js"]
                given = ", ".join(EXPORT.findall(source))
                body = take(EXPORT.sub("", source))
                del modules[name]  # after those that it needs
                start, end = f"const from_{name} = (() => {{\n", f"return {{ {given} }};\n}})();\n"
                modules[name] = start + body + end
        body = IMPORT.sub(r"const \1 = from_\2;", text)
        if unknown := OTHER_FORM.search(body):
            raise ValueError(f"the front end says {unknown[0]!r}, which cannot be bundled")
        return body

    entry = take(script)
    return "".join(modules.values()) + entry
