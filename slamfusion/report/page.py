"""A page of a report: what stands on it, and how it becomes one HTML file with its pictures."""

from __future__ import annotations

import base64
import datetime as dt
import hashlib
import importlib.resources
import math
import platform
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import jinja2
import yaml
from markupsafe import Markup
from matplotlib.figure import Figure  # noqa: TID251

from slamfusion.config import PAGE, PICTURE_FORMS, PICTURES, RunConfig
from slamfusion.io.files import AtomicFiles
from slamfusion.json_values import dotted
from slamfusion.report.canvas import Legend, add_lettering, to_form
from slamfusion.report.layers import Layers
from slamfusion.slam.registry import with_producers
from slamfusion.version import __version__, version_of, versions
from slamfusion.web import bundled, front_end

NO_TABLES = Markup("")
_STEM = re.compile(r"[^A-Za-z0-9_-]+")
_STEM_LENGTH = 40
CARDS = 4


@dataclass(frozen=True, eq=False)
class Picture:
    """A figure with its caption; title and legend are drawn into the figure.

    Attributes:
        stem: start of the file name; anything that is not a plain character is replaced.
        title: also the alternative text.
        tone: ``plain``, or framed as ``good`` or ``bad``.
        badge: a word next to the caption, e.g. ``rejected``; the picture is framed as ``bad``.
    """

    stem: str
    figure: Figure
    title: str
    caption: str = ""
    tone: str = "plain"
    badge: str = ""
    legend: Legend = field(default_factory=dict)

    def __post_init__(self) -> None:
        add_lettering(self.figure, self.title, self.legend)

    @cached_property
    def png(self) -> bytes:
        """The picture as it is on the page."""
        return to_form(self.figure, "png")

    @property
    def data_uri(self) -> str:
        """The picture embedded in the page."""
        return "data:image/png;base64," + base64.b64encode(self.png).decode("ascii")

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels, as the PNG header says."""
        return int.from_bytes(self.png[16:20], "big"), int.from_bytes(self.png[20:24], "big")


@dataclass(frozen=True)
class Fact:
    """One number of the headline."""

    value: str
    label: str
    tone: str = "plain"


@dataclass(frozen=True)
class Section:
    """Text, layers (in one section of a page at most), pictures and tables, in this order."""

    title: str
    text: str = ""
    pictures: Sequence[Picture] = ()
    tables: Markup = NO_TABLES
    layers: Layers | None = None


@dataclass(frozen=True)
class Banner:
    """The first thing to see: ``tone`` is ``good``, ``plain``, ``warn`` or ``bad``."""

    tone: str
    headline: str
    lines: Sequence[tuple[str, str]] = field(default_factory=tuple)


@dataclass(frozen=True)
class Page:
    """A whole report. The first ``CARDS`` facts are cards; the others are in a table at the end."""

    title: str
    banner: Banner
    facts: Sequence[Fact]
    sections: Sequence[Section]
    config: RunConfig
    device: str


def tables() -> Any:
    """Return the macros of ``tables.html.j2``, each of which gives the HTML of a table or more."""
    return _templates().get_template("tables.html.j2").module


def _settings(config: RunConfig) -> tuple[list[tuple[str, str]], str]:
    """Return the settings that differ from the defaults, and all as YAML."""
    settings = asdict(config)
    defaults = dotted(asdict(with_producers(RunConfig(), config.producers)))
    own = dotted(settings).items()
    changed = [(key, str(value)) for key, value in own if value != defaults.get(key)]
    return changed, yaml.safe_dump(settings, sort_keys=False, allow_unicode=True)


def write_page(page: Page, directory: str | Path) -> Path:
    """Write ``report.html`` and its numbered pictures in one folder, all or none; return its path.

    The pictures are in the page, and in the folder also as ``svg`` and ``pdf`` if the settings ask
    for it. Those of an earlier report go.

    Raises:
        SlamFusionError: the directory cannot be written.
    """
    directory = Path(directory)
    pictures = [picture for section in page.sections for picture in section.pictures]
    # Each is a file name everywhere and no path anywhere.
    stems = [_STEM.sub("-", picture.stem).strip("-")[:_STEM_LENGTH] for picture in pictures]
    names = {
        picture: f"{number:02d}-{stem or 'picture'}.png"
        for number, (picture, stem) in enumerate(zip(pictures, stems, strict=True), start=1)
    }
    has_layers = any(section.layers and section.layers.recorded for section in page.sections)
    path = directory / PAGE
    written = {
        (directory / name).with_suffix(f".{form}"): data
        for picture, name in names.items()
        for form, data in (
            ("png", picture.png),
            *((form, to_form(picture.figure, form)) for form in page.config.report.pictures),
        )
    }
    html = _html(page, names, _script(is_used=has_layers))
    with AtomicFiles() as files:
        for picture_path, data in written.items():
            files.add(picture_path, data)
        files.add(path, html.encode("utf-8", errors="replace"))
        files.remove(*report_files(directory))
    return path


def report_files(folder: Path) -> list[Path]:
    """Return the page of a report in a folder and the pictures that it names; none without one."""
    path = folder / PAGE
    text = path.read_text("utf-8", "replace") if path.exists() else ""
    files = [file for form in PICTURE_FORMS for file in folder.glob(f"{PICTURES}.{form}")]
    return [path, *(own for own in files if f"{own.stem}.png" in text)] if text else []


def _script(*, is_used: bool) -> dict[str, str]:
    """Return the front end of the maps and its digest; the page's policy allows no other script."""
    if not is_used:
        return {}
    text = bundled(_own_file("report.js"))
    digest = hashlib.sha256(text.encode()).digest()
    return {"text": Markup(text), "sha256": base64.b64encode(digest).decode("ascii")}  # noqa: S704


def _html(page: Page, names: Mapping[Picture, str], script: Mapping[str, str]) -> str:
    """Return the page, with the names of its pictures' files."""
    shared = front_end()
    # Our own files, no values of the user's: the only texts that are not escaped, but for the
    # recorded layers, which contain no tag.
    ours = {
        "css": Markup(shared["viewer.css"] + _own_file("report.css")),  # noqa: S704
        "stage": Markup(shared["stage.html"]),  # noqa: S704
        "switches": Markup(shared["layers.html"]),  # noqa: S704
    }
    changed, settings = _settings(page.config)
    found = {
        **versions(),
        "matplotlib": version_of("matplotlib"),
        "platform": f"{platform.system()} {platform.machine()}",
        "device": page.device or "not named",
    }
    return (
        _templates()
        .get_template("report.html.j2")
        .render(
            **ours,
            page=page,
            names=names,
            script=script,
            tables=tables(),
            cards=page.facts[:CARDS],
            facts=[(fact.label, fact.value, fact.tone) for fact in page.facts[CARDS:]],
            changed=changed or [("none", "all settings have their defaults")],
            versions=[(name, own or "not installed") for name, own in found.items()],
            settings=settings,
            made_at=dt.datetime.now(dt.timezone.utc).strftime("%Y-%m-%d %H:%M UTC"),
            version=__version__,
        )
    )


@cache
def _templates() -> jinja2.Environment:
    """Return the templates; every value in them is escaped."""
    found = jinja2.Environment(
        loader=jinja2.FunctionLoader(_own_file),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    found.globals["degrees"] = lambda yaw: math.degrees(math.remainder(yaw, 2 * math.pi))
    return found


def _own_file(name: str) -> str:
    """Return the text of a file of the templates."""
    folder = importlib.resources.files("slamfusion.report") / "templates"
    return (folder / name).read_text(encoding="utf-8")
