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
from operator import itemgetter
from pathlib import Path
from typing import TypeVar

import jinja2
import yaml
from markupsafe import Markup

from slamfusion.config import PICTURE_FORMS, RunConfig, to_mapping
from slamfusion.io.files import AtomicFiles
from slamfusion.palette import Rgb
from slamfusion.report.canvas import in_form
from slamfusion.report.layers import Layers
from slamfusion.version import __version__, version_of, versions
from slamfusion.viewer.front import bundled, front_end

T = TypeVar("T")

_STEM_CHARACTERS = re.compile(r"[^A-Za-z0-9_-]+")
_STEM_LENGTH = 40


@dataclass(frozen=True)
class LegendEntry:
    """One colour of a picture and its meaning."""

    text: str
    rgb: Rgb

    @property
    def css(self) -> str:
        """The colour as CSS."""
        return "rgb({}, {}, {})".format(*self.rgb)


@dataclass(frozen=True)
class Picture:
    """A picture with its caption.

    Attributes:
        stem: start of the file name; anything that is not a plain character is replaced.
        png: the file's bytes.
        title: first line of the caption, also the text for who cannot see the picture.
        caption: what to see in it.
        tone: ``plain``, or framed as ``good`` or ``bad``.
        badge: a word beside the title, e.g. ``rejected``.
        legend: colours used.
    """

    stem: str
    png: bytes
    title: str
    caption: str = ""
    tone: str = "plain"
    badge: str = ""
    legend: tuple[LegendEntry, ...] = ()

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

    @property
    def headings(self) -> list[Cell]:
        """The columns, those of numbers marked."""
        first = self.rows[0] if self.rows else [Cell("")] * len(self.columns)
        return [
            Cell(text, is_number=cell.is_number)
            for text, cell in zip(self.columns, first, strict=True)
        ]

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
            title, note, folded: of the table.
            items: of the rows.
            columns: by heading, what returns the cell of an item: a text, a count, or a ``Cell``.
        """
        rows = [[_cell(value(item)) for value in columns.values()] for item in items]
        return cls(title, tuple(columns), rows, note, folded)


@dataclass(frozen=True)
class Fact:
    """One number of the headline."""

    value: str
    label: str
    tone: str = "plain"


@dataclass(frozen=True)
class Section:
    """A part of the page: text, layers, pictures, tables and preformatted text, in this order.

    One section of a page has layers, no more.
    """

    title: str
    anchor: str
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
    """A whole report, which ends with the settings in effect and the device, in words."""

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


def _cell(value: Cell | str | int) -> Cell:
    """Return a text or a count as a cell."""
    return value if isinstance(value, Cell) else Cell(str(value), is_number=isinstance(value, int))


def _circumstances(config: RunConfig, device: str) -> Section:
    """Return the effective configuration and the versions that a result came from."""
    found = {
        **versions(),
        "matplotlib": version_of("matplotlib"),
        "platform": f"{platform.system()} {platform.machine()}",
        "device": device or "not named",
    }
    return Section(
        "How it was made",
        "circumstances",
        "The effective configuration: with it and the same inputs, the same result comes out.",
        tables=[
            Table.of(
                "Versions",
                found.items(),
                {"what": itemgetter(0), "version": lambda item: item[1] or "not installed"},
            )
        ],
        code=yaml.safe_dump(to_mapping(config), sort_keys=False, allow_unicode=True),
    )


def write_page(page: Page, directory: str | Path, files: AtomicFiles | None = None) -> Path:
    """Write ``report.html`` and the pictures beside it, all or none.

    Pictures of an earlier report there that this one does not replace go.

    Args:
        page: its pictures go into the page and, numbered, beside it, there also as the settings
            say: ``svg``, ``pdf``.
        directory: made when it is missing; older files of the same names are replaced.
        files: the set of files to join; default: one of its own.

    Returns:
        The path of the page.

    Raises:
        SlamFusionError: the directory cannot be written; one line with the reason.
    """
    directory = Path(directory)
    sections = [*page.sections, _circumstances(page.config, page.device)]
    pictures = [picture for section in sections for picture in section.pictures]
    numbers = {id(picture): index for index, picture in enumerate(pictures, start=1)}
    names = {
        id(picture): f"{numbers[id(picture)]:02d}-{_safe_stem(picture.stem)}.png"
        for picture in pictures
    }
    has_layers = any(section.layers and section.layers.recorded for section in sections)
    html = _template().render(
        page=page,
        sections=sections,
        script=_script() if has_layers else "",
        names=names,
        numbers=numbers,
        identity=id,
        made_at=dt.datetime.now(dt.timezone.utc).strftime("%Y-%m-%d %H:%M UTC"),
        version=__version__,
    )
    path = directory / "report.html"
    earlier = set(directory.glob("[0-9][0-9]-*.*")) if path.exists() else set()
    beside = {
        (directory / names[id(picture)]).with_suffix(f".{form}"): in_form(picture.png, form)
        for picture in pictures
        for form in ("png", *page.config.report.pictures)
    }
    with contextlib.nullcontext(files) if files is not None else AtomicFiles() as whole:
        for picture_path, data in beside.items():
            whole.add(picture_path, data)
        whole.add(path, html.encode("utf-8", errors="replace"))
        for picture_path in sorted(earlier - beside.keys()):
            if picture_path.suffix.removeprefix(".") in PICTURE_FORMS:
                whole.remove(picture_path)
    return path


@dataclass(frozen=True)
class _Script:
    """The one script of a page, and what its policy knows it by."""

    text: Markup
    sha256: str


def _script() -> _Script:
    """Return the front end of the maps, which no other script may join."""
    text = bundled(_own_file("report.js"))
    digest = hashlib.sha256(text.encode()).digest()
    return _Script(Markup(text), base64.b64encode(digest).decode("ascii"))  # noqa: S704 - ours


def _template() -> jinja2.Template:
    """Return the one template; every value in it is escaped."""
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
    # recorded layers, in which no tag can begin.
    environment.globals |= {name: Markup(text) for name, text in ours.items()}  # noqa: S704
    return environment.from_string(_own_file("report.html.j2"))


def _own_file(name: str) -> str:
    """Return the text of a file beside the template."""
    folder = importlib.resources.files("slamfusion.report") / "templates"
    return (folder / name).read_text(encoding="utf-8")


def _safe_stem(stem: str) -> str:
    """Return a name that is a file name everywhere and no path anywhere."""
    return _STEM_CHARACTERS.sub("-", stem).strip("-")[:_STEM_LENGTH] or "picture"
