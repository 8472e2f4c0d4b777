"""A page of a report: what stands on it, and how it becomes one HTML file with its pictures."""

from __future__ import annotations

import base64
import contextlib
import datetime as dt
import hashlib
import importlib.resources
import platform
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from operator import itemgetter
from pathlib import Path
from typing import Any, TypeVar

import jinja2
import yaml
from markupsafe import Markup
from matplotlib.figure import Figure  # noqa: TID251

from slamfusion.config import PICTURE_FORMS, RunConfig, to_mapping
from slamfusion.io.files import AtomicFiles
from slamfusion.report.canvas import Legend, add_lettering, to_form
from slamfusion.report.layers import Layers
from slamfusion.slam.registry import with_producers
from slamfusion.version import __version__, version_of, versions
from slamfusion.web.front import bundled, front_end

T = TypeVar("T")

_STEM = re.compile(r"[^A-Za-z0-9_-]+")
_STEM_LENGTH = 40
# Facts that are cards at the top.
CARDS = 4


@dataclass(frozen=True, eq=False)
class Picture:
    """A figure with its caption; title and legend are drawn into the figure.

    Attributes:
        stem: start of the file name; anything that is not a plain character is replaced.
        title: also the text for who cannot see the picture.
        tone: ``plain``, or framed as ``good`` or ``bad``.
        badge: a word next to the caption, e.g. ``rejected``.
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
class Cell:
    """One cell of a table; ``tone`` is ``plain``, ``good``, ``bad`` or ``best``."""

    text: str
    tone: str = "plain"
    is_number: bool = False


@dataclass(frozen=True)
class Table:
    """A table with its heading; with ``folded`` it stays closed until it is asked for."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    note: str = ""
    folded: bool = False

    @classmethod
    def of(
        cls,
        title: str,
        items: Iterable[T],
        columns: Mapping[str, Callable[[T], Cell | str | int]],
        note: str = "",
        *,
        folded: bool = False,
    ) -> Table:
        """Return a table with a row for each item.

        Args:
            columns: by heading, what returns the cell of an item: a text, a count, or a ``Cell``.
        """
        rows = [
            [
                own if isinstance(own, Cell) else Cell(str(own), is_number=isinstance(own, int))
                for own in (value(item) for value in columns.values())
            ]
            for item in items
        ]
        return cls(title, tuple(columns), rows, note, folded)


@dataclass(frozen=True)
class Fact:
    """One number of the headline."""

    value: str
    label: str
    tone: str = "plain"


@dataclass(frozen=True)
class Section:
    """A part of the page: text, layers, pictures, tables and a folded text, in this order.

    One section of a page has layers, no more.
    """

    title: str
    text: str = ""
    pictures: Sequence[Picture] = ()
    tables: Sequence[Table] = ()
    code: str = ""
    layers: Layers | None = None


@dataclass(frozen=True)
class Banner:
    """The first thing to see: ``tone`` is ``good``, ``plain``, ``warn`` or ``bad``."""

    tone: str
    headline: str
    lines: Sequence[tuple[str, str]] = field(default_factory=tuple)


@dataclass(frozen=True)
class Page:
    """A whole report, which ends with the settings in effect and the device, in words.

    The first ``CARDS`` of the facts are cards; the others stand in a table at the end.
    """

    title: str
    banner: Banner
    facts: Sequence[Fact]
    sections: Sequence[Section]
    config: RunConfig
    device: str


def number(value: float | None, digits: int = 3, tone: str = "plain") -> Cell:
    """Return a number as a cell, a dash where it is undefined."""
    if value is None:
        return Cell("-", tone, is_number=True)
    return Cell(f"{value:.{digits}f}", tone, is_number=True)


