"""Make ``slamfusion/jobs/schema.json`` of the types of the JSON documents.

Run in the root of the repository, after a change to a type or its text::

    python -m tests.support.make_schema

The types are dataclasses and TypedDicts. pydantic turns copies of them into JSON Schema: the texts
below the keys, which Python does not keep, become descriptions in these, and other keys are
refused.
"""

from __future__ import annotations

import ast
import inspect
import json
import sys
import typing
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from functools import cache, reduce
from operator import or_
from pathlib import Path
from types import UnionType
from typing import Annotated, Any

import typing_extensions
from pydantic import Field, TypeAdapter
from pydantic.json_schema import GenerateJsonSchema

from slamfusion.config import RunConfig
from slamfusion.evaluation.relations import RelationErrors
from slamfusion.evaluation.trajectory_error import TrajectoryErrors
from slamfusion.experiments.page import ExperimentDocument
from slamfusion.jobs import (
    align,
    doctor,
    evaluate,
    fuse_documents,
    graph,
    judge,
    map_log,
    records,
    run_files,
    run_many,
    simulate,
    trajectory,
)
from slamfusion.jobs import compare as comparisons
from slamfusion.jobs.info import InfoDocument
from slamfusion.jobs.records import FailureDocument
from slamfusion.json_values import POSE_KEYS, printed_names
from slamfusion.slam.common.mapper import Health
from slamfusion.slam.gmapping.slam import FilterHealth
from slamfusion.slam.graph.map_graph import GraphHealth

PATH = Path(__file__).resolve().parents[2] / "slamfusion" / "jobs" / "schema.json"
DIALECT = "https://json-schema.org/draft/2020-12/schema"

# What each command may print; after a failure, any of them prints a ``FailureDocument`` alone.
DOCUMENTS: dict[str, tuple[type, ...]] = {
    "run": (run_files.LogRun, run_many.RunsDocument),
    "fuse": (fuse_documents.FuseDocument,),
    "align": (align.AlignDocument,),
    "evaluate": (evaluate.EvaluatedMaps,),
    "simulate": (simulate.SimulatedDrive,),
    "experiment cell-models": (ExperimentDocument,),
    "experiment occupancy-estimator": (ExperimentDocument,),
    "experiment cell-models-trajectories": (ExperimentDocument,),
    "experiment ground-obstacle": (ExperimentDocument,),
    "experiment failures": (ExperimentDocument,),
    "experiment real-logs": (ExperimentDocument,),
    "slam": (map_log.MappedLog,),
    "trajectory": (trajectory.TrajectoryDocument, trajectory.TrajectoriesDocument),
    "judge": (judge.JudgeDocument, judge.JudgementsDocument),
    "info": (InfoDocument,),
    "compare": (comparisons.ComparedResults,),
    "graph optimize": (graph.OptimizedGraph,),
    "devices": (doctor.DevicesDocument,),
    "show": (records.ShowDocument,),
    "live status": (records.LiveStatusDocument,),
    "live watch": (records.LiveLineJson,),
    "live save": (records.LiveAnswerDocument,),
    "live reset": (records.LiveAnswerDocument,),
    "live set": (records.LiveAnswerDocument,),
    "live add": (records.LiveAnswerDocument,),
    "live remove": (records.LiveAnswerDocument,),
    "doctor": (doctor.DoctorDocument,),
}
# Written to files alone.
WRITTEN = (run_files.RunRecord,)
# A producer of another package may say more of itself. The keys that our own ones add:
OPEN = (Health,)
ADDED: dict[type, tuple[tuple[type, str, str], ...]] = {
    Health: (
        (FilterHealth, "Filter", "Of a producer with a particle filter."),
        (GraphHealth, "Graph", "Of a producer with a pose graph."),
    )
}
_FORMS: tuple[Any, ...] = (Annotated, typing_extensions.NotRequired, typing_extensions.TypedDict)
# Of these keys a measured path has all or none.
TOGETHER = (
    frozenset(field.name for field in fields(TrajectoryErrors) if field.repr),
    frozenset(field.name for field in fields(RelationErrors) if field.repr)
    | {"odometry", "at_scans"},
)


