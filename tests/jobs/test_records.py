"""The schema of the JSON documents: made of the types, published, and strict."""

from __future__ import annotations

import json
from typing import Any

import click
import numpy as np
import pytest
from jsonschema import Draft202012Validator, ValidationError

from slamfusion.align.records import Alignment, RunnerUp
from slamfusion.cli.main import main
from slamfusion.cli.program import cli
from slamfusion.config import RunConfig
from slamfusion.errors import counted
from slamfusion.evaluation.measured import measure_trajectory
from slamfusion.geometry import Pose2
from slamfusion.jobs.align import AlignDocument
from slamfusion.jobs.records import Circumstances, load_schema, number
from slamfusion.json_values import plain
from slamfusion.slam.registry import BUILT_IN
from slamfusion.trajectory import Trajectory
from tests.support import make_schema
from tests.support.documents import check_document


def test_numbers_are_words_that_people_write() -> None:
    assert [number(value, 2) for value in (-1e-9, -0.006, 1.005, 2, None)] == [
        *("0.00", "-0.01", "1.00", "2.00", "-")
    ]
    assert [counted(count, "pose") for count in range(3)] == ["0 poses", "1 pose", "2 poses"]
    assert [counted(count, "scan", "are") for count in (1, 2)] == ["1 scan is", "2 scans are"]
    assert counted(1, "node", "listen") == "1 node listens"


MAKE = "python -m tests.support.make_schema"


def aligned() -> dict[str, Any]:
    """What ``align`` prints, as JSON has it."""
    place = Pose2(1.0, -2.0, 0.5)
    found = Alignment(
        reference="one", moving="other", accepted=True, reason="fits", transform=place, score=0.9,
        overlap=0.8, error=12.0, runner_up=RunnerUp(place, 0.3, 0.4), time_s=0.1,
        statistics={"z": 9.0},
    )  # fmt: skip
    return plain(AlignDocument(found, Circumstances("numpy", RunConfig()), 0.05))


@pytest.mark.once
def test_the_schema_is_what_the_types_say() -> None:
    assert json.loads(make_schema.PATH.read_text(encoding="utf-8")) == make_schema.make_schema(), (
        f"the types of the JSON documents have changed; run {MAKE}"
    )


def test_the_schema_is_one_of_the_dialect_that_it_names() -> None:
    schema = load_schema()
    assert schema["$schema"] == Draft202012Validator.META_SCHEMA["$id"]
    Draft202012Validator.check_schema(schema)


def commands_with_json(group: click.Group, *words: str) -> set[str]:
    """The words of every command that has ``--json``; the producers of ``slam`` print the same."""
    found: set[str] = set()
    context = click.Context(group)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        if isinstance(command, click.Group) and name != "slam":
            found |= commands_with_json(command, *words, name)
            continue
        leaf: click.Command | None = command
        if isinstance(command, click.Group):
            leaf = command.get_command(click.Context(command), BUILT_IN[0])
        if any("--json" in parameter.opts for parameter in leaf.params):
            found.add(" ".join((*words, name)))
    return found


def test_every_command_that_prints_json_has_an_entry() -> None:
    wanted = commands_with_json(cli)
    assert wanted == set(make_schema.DOCUMENTS)
    entries = {entry["$ref"].rpartition("/")[2] for entry in load_schema()["anyOf"]}
    assert entries == {command.replace(" ", "-") for command in wanted}


def test_every_key_says_what_it_is() -> None:
    records = {name: item for name, item in load_schema()["$defs"].items() if "properties" in item}
    assert len(records) > 50
    for name, record in records.items():
        assert record["description"], name
        assert all(key["description"].endswith(".") for key in record["properties"].values()), name


def test_a_right_document_passes() -> None:
    check_document(aligned(), "align")
    Draft202012Validator(load_schema("align")).validate(aligned())
    Draft202012Validator(load_schema()).validate(aligned())
    with pytest.raises(AssertionError, match=r"'accepted'.* were unexpected"):
        check_document(aligned(), "fuse")
    with pytest.raises(ValidationError):
        Draft202012Validator(load_schema("fuse")).validate(aligned())


