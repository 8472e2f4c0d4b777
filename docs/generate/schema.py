"""The keys of every JSON document, from the schema that is installed with the package."""

from __future__ import annotations

import json
from typing import Any

from docs.generate.markdown import table
from slamfusion.jobs.records import load_schema

__all__ = ["TABLES", "document_tables"]

_REF = "#/$defs/"


def document_tables() -> str:
    """Return a table of documents by command, and one of the keys of each document and record."""
    definitions = load_schema()["$defs"]
    commands = {name: item for name, item in definitions.items() if _is_command(name)}
    rows = [(f"`{name}`", _type(item)) for name, item in commands.items()]
    parts = [table(("command", "prints one of"), rows)]
    for name in sorted(set(definitions) - set(commands)):
        item = definitions[name]
        keys = [
            (f"`{key}`", _type(value), value.get("description", ""))
            for key, value in item.get("properties", {}).items()
        ]
        if keys:
            text = item.get("description", "")
            parts.append(f"### {name}\n\n{text}\n\n" + table(("key", "type", "what"), keys))
    return "\n\n".join(parts)


def _is_command(name: str) -> bool:
    """Whether an entry is what a command prints; records are called by a capital."""
    return name[0].islower()


def _type(value: dict[str, Any]) -> str:
    """Return a type in words, records with links."""
    if "$ref" in value:
        name = value["$ref"].removeprefix(_REF)
        return f"[{name}](#{name.lower()})"
    if "anyOf" in value:
        return " or ".join(_type(item) for item in value["anyOf"])
    if "enum" in value:
        return " or ".join(f"`{json.dumps(item)}`" for item in value["enum"])
    if "const" in value:
        return f"`{json.dumps(value['const'])}`"
    kind = value.get("type", "any")
    if isinstance(kind, list):
        return " or ".join(_type({**value, "type": item}) for item in kind)
    if kind == "array" and "items" in value:
        return f"list of {_type(value['items'])}"
    if kind == "array" and "prefixItems" in value:
        return "[" + ", ".join(_type(item) for item in value["prefixItems"]) + "]"
    inner = value.get("additionalProperties")
    if kind == "object" and isinstance(inner, dict):
        return f"object of {_type(inner)}"
    return str(kind)


TABLES = {"JSON documents": document_tables}
