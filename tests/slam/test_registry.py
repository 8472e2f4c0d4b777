"""The registry of producers: names, settings, what a package of its own adds."""

from __future__ import annotations

import importlib.metadata
import sys
import types
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from slamfusion.compute import NumpyDevice
from slamfusion.config import GraphConfig, RunConfig
from slamfusion.errors import ConfigError, SlamFusionError
from slamfusion.slam import registry
from slamfusion.slam.common.runner import Resumable
from slamfusion.slam.registry import (
    BUILT_IN,
    ENTRY_POINTS,
    Producer,
    load_config,
    loop_closers,
    make_producer,
    producer,
    producer_names,
    resume_producer,
    settings_of,
    with_producers,
    with_settings,
)

MODULE = "a_package_with_producers"


@pytest.fixture
def offered(monkeypatch: pytest.MonkeyPatch) -> Iterator[types.ModuleType]:
    """A module whose attributes are offered as producers by entry points of their names."""
    module = types.ModuleType(MODULE)
    monkeypatch.setitem(sys.modules, MODULE, module)

    def entry_points(group: str) -> list[importlib.metadata.EntryPoint]:
        assert group == ENTRY_POINTS
        names = [name for name in vars(module) if not name.startswith("__")]
        places = {name: f"{MODULE}:{name}" for name in names} | {"gone": "no_such_package:X"}
        return [importlib.metadata.EntryPoint(name, at, group) for name, at in places.items()]

    monkeypatch.setattr(importlib.metadata, "entry_points", entry_points)
    registry.other_producers.cache_clear()
    yield module
    registry.other_producers.cache_clear()


def a_producer(name: str, **others: Any) -> Producer:
    return Producer(name, "draws nothing", GraphConfig(), lambda *_: NumpyDevice(), **others)


def test_what_is_built_in_makes_mappers_of_its_name_and_resumes_where_it_says_so() -> None:
    for name in BUILT_IN:
        record = producer(name)
        made = make_producer(name, RunConfig(), NumpyDevice())
        assert (record.name, made.name) == (name, name)
        assert isinstance(made, Resumable) == (record.load is not None)
        assert record.cost > 0.0
        assert record.map_interval_s(record.config) > 0.0


def test_one_producer_closes_loops() -> None:
    assert loop_closers((*BUILT_IN, "a saved map")) == ("graph",)


def test_a_producer_that_cannot_go_on_is_named(tmp_path: Path) -> None:
    with pytest.raises(SlamFusionError, match="tinyslam cannot go on from a saved state"):
        resume_producer("tinyslam", tmp_path / "state", RunConfig(), NumpyDevice())


def test_an_unknown_producer_is_named() -> None:
    with pytest.raises(SlamFusionError, match=r"'hector'.*tinyslam"):
        make_producer("hector", RunConfig(), NumpyDevice())


def test_another_package_adds_a_producer_by_name(offered: types.ModuleType) -> None:
    vars(offered)["karto"] = a_producer("karto", closes_loops=True)
    assert producer_names() == (*BUILT_IN, "gone", "karto")
    assert producer("karto").summary == "draws nothing"
    assert loop_closers(["karto", "gmapping"]) == ("karto",)
    assert isinstance(settings_of(RunConfig(), "karto"), GraphConfig)


@pytest.mark.parametrize(
    ("name", "offer", "words"),
    [
        ("gone", None, "the producer 'gone' cannot be loaded from no_such_package:X"),
        ("text", "text", "the entry point 'text' must name a Producer of this name, found 'text'"),
        ("other", a_producer("karto"), "found one called 'karto'"),
    ],
)
def test_what_offers_no_producer_is_named(
    offered: types.ModuleType, name: str, offer: Any, words: str
) -> None:
    vars(offered)[name] = offer
    with pytest.raises(SlamFusionError, match=words):
        producer(name)


def test_no_package_takes_the_name_of_one_that_is_built_in(
    offered: types.ModuleType, caplog: pytest.LogCaptureFixture
) -> None:
    vars(offered)["graph"] = a_producer("graph")
    assert producer_names() == (*BUILT_IN, "gone")
    assert producer("graph").summary != "draws nothing"
    assert "the producer 'graph' of a_package_with_producers:graph is not used" in caplog.text


def test_settings_are_those_of_the_configuration_or_the_defaults() -> None:
    config = with_settings(RunConfig(), "graph", resolution=0.1)
    assert settings_of(config, "graph").resolution == 0.1
    assert settings_of(config, "gmapping") == producer("gmapping").config
    whole = with_producers(config, ["graph", "tinyslam"])
    assert list(whole.producers) == ["graph", "tinyslam"]
    assert asdict(whole)["producers"]["graph"]["resolution"] == 0.1


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "run.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def test_settings_at_the_top_of_a_file_are_read_with_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    config = load_config(written(tmp_path, "graph: {resolution: 0.2}\n"))
    assert settings_of(config, "graph").resolution == 0.2
    assert "settings of graph stand under 'producers:' from now on" in caplog.text


def test_a_file_sets_producers_by_name(tmp_path: Path) -> None:
    text = "seed: 4\nproducers: {graph: {matcher: {jump_m: 9.0}}, tinyslam: }\n"
    config = load_config(written(tmp_path, text))
    assert config.seed == 4
    assert settings_of(config, "graph").matcher.jump_m == 9.0
    assert settings_of(config, "graph").matcher.beams == GraphConfig().matcher.beams
    assert settings_of(config, "tinyslam") == producer("tinyslam").config


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("producers: {hector: {a: 1}}", "producers: the SLAM 'hector' is not one of tinyslam"),
        ("producers: [graph]", "producers: wanted a mapping of names to settings, found list"),
        ("producers: {graph: {beams: 1}}", "producers: graph: unknown key 'beams'"),
        (
            "producers: {graph: {resolution: 9}}",
            r"graph: resolution: must lie in \[0.005, 1\] m, found 9",
        ),
        ("[1, 2]", "wanted a mapping of settings, found list"),
        ("a: [", "not YAML"),
    ],
)
def test_a_bad_file_is_named_with_what_was_wanted(tmp_path: Path, text: str, words: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(ConfigError, match=words) as caught:
        load_config(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["", "a b", "a-b", "_a", "2d", "é", "a/b"])
def test_a_name_is_one_of_a_topic_too(name: str) -> None:
    with pytest.raises(ValueError, match="letters, digits and underscores"):
        a_producer(name)
