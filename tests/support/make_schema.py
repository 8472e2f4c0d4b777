"""Make ``slamfusion/jobs/schema.json`` of the types of the JSON documents.

Run in the root of the repository, after a change to a type or its text::

    python -m tests.support.make_schema

The types are dataclasses and TypedDicts. The texts below the keys, which Python does not keep,
become descriptions; other keys are refused.
"""

from __future__ import annotations

import ast
import inspect
import json
import sys
import typing
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union

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
PLAIN = {str: "string", int: "integer", float: "number", bool: "boolean", type(None): "null"}
# Of these keys a measured path has all or none.
TOGETHER = (
    frozenset(field.name for field in fields(TrajectoryErrors) if field.repr),
    frozenset(field.name for field in fields(RelationErrors) if field.repr)
    | {"odometry", "at_scans"},
)


def make_schema() -> dict[str, Any]:
    """Return the schema of all documents."""
    found: dict[str, Any] = {}
    for kinds in (*DOCUMENTS.values(), (FailureDocument, *WRITTEN)):
        for kind in kinds:
            add_record(kind, found)
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


def add_record(kind: type, found: dict[str, Any]) -> dict[str, str]:
    """Add a record, and those in it, to those that were found; return the reference to it."""
    name = _name(kind)
    if name not in found:
        found[name] = {}  # below, others may name it
        properties = {key: _property(kind, key, *own, found) for key, own in _keys(kind).items()}
        for own, added, text in ADDED.get(kind, ()):
            keys = {key: one for key, one in _keys(own).items() if key not in properties}
            shapes = {key: _property(own, key, *one, found) for key, one in keys.items()}
            found[added] = _record(own, added, shapes, list(shapes))
            properties[added.lower()] = {**_reference(added), "description": text}
        required = _required(kind)
        found[name] = _record(
            kind, name, properties, [key for key in properties if key in required]
        )
    return _reference(name)


def _record(
    kind: type, name: str, properties: dict[str, Any], required: list[str]
) -> dict[str, Any]:
    """Return the schema of a record, which admits no other keys than it has."""
    record: dict[str, Any] = {
        "additionalProperties": kind in OPEN,
        "description": (inspect.getdoc(kind) or "").replace("``", "`"),
        "properties": properties,
        **({"required": required} if required else {}),
        "title": name,
        "type": "object",
    }
    if properties.keys() >= frozenset.union(*TOGETHER):
        shared = frozenset.intersection(*TOGETHER)
        record["dependentRequired"] = {
            key: sorted(group - set(required) - {key})
            for group in TOGETHER
            for key in sorted(group - shared - set(required))
        }
    return record


def _property(kind: type, key: str, hint: Any, text: str, found: dict[str, Any]) -> dict[str, Any]:
    """Return the schema of a key; ValueError: it has no text."""
    if not text:
        raise ValueError(f"{kind.__name__}.{key} has no text below it")
    return dict(sorted({**_shape(hint, found), "description": text}.items()))


def _shape(hint: Any, found: dict[str, Any]) -> dict[str, Any]:
    """Return the schema of a type; its records are added to those that were found."""
    hint = {Path: str, RunConfig: Mapping[str, Any]}.get(hint) or _keys_of(hint)
    if hint in PLAIN:
        return {"type": PLAIN[hint]}
    if typing.is_typeddict(hint) or is_dataclass(hint):
        return add_record(hint, found)
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is Literal:
        return {"enum": list(arguments), "type": "string"}
    if isinstance(origin, type) and issubclass(origin, Mapping):
        values = arguments[1]
        shape = True if values is Any else _shape(values, found)
        return {"additionalProperties": shape, "type": "object"}
    shapes = [_shape(own, found) for own in arguments if own is not Ellipsis]
    if origin in {UnionType, Union}:
        is_plain = all(set(shape) == {"type"} for shape in shapes)
        return {"type": [one["type"] for one in shapes]} if is_plain else {"anyOf": shapes}
    if origin is not tuple or Ellipsis in arguments:
        return {"items": shapes[0], "type": "array"}
    count = len(shapes)
    return {"maxItems": count, "minItems": count, "prefixItems": shapes, "type": "array"}


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