def _circumstances(page: Page) -> Section:
    """Return further facts, the versions, and the settings: those changed, and folded all."""
    found = {
        **versions(),
        "matplotlib": version_of("matplotlib"),
        "platform": f"{platform.system()} {platform.machine()}",
        "device": page.device or "not named",
    }
    settings = to_mapping(page.config)
    defaults = _flat(to_mapping(with_producers(RunConfig(), page.config.producers)))
    changed = [(key, value) for key, value in _flat(settings).items() if value != defaults.get(key)]
    facts = Table.of(
        "Further figures",
        page.facts[CARDS:],
        {"what": lambda own: own.label, "value": lambda own: Cell(own.value, own.tone)},
    )
    tables = [
        Table.of(
            "Settings that differ from the defaults",
            changed or [("none", "all settings have their defaults")],
            {"setting": itemgetter(0), "value": lambda item: str(item[1])},
        ),
        Table.of(
            "Versions",
            found.items(),
            {"what": itemgetter(0), "version": lambda item: item[1] or "not installed"},
            folded=True,
        ),
    ]
    return Section(
        "How it was made",
        "The same settings and inputs give the same result.",
        tables=[facts, *tables] if facts.rows else tables,
        code=yaml.safe_dump(settings, sort_keys=False, allow_unicode=True),
    )


def _flat(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested settings by dotted names."""
    found: dict[str, Any] = {}
    for key, value in settings.items():
        is_group = isinstance(value, Mapping) and value
        found |= _flat(value, f"{prefix}{key}.") if is_group else {f"{prefix}{key}": value}
    return found


def write_page(page: Page, directory: str | Path, files: AtomicFiles | None = None) -> Path:
    """Write ``report.html`` and its pictures in the same folder, all or none.

    Pictures of an earlier report there that this one does not replace go.

    Args:
        page: its pictures are in the page and, numbered, in the folder, there also in the forms
            of the settings: ``svg``, ``pdf``.
        directory: made when it is missing; older files of the same names are replaced.

    Returns:
        The path of the page.

    Raises:
        SlamFusionError: the directory cannot be written; one line with the reason.
    """
    directory = Path(directory)
    sections = [*page.sections, _circumstances(page)]
    pictures = [picture for section in sections for picture in section.pictures]
    # Each is a file name everywhere and no path anywhere.
    stems = [_STEM.sub("-", picture.stem).strip("-")[:_STEM_LENGTH] for picture in pictures]
    names = {
        picture: f"{number:02d}-{stem or 'picture'}.png"
        for number, (picture, stem) in enumerate(zip(pictures, stems, strict=True), start=1)
    }
    has_layers = any(section.layers and section.layers.recorded for section in sections)
    path = directory / "report.html"
    earlier = set(directory.glob("[0-9][0-9]-*.*")) if path.exists() else set()
    written = {
        (directory / name).with_suffix(f".{form}"): data
        for picture, name in names.items()
        for form, data in (
            ("png", picture.png),
            *((form, to_form(picture.figure, form)) for form in page.config.report.pictures),
        )
    }
    html = _html(page=page, sections=sections, names=names, script=_script(is_used=has_layers))
    with contextlib.nullcontext(files) if files is not None else AtomicFiles() as whole:
        for picture_path, data in written.items():
            whole.add(picture_path, data)
        whole.add(path, html.encode("utf-8", errors="replace"))
        for picture_path in sorted(earlier - written.keys()):
            if picture_path.suffix.removeprefix(".") in PICTURE_FORMS:
                whole.remove(picture_path)
    return path


def _script(*, is_used: bool) -> dict[str, str]:
    """Return the front end of the maps and its digest; the page's policy allows no other script."""
    if not is_used:
        return {}
    text = bundled(_own_file("report.js"))
    digest = hashlib.sha256(text.encode()).digest()
    return {"text": Markup(text), "sha256": base64.b64encode(digest).decode("ascii")}  # noqa: S704


def _html(**values: Any) -> str:
    """Fill the one template; every value in it is escaped."""
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    shared = front_end()
    ours = {
        "css": shared["viewer.css"] + _own_file("report.css"),
        "stage": shared["stage.html"],
        "switches": shared["layers.html"],
    }
    # Our own files, no values of the user's: the only texts that are not escaped, but for the
    # recorded layers, which contain no tag.
    own = {name: Markup(text) for name, text in ours.items()}  # noqa: S704
    now = dt.datetime.now(dt.timezone.utc).strftime("%Y-%m-%d %H:%M UTC")
    template = environment.from_string(_own_file("report.html.j2"))
    return template.render(**values, **own, cards=CARDS, made_at=now, version=__version__)


def _own_file(name: str) -> str:
    """Return the text of a file of the templates."""
    folder = importlib.resources.files("slamfusion.report") / "templates"
    return (folder / name).read_text(encoding="utf-8")