class _WithoutTitles(GenerateJsonSchema):
    """pydantic's generator, without a title for each key that repeats its name."""

    def field_title_should_be_set(self, schema: Any) -> bool:  # noqa: ARG002
        return False


def make_schema() -> dict[str, Any]:
    """Return the schema of all documents."""
    asked = {
        kind: TypeAdapter(described(kind))
        for kinds in (*DOCUMENTS.values(), (FailureDocument, *WRITTEN))
        for kind in kinds
    }
    _, made = TypeAdapter.json_schemas(
        [(kind.__name__, "serialization", adapter) for kind, adapter in asked.items()],
        schema_generator=_WithoutTitles,
    )
    found = made["$defs"]
    for record in found.values():
        _keep_together(record)
        _shorten(record)
    commands = {command.replace(" ", "-"): kinds for command, kinds in DOCUMENTS.items()}
    return {
        "$schema": DIALECT,
        "title": "JSON documents of slamfusion",
        "description": "What the commands print with --json; $defs has an entry for each command.",
        "anyOf": [_reference(name) for name in commands],
        "$defs": {
            **{
                name: {
                    "description": f"What slamfusion {command} prints with --json.",
                    "anyOf": [_reference(_name(kind)) for kind in (*kinds, FailureDocument)],
                }
                for (name, kinds), command in zip(commands.items(), DOCUMENTS, strict=True)
            },
            **dict(sorted(found.items())),
        },
    }


def to_text(schema: Mapping[str, Any]) -> str:
    """Return a schema as the file has it."""
    return json.dumps(schema, indent=1, ensure_ascii=False) + "\n"


def _reference(name: str) -> dict[str, str]:
    return {"$ref": f"#/$defs/{name}"}


def _name(kind: type) -> str:
    """Return what a record is called in the schema: ``Alignment`` for ``AlignmentJson``."""
    return kind.__name__.removesuffix("Json")


def _keep_together(record: dict[str, Any]) -> None:
    """Say which optional keys come together."""
    properties, required = record.get("properties", {}), set(record.get("required", ()))
    if not properties.keys() >= frozenset.union(*TOGETHER):
        return
    shared = frozenset.intersection(*TOGETHER)
    record["dependentRequired"] = {
        key: sorted(group - required - {key})
        for group in TOGETHER
        for key in sorted(group - shared - required)
    }


def _shorten(schema: Any) -> None:
    """Write ``anyOf`` of plain types as a list of types, wherever it stands."""
    if isinstance(schema, list):
        for item in schema:
            _shorten(item)
    if not isinstance(schema, dict):
        return
    for item in schema.values():
        _shorten(item)
    choices = schema.get("anyOf", ())
    if choices and all(isinstance(choice, dict) and set(choice) == {"type"} for choice in choices):
        del schema["anyOf"]
        schema["type"] = [choice["type"] for choice in choices]


@cache
def described(kind: type) -> Any:
    """Return a TypedDict with the keys of a record; they have their texts and admit no others.

    Raises:
        ValueError: a key has no text.
    """
    required = _required(kind)
    # Types that are made as the program runs are no types to a checker.
    annotated, not_required, typed_dict = _FORMS
    keys = {}
    for key, (hint, text) in _keys(kind).items():
        if not text:
            raise ValueError(f"{kind.__name__}.{key} has no text below it")
        field = annotated[_copied(hint), Field(description=text)]
        keys[key] = field if key in required else not_required[field]
    for own, name, text in ADDED.get(kind, ()):
        added = {
            key: annotated[_copied(hint), Field(description=words)]
            for key, (hint, words) in _keys(own).items()
            if key not in keys
        }
        record = _closed(typed_dict(name, added), own)
        keys[name.lower()] = not_required[annotated[record, Field(description=text)]]
    return _closed(typed_dict(_name(kind), keys), kind)