@pytest.mark.parametrize("key", sorted(aligned()))
def test_a_missing_key_is_refused(key: str) -> None:
    document = aligned()
    del document[key]
    with pytest.raises(AssertionError, match=f"'{key}' is a required property"):
        check_document(document, "align")


def test_an_error_alone_is_for_a_failure() -> None:
    check_document({"error": "no"}, "align", failed=True)
    with pytest.raises(AssertionError, match="exit code 0"):
        check_document({"error": "no"}, "align")
    with pytest.raises(AssertionError):
        check_document({"error": None}, "align", failed=True)


def test_errors_of_a_path_come_all_or_none() -> None:
    path = Trajectory(np.arange(3.0), np.zeros((3, 3)), "still")
    measured = plain(measure_trajectory(path, RunConfig().trajectory, truth=path))
    check_document(measured, "PathErrors")
    check_document({}, "PathErrors")
    for key in measured:
        part = {other: value for other, value in measured.items() if other != key}
        with pytest.raises(AssertionError, match="is a dependency of"):
            check_document(part, "PathErrors")


LIVE = ("status", "watch", "save", "reset")
FAILURES: dict[str, tuple[str, ...]] = {
    "run": ("run", "absent.log", "-o", "out"),
    "fuse": ("fuse", "absent.yaml", "other.yaml", "-o", "out"),
    "align": ("align", "absent.yaml", "other.yaml"),
    "evaluate": ("evaluate", "absent.yaml", "--truth", "other.yaml"),
    "simulate": ("simulate", "absent.yaml", "-o", "out"),
    "experiment cell-models": ("experiment", "cell-models", "-o", "file"),
    "experiment occupancy-estimator": (
        *("experiment", "occupancy-estimator", "--floors", "0"),
        *("--log", "absent.log", "-o", "out", "--device", "numpy"),
    ),
    "experiment cell-models-trajectories": (
        *("experiment", "cell-models-trajectories", "--floors", "0"),
        *("--log", "absent.log:absent.relations", "-o", "out", "--device", "numpy"),
    ),
    "experiment ground-obstacle": ("experiment", "ground-obstacle", "-o", "file"),
    "experiment failures": ("experiment", "failures", "-o", "file"),
    "experiment real-logs": ("experiment", "real-logs", "--datasets", "absent", "-o", "out"),
    "slam": ("slam", "tinyslam", "absent.log", "-o", "out", "--device", "numpy"),
    "trajectory": ("trajectory", "absent.tum", "--truth", "other.tum"),
    "judge": ("judge", "absent.log", "absent.tum", "--device", "numpy"),
    "compare": ("compare", "absent.zip", "other.zip"),
    "graph optimize": ("graph", "optimize", "absent.g2o"),
    "show": ("show", "absent"),
    "info": ("info", "absent"),
    # There is no such node, or no ROS.
    **{f"live {name}": ("live", name, "--timeout", "0.1") for name in LIVE},
    "live set": ("live", "set", "max_publish_rate_hz", "1.0", "--timeout", "0.1"),
    "live add": ("live", "add", "robot", "--timeout", "0.1"),
    "live remove": ("live", "remove", "robot", "--timeout", "0.1"),
}


def test_every_command_but_the_lists_can_fail() -> None:
    assert set(FAILURES) | {"devices", "doctor"} == set(make_schema.DOCUMENTS)


@pytest.mark.parametrize("command", FAILURES)
def test_a_failure_is_a_document_too(
    command: str,
    tmp_path_factory: pytest.TempPathFactory,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    folder = tmp_path_factory.mktemp("empty")
    (folder / "file").write_text("no folder", encoding="utf-8")
    monkeypatch.chdir(folder)
    with pytest.raises(SystemExit) as ended:
        main([*FAILURES[command], "--json"])
    assert ended.value.code == 1
    document = json.loads(capsys.readouterr().out)
    assert set(document) == {"error"}
    check_document(document, command, failed=True)
