"""The README's parameter table, from the configuration: ``python -m slamfusion.cli.readme``."""

from __future__ import annotations

import sys
import types
import typing
from pathlib import Path

from slamfusion.cli.options import ConfigOption, config_fields, option_name
from slamfusion.config import FieldInfo

__all__ = ["parameter_table", "with_table"]

BEGIN = "<!-- parameters: written by `python -m slamfusion.cli.readme` -->"
END = "<!-- end of parameters -->"


def parameter_table() -> str:
    """Return a Markdown table of every configuration field, expert ones last in their section."""
    lines = [
        "| option | in `--config` | default | range | what |",
        "| --- | --- | --- | --- | --- |",
    ]
    lines += [_row(option) for option in config_fields()]
    return "\n".join(lines)


def with_table(readme: str) -> str:
    """Return the README with the table between its marks brought up to date."""
    before, rest = readme.split(BEGIN, 1)
    after = rest.split(END, 1)[1]
    return f"{before}{BEGIN}\n\n{parameter_table()}\n\n{END}{after}"


def _row(option: ConfigOption) -> str:
    info = option.info
    name = f"`{option_name(option)}`" if info.level == "public" else "(expert)"
    cells = (name, f"`{option.key}`", _default(info), _range(info), info.help)
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _default(info: FieldInfo) -> str:
    if info.default is None:
        return ""
    if isinstance(info.default, bool):
        return "yes" if info.default else "no"
    value = f"{info.default:.4g}" if isinstance(info.default, float) else str(info.default)
    return f"{value} {info.unit}".rstrip()


def _range(info: FieldInfo) -> str:
    if info.choices:
        return ", ".join(f"`{choice}`" for choice in info.choices)
    if info.low is not None and info.high is not None:
        return f"{info.low:.4g} to {info.high:.4g}"
    if info.low is not None:
        return f"at least {info.low:.4g}"
    if info.high is not None:
        return f"at most {info.high:.4g}"
    kind = info.type
    if isinstance(kind, types.UnionType):
        kind = next(item for item in typing.get_args(kind) if item is not type(None))
    return {bool: "yes, no", str: "text"}.get(kind, "")


def main(path: Path) -> None:
    """Rewrite the table in a README."""
    text = path.read_text(encoding="utf-8")
    path.write_text(with_table(text), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "README.md"))
