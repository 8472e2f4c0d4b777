"""Tables of the settings, from the configuration's fields."""

from __future__ import annotations

from docs.generate.markdown import row
from slamfusion.config import ConfigOption, FieldInfo, RunConfig, config_fields, shown_value
from slamfusion.slam.registry import producer, with_producers

__all__ = ["TABLES", "gmapping_table", "parameter_table"]

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
            lines.append(row(f"`{info.name}`", info.unit or "-", published, own, info.help))
    return "\n".join(lines)


# Each table by the name of its part.
TABLES = {"parameters": parameter_table, "gmapping parameters": gmapping_table}


def _row(option: ConfigOption) -> str:
    info = option.info
    name = f"`{option.flag}`" if info.level == "public" else "(expert)"
    if option.section in NODE_SECTIONS and info.level == "public":
        name = "(fusion node)"
    return row(name, f"`{option.key}`", option.shown_default(), _range(info), info.help)


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
