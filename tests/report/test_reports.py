"""What stands in the reports, and that nothing in a name or a folder can break them."""

from __future__ import annotations

import base64
import hashlib
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest

from slamfusion.config import PICTURE_FORMS, ReportConfig, RunConfig
from slamfusion.errors import AlignmentError, SlamFusionError
from slamfusion.jobs.evaluate import write_evaluation
from slamfusion.jobs.fuse import FusedMaps, write_failed_fusion, write_fusion_report
from slamfusion.slam.registry import with_producers, with_settings
from tests.report.drawn import (
    NASTY,
    REASON,
    alignment,
    colours_of,
    evaluation,
    evaluations,
    explains,
    fusion,
    room,
)

pytestmark = pytest.mark.once

CONFIG = RunConfig()


class PageReader(HTMLParser):
    """Collects the text, the tags, the addresses and the scripts, by type, of a page."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.sources: list[str] = []
        self.links: list[str] = []
        self.targets: set[str] = set()
        self.scripts: dict[str, str] = {}
        self.policy = ""
        self.text = ""
        self._script = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        if tag == "script":
            self._script = dict(attrs).get("type") or "classic"
            assert self._script not in self.scripts
        if tag == "meta" and ("http-equiv", "Content-Security-Policy") in attrs:
            self.policy = dict(attrs)["content"] or ""
        for key, value in attrs:
            assert not key.startswith("on"), f"{tag} has a handler {key}"
            if key in {"src", "srcset", "data", "action", "poster"}:
                self.sources.append(value or "")
            if key == "alt":
                self.text += f" {value} "
            if key == "href":
                self.links.append(value or "")
            if key == "id":
                assert value not in self.targets, f"two elements are called {value}"
                self.targets.add(value or "")

    def handle_endtag(self, tag: str) -> None:
        if tag == "script":
            self._script = ""

    def handle_data(self, data: str) -> None:
        if self._script:
            self.scripts[self._script] = self.scripts.get(self._script, "") + data
        else:
            self.text += data


def read(path: Path) -> PageReader:
    page = PageReader()
    page.feed(path.read_text(encoding="utf-8"))
    page.text = " ".join(page.text.split())
    return page


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One report with everything in it, to read only."""
    folder = tmp_path_factory.mktemp("report")
    return write_fusion_report(FusedMaps(CONFIG, fusion(), None, tuple(evaluations())), folder)


def test_the_headline_names_the_fused_and_the_rejected_with_the_reason(report: Path) -> None:
    page = read(report)
    assert "Only 3 of 4 maps were fused" in page.text
    assert f"{NASTY} was rejected: {REASON}" in page.text
    assert "Fused: room 0, room 1, room 2; in the frame of room 0." in page.text
    assert page.text.index("Only 3 of 4") < page.text.index("Agreement")


def test_a_failure_a_weak_match_and_changed_settings_are_told(report: Path, tmp_path: Path) -> None:
    result = fusion()
    shares = {"room 1": 0.47, "room 2": 0.8}
    records = tuple(
        record
        if record.alignment is None
        else replace(
            record, alignment=replace(record.alignment, evidence=explains(shares[record.name]))
        )
        for record in result.accepted
    )
    found = tuple(record.alignment for record in records if record.alignment is not None)
    weak = replace(result, inputs=records, pairs=found)
    config = with_settings(with_producers(CONFIG), "graph", resolution=0.07)
    page = read(write_fusion_report(FusedMaps(config, weak, None), tmp_path, "it may not"))
    assert page.text.index("Do not use this map") < page.text.index("it may not")
    assert page.text.index("it may not") < page.text.index("Fused:")
    assert "accepted: weak" in page.text
    assert "accepted: fair" in page.text
    assert "accepted: strong" in read(report).text
    assert "room 1 may not belong here: fits" in page.text
    assert page.text.count("may not belong here") == 1
    assert "may not belong here" not in read(report).text
    changed = page.text.partition("Settings that differ from the defaults")[2].partition("Versions")
    assert changed[0].split() == ["settingvalue", "producers.graph.resolution0.07"]


def test_every_part_of_the_fusion_is_shown(report: Path) -> None:
    page = read(report)
    for part in (
        "Fused map",
        "The aligned inputs over each other",
        "Agreement",
        "room 1, aligned",
        "Error against the truth",
        "Alignment to room 0",
        "phantom cells",
        "weight",
        "doubled walls",
        "occupied_percent: 65.0",
        "pyopencl",
        "numpy",
    ):
        assert part in page.text, part


def check_scripts(page: PageReader) -> None:
    """Hold a page with layers to one script, which its policy knows, and one of mere data."""
    assert set(page.scripts) == {"application/json", "module"}
    digest = hashlib.sha256(page.scripts["module"].encode()).digest()
    assert f"script-src 'sha256-{base64.b64encode(digest).decode()}'" in page.policy
    assert page.policy.startswith("default-src 'none'; ")
    assert "unsafe" not in page.policy.partition("script-src")[2]