def _closed(copy: Any, kind: type) -> Any:
    """Return a copy of a record with its text, that admits no other keys than it has."""
    copy.__doc__ = (inspect.getdoc(kind) or "").replace("``", "`")
    copy.__pydantic_config__ = {"extra": "allow" if kind in OPEN else "forbid"}
    return copy


def _required(kind: Any) -> frozenset[str]:
    """Return the keys that a record always has."""
    if not is_dataclass(kind := _keys_of(kind)):
        return frozenset(getattr(kind, "__required_keys__", ()))
    hints = _hints(kind)
    found: set[str] = set()
    for item in fields(kind):
        how = item.metadata
        if "kind" in how:
            found.update(printed_names(how["kind"]))
        elif "flat" in how:
            found |= _required(hints[item.name])
        elif "pose" in how:
            found.update(POSE_KEYS)
        elif item.repr and "with" not in how:
            found.add(how.get("key", item.name))
    return frozenset(found)


def _hints(kind: Any) -> dict[str, Any]:
    """Return the types of a record's fields, also where its module only names them to checkers."""
    return typing.get_type_hints(kind, localns={"Evaluation": fuse_documents.Evaluation})


def _copied(hint: Any) -> Any:
    """Return a type with every record in it replaced by its described copy."""
    hint = {Path: str, RunConfig: Mapping[str, Any]}.get(hint) or _keys_of(hint)
    if typing.is_typeddict(hint) or is_dataclass(hint):
        return described(hint)
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is None or origin is typing.Literal:
        return hint
    copies = tuple(map(_copied, arguments))
    return reduce(or_, copies) if origin in {UnionType, typing.Union} else origin[copies]


def _keys_of(hint: Any) -> Any:
    """Return the type of what a record with a method ``to_json`` prints; other types stay."""
    found = getattr(hint, "to_json", None)
    return hint if found is None else _hints(found)["return"]


def _not_none(hint: Any) -> Any:
    """Return the type of the record that a field has, if it has one."""
    return next((own for own in typing.get_args(hint) if own is not type(None)), hint)


def _keys(kind: type) -> dict[str, tuple[Any, str]]:
    """Return type and text of each key of a record, those of its bases too."""
    module = sys.modules[kind.__module__]
    (node,) = ast.parse(inspect.getsource(kind)).body
    assert isinstance(node, ast.ClassDef)
    bases = [getattr(module, base.id) for base in node.bases if isinstance(base, ast.Name)]
    found: dict[str, tuple[Any, str]] = {}
    # TypedDict itself is a function.
    for other in (base for base in bases if isinstance(base, type)):
        found |= _keys(other)
    own = fields(kind) if is_dataclass(kind) else ()
    hidden = {item.name for item in own if not item.repr}
    how = {item.name: item.metadata for item in own}
    texts = {}
    for key, text in zip(node.body, node.body[1:], strict=False):
        if isinstance(key, ast.AnnAssign) and isinstance(text, ast.Expr):
            assert isinstance(key.target, ast.Name)
            assert isinstance(text.value, ast.Constant)
            texts[key.target.id] = " ".join(str(text.value.value).split())
    for key_name, hint in _hints(kind).items():
        if own and key_name not in kind.__annotations__:
            continue  # a field of a base, which is there
        printed: Mapping[str, Any] = how.get(key_name, {})
        words = texts.get(key_name, "Null." if hint is type(None) else "")
        if "flat" in printed:
            keys = _keys(_keys_of(_not_none(hint)))
            if "kind" in printed:
                keys = {key: (one | None, its) for key, (one, its) in keys.items()}
            found |= keys
        elif "pose" in printed:
            place = f"{words.removesuffix('.')}: x, metres."
            place_texts = (place, "Its y, metres.", "Its heading, radians.")
            found |= {key: (float, its) for key, its in zip(POSE_KEYS, place_texts, strict=True)}
        elif key_name not in hidden and (key_name in texts or key_name not in found):
            found[printed.get("key", key_name)] = (hint, words)
    return found


if __name__ == "__main__":
    PATH.write_text(to_text(make_schema()), encoding="utf-8")
    print(f"written: {PATH}")
