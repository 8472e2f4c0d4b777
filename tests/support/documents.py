"""JSON documents against the published schema."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

from jsonschema import Draft202012Validator
from jsonschema.exceptions import best_match

from slamfusion.jobs.records import load_schema

# Commands whose first argument is part of their name.
GROUPS = {"graph", "experiment", "live"}
FAILURE = "FailureDocument"


def command_of(arguments: Sequence[Any]) -> str:
    """Return the words of the command in a command line, e.g. ``graph optimize``."""
    words = [str(argument) for argument in arguments[1:3]]
    return " ".join(words) if words[0] in GROUPS else words[0]


def check_document(document: Mapping[str, Any], what: str, *, failed: bool = False) -> None:
    """Fail where a document is not one that the command may print.

    Args:
        document: as ``json.loads`` gives it.
        what: the command's words, or a record's name; see ``load_schema``.
        failed: whether the command ended with another exit code than 0. Only then may the
            document be nothing but an error.
    """
    if set(document) == {"error"}:
        assert failed, f"{what}: a failure with exit code 0"
        kinds: Sequence[str] = [FAILURE]
    else:
        kinds = _kinds(what)
    # Of several kinds of document the nearest one tells what is wrong.
    errors = min((list(_validator(kind).iter_errors(document)) for kind in kinds), key=len)
    error = best_match(errors)
    assert error is None, f"{what}: {error.json_path}: {error.message}"


def _kinds(what: str) -> list[str]:
    """Return the records that a command prints where it does its work; of a record, itself."""
    schema = load_schema(what)
    choices = schema["$defs"][schema["$ref"].rpartition("/")[2]].get("anyOf", [schema])
    names = [choice["$ref"].rpartition("/")[2] for choice in choices]
    return [name for name in names if name != FAILURE]


@cache
def _validator(kind: str) -> Draft202012Validator:
    return Draft202012Validator(load_schema(kind))
