"""Commands whose help has examples and groups of options; names that are nearly right."""

from __future__ import annotations

import inspect
import math
import pkgutil
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import click

from slamfusion.cli.output import one_line
from slamfusion.errors import SlamFusionError, unknown

# The groups of a command's options: names, and the sections of settings whose options they hold.
GROUPS: Mapping[str, Sequence[str]] = {
    "Input": (
        *("--inputs", "--paths", "--resolution", "--log", "--datasets", "--map", "--fused-path"),
        *("map_files", "simulate", "graph_optimizer"),
    ),
    "Output": (
        *("--output", "--report", "--table", "--save-results", "--probabilities"),
        *("--open", "--plot", "--tum", "--fused", "--format", "--json", "--verbose", "--debug"),
        "report",
    ),
    "Ground truth": (
        *("--truth", "--truth-trajectory", "--truth-map", "--relations", "--odometry"),
        *("--align", "--distances", "evaluate", "trajectory"),
    ),
    "SLAM": ("--resume", "--save-state", "--stop-after", "run", "producers"),
    "Alignment": ("--start", "--scale", "--like-paper", "fusion"),
    "Vote": ("fusion.vote",),
    "Log and bag": ("--scan-odometry", "log"),
    "Running": ("--config", "--seeds", "--scheduler", "--processes", "device", ""),
}
OTHER = "Options"
# A command with more options than this shows these alone; --help-all shows all.
FEW = 20
BASIC = frozenset({
    "--output", "--inputs", "--paths", "--log", "--datasets", "--truth", "--truth-trajectory",
    "--truth-map", "--relations", "--align", "--distances", "--fused", "--start", "--producers",
    "--mode", "--reference", "--require-all", "--like-paper", "--scan-topic", "--odom-topic",
    "--scale", "--alignment", "--rpe-unit", "--rpe-delta", "--particles", "--report", "--table",
    "--save-results", "--json", "--verbose", "--config", "--seed", "--seeds", "--device",
    "--help", "--help-all", "--repetitions", "--format", "--open", "--worlds", "--courses",
    "--lidars", "--resume", "--save-state",
})  # fmt: skip


class Choice(click.Choice):  # type: ignore[type-arg]  # generic from click 8.2 on
    """One of several words."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the word, or name the nearest one."""
        del param, ctx
        return value if value in self.choices else self.fail(unknown(value, self.choices))


