"""Every command with its arguments and options, as its help has them."""

from __future__ import annotations

from collections.abc import Iterator

import click

from docs.generate.markdown import table
from slamfusion.cli.program import cli

__all__ = ["TABLES", "command_pages", "walk"]

# Options that every command has are described once.
COMMON = ("--help", "--help-all")


def walk(command: click.Command = cli, before: str = "") -> Iterator[tuple[str, click.Context]]:
    """Yield every command below one that is no group, by its whole name, in order."""
    name = f"{before} {command.name}".strip() if before else "slamfusion"
    context = click.Context(command, info_name=name)
    if not isinstance(command, click.Group):
        yield name, context
        return
    for below in command.list_commands(context):
        found = command.get_command(context, below)
        if found is not None:
            yield from walk(found, name)


def command_pages() -> str:
    """Return a section for each command: what it does, how it is called, its options."""
    sections = []
    for name, context in walk():
        command = context.command
        usage = " ".join([name, *command.collect_usage_pieces(context)])
        lines = [f"### {name}", "", "```text", usage, "```", "", _prose(command.help or ""), ""]
        rows = [
            (f"`{record[0]}`", " ".join(record[1].split()).replace("<", "&lt;"))
            for parameter in command.get_params(context)
            if isinstance(parameter, click.Option)
            and not set(COMMON) & set(parameter.opts)
            and (record := parameter.get_help_record(context)) is not None
        ]
        lines += [table(("option", "what"), rows)] if rows else []
        sections.append("\n".join(lines).rstrip())
    return "\n\n".join(sections)


def _prose(text: str) -> str:
    """Return a help text without the marks that tell click to leave its lines alone."""
    paragraphs = text.replace("\b", "").strip().split("\n\n")
    return "\n\n".join(" ".join(part.split()) for part in paragraphs)


TABLES = {"commands": command_pages}