def test_names_are_escaped_and_run_nothing(report: Path) -> None:
    page = read(report)
    check_scripts(page)
    assert "more" not in page.tags
    assert "<script>" not in report.read_text(encoding="utf-8")


def test_the_page_loads_nothing_from_anywhere(report: Path) -> None:
    page = read(report)
    assert page.sources
    assert all(source.startswith("data:image/png;base64,") for source in page.sources)
    assert not {"link", "iframe", "object", "embed", "base", "form"} & set(page.tags)
    css = re.search(r"<style>(.*?)</style>", report.read_text(), re.DOTALL)
    assert "url(" not in css[1]
    assert "@import" not in css[1]


def test_every_link_leads_to_a_part_of_the_page_or_a_picture_beside_it(report: Path) -> None:
    page = read(report)
    for link in page.links:
        if link.startswith("#"):
            assert link[1:] in page.targets
        else:
            assert (report.parent / link).is_file()


def test_pictures_beside_the_page_are_those_in_it_with_safe_names(report: Path) -> None:
    page = read(report)
    files = sorted(report.parent.glob("*.png"))
    assert sorted(path.name for path in report.parent.iterdir()) == [
        *(path.name for path in files),
        "report.html",
    ]
    assert all(re.fullmatch(r"\d\d-[A-Za-z0-9_-]+\.png", path.name) for path in files)
    embedded = [base64.b64decode(source.split(",", 1)[1]) for source in page.sources]
    assert embedded == [path.read_bytes() for path in files]
    for path in files:
        image = cv2.imread(str(path), cv2.IMREAD_COLOR)
        assert len(colours_of(image)) > 3


def test_a_failed_fusion_shows_each_map_and_each_pair(tmp_path: Path) -> None:
    pairs = (alignment("left", NASTY, accepted=False),)
    error = AlignmentError("left and right do not fit", pairs)
    error.grids = (room("left", 1), room(NASTY, 2))
    page = read(write_failed_fusion(error, CONFIG, tmp_path, device=""))
    assert "Nothing was fused left and right do not fit" in page.text
    assert f"{NASTY} on left" in page.text
    # Without layers there is no script.
    assert "script" not in page.tags
    assert "script-src" not in page.policy
    assert len(list(tmp_path.glob("*.png"))) == 4  # two maps, one pair, one curve


def test_an_evaluation_report_names_the_nearest_map_and_the_lost_one(tmp_path: Path) -> None:
    lost = alignment("truth", "room 0", accepted=False)
    empty = replace(room("empty", 1), cells=np.zeros((40, 60), dtype=np.int8))
    write_evaluation([*evaluations(lost), evaluation(empty)], tmp_path, CONFIG)
    page = read(tmp_path / "report.html")
    assert "fused is nearest to truth" in page.text
    assert "not aligned: room 0:" in page.text
    assert "not aligned" in page.text
    # What is not defined, as of a map without walls, is a dash.
    assert not re.search(r"\b(nan|inf|None)\b", page.text)


def test_a_place_that_cannot_be_written_is_one_clear_line(tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("")
    with pytest.raises(SlamFusionError) as caught:
        write_evaluation(evaluations()[:1], blocked / "report", CONFIG)
    assert str(blocked) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == [blocked]


def test_pictures_are_also_had_as_svg_and_pdf_the_same_bytes_each_time(tmp_path: Path) -> None:
    config = replace(CONFIG, report=ReportConfig(("svg", "pdf")))
    write_evaluation(evaluations()[:1], tmp_path, config)
    first = {path.name: path.read_bytes() for path in tmp_path.glob("0*")}
    stems = {Path(name).stem for name in first}
    assert first.keys() == {f"{stem}.{form}" for stem in stems for form in PICTURE_FORMS}
    for name, data in first.items():
        assert data.startswith({".png": b"\x89PNG", ".svg": b"<?xml", ".pdf": b"%PDF"}[name[-4:]])
    # Title, legend and axes stand in the picture itself.
    text = first["01-difference-room-0.svg"].decode()
    assert all(words in text for words in ("room 0 against truth", "missing wall", "x [m]"))
    write_evaluation(evaluations()[:1], tmp_path, config)
    assert first == {path.name: path.read_bytes() for path in tmp_path.glob("0*")}
    # A report without them leaves none of an earlier one, and what is no part of one.
    (tmp_path / "01-mine.svg").touch()
    write_evaluation(evaluations()[:1], tmp_path, CONFIG)
    names = {path.name for path in tmp_path.iterdir() if path.suffix not in {".png", ".html"}}
    assert names == {"01-mine.svg"}