class Number(click.ParamType):  # type: ignore[type-arg]  # generic from click 8.3 on
    """A number in a range, with the words of the settings where it is none."""

    name = "number"

    def __init__(
        self, kind: type[int | float], low: float = -math.inf, high: float = math.inf
    ) -> None:
        self.kind, self.low, self.high = kind, low, high

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the number."""
        try:
            found = self.kind(value)
        except ValueError:
            whole = "whole " if self.kind is int else ""
            self.fail(f"wanted a {whole}number, found {value!r}", param, ctx)
        if found < self.low or found > self.high:
            message = f"must lie in [{self.low:g}, {self.high:g}], found {value}"
            self.fail(message, param, ctx)
        return found


class Setting(click.Option):
    """The option of a setting, which belongs to a section of the configuration."""

    def __init__(self, *args: Any, section: str, **named: Any) -> None:
        super().__init__(*args, **named)
        self.section = section


def _group_of(option: click.Parameter) -> str:
    """Return the group of an option: by its name, or by the section of its setting."""
    names = option.opts
    if isinstance(option, Setting):
        names = [option.section, option.section.partition(".")[0]]
    for name in names:
        for group, members in GROUPS.items():
            if name in members:
                return group
    return OTHER


class Command(click.Command):
    """A command whose help starts with examples (lines, with a text or none) and groups options."""

    def __init__(self, *args: Any, examples: Sequence[str] = (), **named: Any) -> None:
        super().__init__(*args, **named)
        self.examples = examples

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Read the arguments; what is wrong with them is an error of this command."""
        try:
            return super().parse_args(ctx, args)
        except click.UsageError as error:
            error.ctx = error.ctx or ctx
            raise

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        """Return the parameters; those of a long command end in --help-all and --help."""
        is_long = len(self.params) > FEW
        return [*super().get_params(ctx), *([_help_all()] if is_long else [])]

    def format_help_text(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002
        """Write the summary, the examples, then the rest of the text."""
        summary, _, rest = inspect.cleandoc(self.help or "").partition("\n\n")
        for text in (summary, rest):
            if text:
                formatter.write_paragraph()
                with formatter.indentation():
                    formatter.write_text(text)
            if text is summary and self.examples:
                with formatter.section("Examples"):
                    for line in self.examples:
                        formatter.write(f"  slamfusion {line}\n")

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options by group; of a long command only the basic ones, unless all are."""
        shown: dict[str, list[tuple[str, str]]] = {name: [] for name in (*GROUPS, OTHER)}
        is_short = len(self.params) > FEW and not ctx.meta.get("help-all")
        left_out = 0
        for option in self.get_params(ctx):
            record = option.get_help_record(ctx)
            if record is None or not isinstance(option, click.Option):
                continue
            if is_short and not BASIC & set(option.opts):
                left_out += 1
            else:
                shown[_group_of(option)].append(record)
        for name, records in shown.items():
            if records:
                with formatter.section(name):
                    formatter.write_dl(records)
        if left_out:
            formatter.write(f"\n{left_out} more options: {ctx.command_path} --help-all\n")


def _help_all() -> click.Option:
    def show(context: click.Context, _: click.Parameter, is_asked: bool) -> None:
        if is_asked:
            context.meta["help-all"] = True
            click.echo(context.get_help())
            context.exit()

    return click.Option(
        ["--help-all"],
        is_flag=True,
        is_eager=True,
        expose_value=False,
        callback=show,
        help="Show the help with all options and exit.",
    )


class Group(Command, click.Group):
    """A group with a table of name, place (``module:name``) and summary; loads on use."""

    command_class = Command

    def __init__(
        self, *args: Any, table: Mapping[str, tuple[str, str]] | None = None, **named: Any
    ) -> None:
        super().__init__(*args, **named)
        self.table = table or {}

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002
        """Return the names in order."""
        return [*self.table, *self.commands]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Load a command of the table."""
        if cmd_name in self.table:
            found = pkgutil.resolve_name(f"slamfusion.cli.{self.table[cmd_name][0]}")
            return found if isinstance(found, click.Command) else None
        return super().get_command(ctx, cmd_name)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Return the command that is named first, or name the nearest one."""
        if not ctx.resilient_parsing and self.get_command(ctx, args[0]) is None:
            raise click.UsageError(unknown(args[0], self.list_commands(ctx)), ctx)
        return super().resolve_command(ctx, args)

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Read the arguments; where there are none, show the help as wrong usage."""
        if not args and not ctx.resilient_parsing:
            click.echo(ctx.get_help(), err=True)
            ctx.exit(2)
        return super().parse_args(ctx, args)

    def summaries(self) -> list[tuple[str, str]]:
        """Return each command's name and what it does."""
        found = [(name, text) for name, (_, text) in self.table.items()]
        return found + [(name, own.get_short_help_str(80)) for name, own in self.commands.items()]

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options, then a line for each command."""
        super().format_options(ctx, formatter)
        with formatter.section("Commands"):
            formatter.write_dl(self.summaries())


class ProducerGroup(Group):
    """A group with a command, made by ``make``, for each producer, and for ``others``."""

    def __init__(
        self,
        *args: Any,
        make: Callable[[str], click.Command],
        others: Mapping[str, str] = MappingProxyType({}),
        **named: Any,
    ) -> None:
        super().__init__(*args, **named)
        self.make, self.others = make, others

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002
        """Return the names of the producers, then the others."""
        from slamfusion.slam.registry import producer_names  # noqa: PLC0415  (loads slowly)

        return [*producer_names(), *self.others]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Make a command; None for an unknown name."""
        from slamfusion.slam.registry import BUILT_IN  # noqa: PLC0415  (loads slowly)

        known = cmd_name in (*self.others, *BUILT_IN) or cmd_name in self.list_commands(ctx)
        return self.make(cmd_name) if known else None

    def summaries(self) -> list[tuple[str, str]]:
        """Return each name and what it is; of a broken producer, what is wrong with it."""
        from slamfusion.slam.registry import producer, producer_names  # noqa: PLC0415

        rows = []
        for name in producer_names():
            try:
                rows.append((name, producer(name).summary))
            except SlamFusionError as error:
                rows.append((name, f"BROKEN: {one_line(str(error))}"))
        return [*rows, *self.others.items()]
