"""Claims about the configuration tree."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from slamfusion.config import (
    AlignConfig,
    DeviceConfig,
    EvaluateConfig,
    FailuresConfig,
    FusionConfig,
    FusionNodeConfig,
    GraphConfig,
    LogConfig,
    MatcherConfig,
    NormalizeConfig,
    RunConfig,
    SimulateConfig,
    VoteConfig,
    field_infos,
    from_mapping,
)
from slamfusion.errors import ConfigError
from slamfusion.slam.registry import load_config

LEAVES = [
    AlignConfig,
    DeviceConfig,
    EvaluateConfig,
    FailuresConfig,
    FusionConfig,
    NormalizeConfig,
    RunConfig,
    SimulateConfig,
    VoteConfig,
]


def test_the_defaults_survive_a_round_trip() -> None:
    assert from_mapping(RunConfig, dataclasses.asdict(RunConfig())) == RunConfig()


def test_changed_values_survive_a_yaml_file(tmp_path: Path) -> None:
    values = {
        "fusion": {"align": {"step": 4, "window_m": 2.5}, "vote": {"mode": "majority"}},
        "seed": 7,
    }
    config = from_mapping(RunConfig, values)
    path = tmp_path / "run.yaml"
    path.write_text(yaml.safe_dump(dataclasses.asdict(config)))
    assert load_config(path) == config
    assert (config.fusion.align.step, config.fusion.vote.mode) == (4, "majority")


def test_starts_are_lists_or_texts_of_numbers(tmp_path: Path) -> None:
    path = tmp_path / "run.yaml"
    path.write_text("start: {hall: [1, -2.5, 0], 7: '3, 4, 0.5, 1, 0'}\n")
    config = load_config(path)
    assert config.start == {"hall": (1.0, -2.5, 0.0), "7": (3.0, 4.0, 0.5, 1.0, 0.0)}
    assert from_mapping(RunConfig, dataclasses.asdict(config)) == config
    path.write_text("start:\n")
    assert load_config(path) == RunConfig()


@pytest.mark.parametrize("config_class", LEAVES)
def test_every_field_says_what_it_is(config_class: type[Any]) -> None:
    for info in field_infos(config_class):
        assert info.help, info.name
        assert info.level in {"public", "expert"}


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"sead": 1}, "run.yaml: unknown key 'sead'; the nearest known one is 'seed'"),
        (
            {"fusion": {"align": {"windw_m": 1}}},
            "run.yaml: fusion: align: unknown key 'windw_m'; the nearest known one is 'window_m'",
        ),
        (
            {"stale_after_s": 1.0},
            "run.yaml: unknown key 'stale_after_s'; it stands in a section: live.stale_after_s",
        ),
        ({"seed": -1}, "run.yaml: seed: must lie in [0, inf], found -1"),
        (
            {"experiment": {"failures": {"courses": []}}},
            "run.yaml: experiment: failures: courses: wanted one value at least, found none",
        ),
        ({"seed": 1.5}, "run.yaml: seed: wanted int, found 1.5"),
        ({"seed": True}, "run.yaml: seed: wanted int, found True"),
        ({"fusion": {"align": {"step": "x"}}}, "wanted int or None, found 'x'"),
        ({"fusion": {"align": {"window_yaw_rad": 4.0}}}, "[0, 3.14159] rad, found 4.0"),
        ({"fusion": {"align": {"window_m": float("nan")}}}, "found nan"),
        ({"fusion": {"vote": {"mode": "coin"}}}, "consensus, majority, drawn, found 'coin'"),
        ({"fusion": [1]}, "run.yaml: fusion: wanted a mapping of settings, found list"),
        ([1], "run.yaml: wanted a mapping of settings, found list"),
        (
            {"fusion": {"normalize": {"free_percent": 70}}},
            "free_percent (70) must be below occupied_percent (65); change one of them",
        ),
        ({"start": [1, 2, 3]}, "run.yaml: start: wanted names of inputs with x,y,yaw or"),
        ({"start": {"a": {"x": 1}}}, "run.yaml: start: a: wanted x,y,yaw or x,y,yaw,metres,rad"),
        ({"start": {"a": None}}, "run.yaml: start: a: wanted x,y,yaw or"),
        ({"start": {"a": [1, 2, True]}}, "run.yaml: start: a: wanted x,y,yaw or"),
        ({"start": {"a": [1, 2]}}, "tolerances from 0; found 1,2"),
        ({"start": {"a": "1,2,3,4"}}, "found 1,2,3,4"),
        ({"start": {"a": ""}}, "; found "),
        ({"start": {"a": [1, 2, "north"]}}, "; found 1,2,north"),
        ({"start": {"a": [1, float("inf"), 0]}}, "; found 1,inf,0"),
        ({"start": {"a": [1, 2, 0, 1e999, 1]}}, "; found 1,2,0,inf,1"),
        ({"start": {"a": [1, 2, 0, 1, -0.1]}}, "; found 1,2,0,1,-0.1"),
    ],
)
def test_a_bad_value_is_named_with_what_was_wanted(values: Any, words: str) -> None:
    with pytest.raises(ConfigError) as caught:
        from_mapping(RunConfig(), values, "run.yaml")
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_values_are_checked_at_construction_and_then_frozen() -> None:
    with pytest.raises(ConfigError, match=r"^unknown: must be one of"):
        VoteConfig(unknown="maybe")
    with pytest.raises(dataclasses.FrozenInstanceError):
        RunConfig().seed = 3


def test_a_part_of_a_section_leaves_the_rest_as_the_whole_has_it():
    """A nested section may have other defaults than its class."""
    graph = GraphConfig()
    assert graph.matcher != MatcherConfig()
    config = from_mapping(GraphConfig, {"matcher": {"jump_m": 9.0}})
    assert config.matcher == dataclasses.replace(graph.matcher, jump_m=9.0)
    assert from_mapping(GraphConfig, {"matcher": None}) == graph


@pytest.mark.parametrize("given", ["slip, glass", ["slip", "glass"], ("slip", "glass")])
def test_a_list_is_given_as_one_or_as_text_with_commas(given: Any) -> None:
    assert from_mapping(FailuresConfig, {"courses": given}).courses == ("slip", "glass")


@pytest.mark.parametrize("given", [3, ["slip", 3], {"slip": 1}])
def test_what_is_no_list_of_names_is_refused_with_what_was_wanted(given: Any) -> None:
    with pytest.raises(ConfigError, match="courses: wanted a list of str, found"):
        from_mapping(FailuresConfig, {"courses": given})


def test_fields_tell_their_kind_their_words_and_whether_they_may_be_open() -> None:
    infos = {info.name: info for info in field_infos(SimulateConfig)}
    assert (infos["lidar"].kind, infos["lidar"].is_optional) == (str, True)
    assert infos["lidar"].choices == ("kinect", "hokuyo", "rplidar", "lds01")
    assert (infos["people"].kind, infos["people"].choices) == (int, ())
    lists = {info.name: info for info in field_infos(FailuresConfig)}
    assert (lists["lidars"].is_list, lists["lidars"].choices) == (True, infos["lidar"].choices)


def test_a_bare_no_in_yaml_is_the_choice_no() -> None:
    assert from_mapping(LogConfig, yaml.safe_load("deskew: no")).deskew == "no"
    with pytest.raises(ConfigError, match="laser: wanted as-given or mirrored or backward"):
        from_mapping(LogConfig, yaml.safe_load("laser: no"))


def test_a_number_in_yaml_is_a_text_as_in_the_option() -> None:
    values = yaml.safe_load("{fusion: {reference: 2}, trajectory: {time_offset: -0.5}}")
    config = from_mapping(RunConfig, values)
    assert (config.fusion.reference, config.trajectory.time_offset) == ("2", "-0.5")


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"fused_frame": ""}, "fused_frame: wanted the name of a frame, found ''"),
        ({"odom_frame": "/"}, "odom_frame: wanted the name of a frame, found '/'"),
        ({"discover": "*/map,"}, "discover: no topic can fit ''"),
        ({"discover": "robot 1/map"}, "discover: no topic can fit 'robot 1/map'"),
        ({"discover": "robot*//map"}, "discover: no topic can fit 'robot*//map'"),
        ({"discover": "[ab/map"}, "discover: no topic can fit"),
        ({"discover": "1/map"}, "discover: no topic can fit"),
    ],
)
def test_a_frame_without_a_name_and_a_pattern_that_fits_nothing_are_refused(
    values: dict[str, str], words: str
) -> None:
    with pytest.raises(ConfigError, match=re.escape(words)):
        FusionNodeConfig(**values)
    found = FusionNodeConfig(discover="*/map, /**/map,robot[!12]_?/*")
    assert found.patterns == ("*/map", "/**/map", "robot[!12]_?/*")
