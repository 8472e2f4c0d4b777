"""Which file belongs to which case, and what made it."""

from __future__ import annotations

from pathlib import Path

import pytest

from slamfusion.errors import ConfigError
from slamfusion.jobs.cases import (
    CaseFile,
    case_names,
    files_by_case,
    place_files,
    shared_case_names,
)

CASES = ["intel", "mit-csail", "intel-910"]


def placed(*names: str, cases: list[str] = CASES) -> list[tuple[str, str]]:
    return [(item.case, item.method) for item in place_files(cases, list(map(given, names)))]


def given(text: str) -> CaseFile:
    return CaseFile.parse(text)


@pytest.mark.parametrize(
    ("name", "case", "method"),
    [
        ("graph/intel.tum", "intel", "graph"),
        ("out/intel_graph.tum", "intel", "graph"),
        ("slam_toolbox-mit-csail.tum.gz", "mit-csail", "slam_toolbox"),
        ("runs/Intel/graph.tum", "intel", "graph"),
        ("intel/mit-csail_graph.tum", "mit-csail", "graph"),  # the file's name before the folder's
        ("intel-910.tum", "intel-910", "intel-910"),  # the longer name
        ("intel=a/b.tum", "intel", "b"),
    ],
)
def test_a_name_tells_case_and_method(name: str, case: str, method: str) -> None:
    assert placed(name) == [(case, method)]


@pytest.mark.parametrize(
    ("names", "told"),
    [
        ("graph/seed0/intel.tum graph/seed12/intel.tum", [("graph", "0"), ("graph", "12")]),
        ("graph_intel_s0.tum intel-s1_graph.tum", [("graph", "0"), ("graph", "1")]),
        ("Seed_3/a/intel.tum seed_3/b/intel.tum", [("a", "3"), ("b", "3")]),
        ("intel_s0.tum intel_s1.tum", [("run", "0"), ("run", "1")]),
        ("intel_s.tum intel_seeds2.tum intel_7.tum", [("s", ""), ("seeds2", ""), ("7", "")]),
    ],
)
def test_a_name_tells_the_seed(names: str, told: list[tuple[str, str]]) -> None:
    found = place_files(CASES, list(map(given, names.split())))
    assert [(item.method, item.seed) for item in found] == told
    assert len({item.name for item in found}) == len(found)


@pytest.mark.parametrize("name", ["graph.tum", "intelligent.tum", "intel_mit-csail.tum"])
def test_a_name_that_tells_none_or_two_is_refused(name: str) -> None:
    with pytest.raises(ConfigError, match=f"write CASE={name}"):
        placed(name)
    with pytest.raises(ConfigError, match=r"no case 'freiburg'; wanted one of intel, mit"):
        placed(f"freiburg={name}")


def test_of_one_case_is_everything() -> None:
    assert placed("a.tum", "b/a.tum", cases=["truth"]) == [("truth", "a"), ("truth", "b/a")]


def test_methods_are_named_alike_in_all_cases() -> None:
    names = [f"{case}_{method}/map.yaml" for case in CASES[:2] for method in ("graph", "gmapping")]
    assert placed(*names) == [
        (case, f"{method}/map") for case in CASES[:2] for method in ("graph", "gmapping")
    ]
    assert placed("intel/a.tum", "intel/a.tum") == [("intel", "a"), ("intel", "a#2")]


def test_a_file_with_an_equals_sign_stays_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rate=5.tum").touch()
    assert given("rate=5.tum") == CaseFile(Path("rate=5.tum"))
    assert given("out/rate=6.tum") == CaseFile(Path("out/rate=6.tum"))
    assert given("intel=out/rate=6.tum") == CaseFile(Path("out/rate=6.tum"), "intel")


def test_cases_are_named_by_their_files_once() -> None:
    files = [given("logs/intel.log.gz"), given("office=a.clf")]
    assert case_names(files) == ["intel", "office"]
    with pytest.raises(ConfigError, match=r"2 files of the case 'a'.*NAME=FILE"):
        case_names([given("x/a.log"), given("y/a.log")])
    with pytest.raises(ConfigError, match="cannot name a case"):
        case_names([given("..=a.log"), given("b.log")])


def test_a_case_has_one_file_of_a_kind() -> None:
    files = [given("intel.relations"), given("mit-csail=a.relations")]
    found = files_by_case(CASES, files, "--relations")
    assert found == {"intel": Path("intel.relations"), "mit-csail": Path("a.relations")}
    with pytest.raises(ConfigError, match=r"--relations: .* are both of 'intel'"):
        files_by_case(CASES, [*files, given("b/intel.relations")], "--relations")


@pytest.mark.parametrize(
    ("truths", "relations", "cases"),
    [
        ("a=1.tum b.tum", "", ["a", "b"]),
        ("intel.tum office.tum", "intel=i.relations", ["intel", "office"]),
        ("truth.tum", "a=1.relations b=2.relations", ["a", "b"]),
        ("truth.tum", "a=1.relations", ["a"]),
        ("a=1.tum", "b=2.relations", ["a", "b"]),
        ("intel.tum", "known.relations", ["intel"]),
        ("", "known.relations", ["known"]),
    ],
)
def test_truths_and_relations_name_the_cases_together(
    truths: str, relations: str, cases: list[str]
) -> None:
    kinds = [list(map(given, names.split())) for names in (truths, relations)]
    assert shared_case_names(*kinds) == cases


@pytest.mark.parametrize("kinds", [("..=a.tum", ""), ("a.tum", "..=b.txt"), ("a.tum", ".=b.txt")])
def test_no_case_is_named_so_that_its_folder_is_another(kinds: tuple[str, str]) -> None:
    with pytest.raises(ConfigError, match="cannot name a case; write NAME=FILE"):
        shared_case_names(*(list(map(given, names.split())) for names in kinds))
