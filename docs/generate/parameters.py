"""The README's tables, from settings and nodes: ``python -m slamfusion.cli.readme``."""

from __future__ import annotations

import sys
from pathlib import Path

from slamfusion.cli import ros_tables
from slamfusion.cli.options import (
    ConfigOption,
    config_fields,
    option_name,
    shown_default,
    shown_value,
)
from slamfusion.config import FieldInfo, RunConfig
from slamfusion.slam.registry import producer, with_producers

__all__ = ["gmapping_table", "parameter_table", "with_tables"]

# Sections that no command has as options: the fusion node has them as parameters.
NODE_SECTIONS = ("live",)


def parameter_table() -> str:
    """Return a Markdown table of every configuration field, expert ones last in their section."""
    lines = [
        "| option | in `--config` | default | range | what |",
        "| --- | --- | --- | --- | --- |",
    ]
    lines += [_row(option) for option in config_fields(with_producers(RunConfig()))]
    return "\n".join(lines)


def gmapping_table() -> str:
    """Return a Markdown table of gmapping's parameters: as published, and as we have them."""
    lines = ["| name | unit | published | ours | what |", "| --- | --- | --- | --- | --- |"]
    for option in config_fields(producer("gmapping").config):
        if not option.section:
            info = option.info
            published = "-" if option.published is None else shown_value(option.published)
            own = "-" if option.default is None else shown_value(option.default)
            lines.append(_line(f"`{info.name}`", info.unit or "-", published, own, info.help))
    return "\n".join(lines)


# What stands between the marks of each table.
TABLES = {"parameters": parameter_table, "gmapping parameters": gmapping_table}


def with_tables(readme: str) -> str:
    """Return the README with the tables between their marks brought up to date."""
    for name, table in TABLES.items():
        begin = f"<!-- {name}: written by `python -m slamfusion.cli.readme` -->"
        end = f"<!-- end of {name} -->"
        before, rest = readme.split(begin, 1)
        after = rest.split(end, 1)[1]
        readme = f"{before}{begin}\n\n{table()}\n\n{end}{after}"
    return ros_tables.with_tables(readme)


def _row(option: ConfigOption) -> str:
    info = option.info
    name = f"`{option_name(option)}`" if info.level == "public" else "(expert)"
    if option.section in NODE_SECTIONS and info.level == "public":
        name = "(fusion node)"
    return _line(name, f"`{option.key}`", shown_default(option), _range(info), info.help)


def _line(*cells: str) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _range(info: FieldInfo) -> str:
    if info.choices:
        return ", ".join(f"`{choice}`" for choice in info.choices)
    if info.low is not None and info.high is not None:
        return f"{info.low:.4g} to {info.high:.4g}"
    if info.low is not None:
        return f"at least {info.low:.4g}"
    if info.high is not None:
        return f"at most {info.high:.4g}"
    return {bool: "yes, no", str: "text"}.get(info.kind, "")


def main(path: Path) -> None:
    """Rewrite the tables in a README."""
    text = path.read_text(encoding="utf-8")
    path.write_text(with_tables(text), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "README.md"))
