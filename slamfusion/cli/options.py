"""Options built from the configuration's fields, and the options that every command has."""

from __future__ import annotations

import contextlib
import functools
import math
import typing
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import click

from slamfusion.cli import paths
from slamfusion.cli.help import Choice, Number, Setting
from slamfusion.cli.output import Settings, notice
from slamfusion.config import (
    START_M,
    START_RAD,
    ConfigOption,
    RunConfig,
    checked_start,
    checked_value,
    config_fields,
    shown_value,
    with_values,
)
from slamfusion.errors import ConfigError, StartError
from slamfusion.jobs.inputs import PixelSizes
from slamfusion.jobs.outputs import possible_report

F = TypeVar("F", bound=Callable[..., Any])


# Its import says what to install.
REPORT = "slamfusion.report"
# Each seed is a run of its own, of seconds at least.
SEEDS_MAX = 10_000
# What help calls a value, by its unit or else its type.
METAVARS = {"%": "PERCENT", "cells": "CELLS", "str": "TEXT", "int": "N", "float": "NUMBER"}


def settings(
    *sections: str, base: RunConfig | None = None, preset: RunConfig | None = None
) -> Callable[[F], F]:
    """Add ``--config`` and options for the public fields of sections; pass ``config`` on.

    ``NAME.*`` is a section with all its parts.
    """
    defaults = base or RunConfig()
    chosen = [
        option
        for option in config_fields(defaults)
        if option.info.level == "public"
        and (option.section in sections or f"{option.section.partition('.')[0]}.*" in sections)
    ]

    def decorate(function: F) -> F:
        @functools.wraps(function)
        def wrapper(
            *args: Any, config_file: Path | None, like_paper: bool = False, **values: Any
        ) -> Any:
            found = [(option, values.pop(option.parameter)) for option in chosen]
            config = preset if like_paper and preset is not None else defaults
            if config_file is not None:
                from slamfusion.slam.registry import load_config  # noqa: PLC0415  (loads slowly)

                config = load_config(config_file, config)
            try:
                given = {
                    option.key: checked_value(option.info, value, f"'{option.flag}'")
                    for option, value in found
                    if value is not None
                }
                config = with_values(config, given)
            except ConfigError as error:
                raise click.BadParameter(str(error)) from None
            return function(*args, config=config, **values)

        command: Any = wrapper
        for option in reversed(chosen):
            command = _click_option(option)(command)
        if preset is not None:
            command = _LIKE_PAPER(command)
        return typing.cast("F", _CONFIG_FILE(command))

    return decorate


def file(
    name: str, parameter: str, metavar: str, text: str, kind: paths.InputPath = paths.FILE
) -> Callable[[F], F]:
    """Return the option of a command that names an input, which need not exist."""
    return click.option(name, parameter, type=kind, metavar=metavar, help=text)


def output(
    *names: str,
    files: paths.Files = lambda path, _: [path],
    ends: Sequence[str] = (),
    needs: str = "",
    metavar: str,
    **more: Any,
) -> Callable[[F], F]:
    """Return the option of a command that says where something is written; see ``OutputPath``."""
    kind = paths.OutputPath(files, ends, needs, is_folder=metavar == "DIR")
    return click.option(*names, type=kind, metavar=metavar, **more)


def main_output(parameter: str, metavar: str, text: str, files: paths.Files) -> Callable[[F], F]:
    """Return the required option ``-o`` of a command."""
    text = f"{text} Existing files are replaced."
    return output(
        "-o", "--output", parameter, files=files, required=True, metavar=metavar, help=text
    )


def case(
    name: str, parameter: str, metavar: str, text: str, kind: paths.CasePath = paths.CASE_FILE
) -> Callable[[F], F]:
    """Return the option of a command that names a file of each of several cases."""
    text = f"{text} Repeat it for several cases: [CASE=]{metavar}."
    return click.option(name, parameter, type=kind, multiple=True, metavar=metavar, help=text)


_CONFIG_FILE = file(
    "--config",
    "config_file",
    "FILE",
    "YAML file with settings, including expert ones. Options override it.",
)


_LIKE_PAPER = click.option(
    "--like-paper",
    is_flag=True,
    help="Fuse as the paper [F16]: a majority vote that counts unknown as a value, in the frame "
    "and box of the smallest map. Options override it.",
)


def report(parameter: str, folders: paths.Files = lambda folder, _: [folder]) -> Callable[[F], F]:
    """Return the option ``--report`` of a command that can write one; ``--pictures`` needs it."""

    def needed(context: click.Context, _: click.Parameter, folder: Path | None) -> Path | None:
        is_asked = folder is None and context.params.get("config_report_pictures")
        refuse(is_asked, "--pictures needs --report DIR, where they are written")
        return folder

    return output(
        "--report",
        parameter,
        callback=needed,
        files=lambda path, given: [
            file for folder in folders(path, given) for file in possible_report(folder)
        ],
        needs=REPORT,
        metavar="DIR",
        help="Write an HTML report with its pictures to this folder.",
    )


open_report = click.option(
    "--open", "is_opened", is_flag=True, help="Open the report in the browser when it is written."
)


probabilities = click.option(
    "--probabilities",
    is_flag=True,
    help="Also write the map as probabilities: NAME_probability.yaml and .png.",
)


def drive_files(judged: str, *, of_cases: bool = False) -> Callable[[F], F]:
    """Give a command ``--relations``, ``--odometry``, ``--scan-odometry``: more files of LOG."""
    option = case if of_cases else file
    texts = {
        "--relations": "Known motions between pairs of times [K09]. Adds the errors of the "
        f"{judged}.",
        "--odometry": "Raw odometry of the whole run. It carries poses to the times of the "
        "relations.",
        "--scan-odometry": "CSV with the odometry of each scan of a CARMEN log (index, odom_x, "
        "odom_y, odom_theta). It replaces the poses in LOG, which in a corrected log are the "
        "result of a SLAM.",
    }

    def decorate(function: F) -> F:
        for name, text in reversed(texts.items()):
            function = option(name, name[2:].replace("-", "_"), "FILE", text)(function)
        return function

    return decorate


def refuse(is_wrong: object, message: str) -> None:
    """Report options that do not go together as wrong usage."""
    if is_wrong:
        raise click.UsageError(message)


def check_odometry(odometry: object, relations: object) -> None:
    """Refuse odometry of a run without the relations that it is for."""
    refuse(odometry and not relations, "--odometry needs --relations FILE")


resolution = click.option(
    "--resolution",
    type=Number(float),
    metavar="M",
    help="Cell size of images without YAML, in metres.",
)


def scale(text: str) -> Callable[[F], F]:
    """Give a command ``--scale``: the size that the pixels of a floor plan may have, metres."""

    def sizes(value: str) -> PixelSizes:
        if value == "free":
            return "free"
        try:
            low, high = (float(part) for part in value.split(":"))
        except ValueError:
            low = high = math.nan
        if not 0.0 < low <= high < math.inf:
            message = f"{value!r}: wanted free, or metres per pixel as LOW:HIGH, such as 0.02:0.06"
            raise click.BadParameter(message)
        return low, high

    text += (
        " LOW:HIGH limits the size of its pixels, in metres; free: from half to twice "
        "--resolution, or 0.025 to 0.1."
    )
    return click.option("--scale", metavar="free|LOW:HIGH", type=sizes, help=text)


# Where the truth may be a floor plan.
truth_scale = scale(
    "The true map is a floor plan, whose scale is searched: a picture or a DXF drawing. What the "
    "robot has not seen of it does not count."
)


def common(function: F) -> F:
    """Give a command ``--json``, ``-v`` and ``--debug``; check its paths.

    These, and the value of ``--save-results`` (``results_option``), are in ``output.settings``.
    """

    @functools.wraps(function)
    def wrapper(*args: Any, **values: Any) -> Any:
        context = click.get_current_context()
        with paths.checked_paths(context, {**context.params, **values}):
            if context.params.get("resolution") is not None and paths.has_only_yaml(context):
                notice("--resolution is not used: each map has a YAML with its own resolution")
            context.ensure_object(Settings).results_path = values.pop("results_path", None)
            return function(*args, **values)

    def remember(context: click.Context, option: click.Parameter, value: bool) -> bool:
        setattr(context.ensure_object(Settings), str(option.name), value)
        return value

    def flag(*names: str, text: str) -> Callable[[Any], Any]:
        return click.option(
            *names, is_flag=True, is_eager=True, expose_value=False, callback=remember, help=text
        )

    command: Any = flag("--debug", text="Show the traceback of an error.")(wrapper)
    words = "Print all columns, reasons and warnings."
    command = flag("-v", "--verbose", text=words)(command)
    words = "Print one JSON document instead of tables."
    return typing.cast("F", flag("--json", "as_json", text=words)(command))


def _click_option(option: ConfigOption) -> Callable[[Any], Any]:
    """Return the click option of one field; without it the field keeps its value."""
    info, name = option.info, option.flag
    more: dict[str, Any] = {}
    if info.kind is bool:
        name = f"{name}/--no-{name.removeprefix('--')}"
    elif info.choices and not info.is_list:
        more["type"] = Choice(info.choices)
    elif not info.is_list:
        more["type"] = Number(info.kind) if info.kind in {int, float} else info.kind
    if info.kind is not bool and (info.is_list or not info.choices):
        word = info.unit or info.kind.__name__
        more["metavar"] = METAVARS.get(word, word.upper())
    help_text = info.help[0].upper() + info.help[1:] + "."
    if option.default not in {None, ()}:
        published = f"; published {shown_value(option.published)}" * (option.published is not None)
        help_text += f" [default: {option.shown_default()}{published}]"
    return click.option(
        name, option.parameter, cls=Setting, section=option.section, default=None, help=help_text,
        **more,
    )  # fmt: skip


def scheduler(tasks: str) -> Callable[[F], F]:
    """Return the option ``--scheduler`` of a command."""

    def checked(where: str) -> str:
        """Refuse what is no address before any work."""
        from slamfusion.fleet import check_address  # noqa: PLC0415

        try:
            check_address(where)
        except ConfigError as error:
            raise click.BadParameter(str(error)) from None
        return where

    return click.option(
        "--scheduler",
        metavar="WHERE",
        type=checked,
        help=f"Run {tasks} on a Dask cluster: local or local:N (N processes on this machine), or "
        "tcp://HOST:PORT or tls://HOST:PORT, a running scheduler.",
    )


def seeds(places: str) -> Callable[[F], F]:
    """Return the option ``--seeds`` of a command; ``places`` says where the results go."""

    def seeds(_: click.Context, __: click.Parameter, text: str | None) -> tuple[int, ...]:
        """Return the seeds in the order given, each once."""
        found: dict[int, None] = {}
        for part in [] if text is None else text.split(","):
            ends = [end.strip() for end in part.split("-", 1)]
            if not all(map(str.isdecimal, ends)) or int(ends[-1]) < int(ends[0]):
                raise click.BadParameter(f"wanted seeds like 0-9 or 1,2,5, found {text!r}")
            if (count := int(ends[-1]) - int(ends[0]) + 1) > SEEDS_MAX:
                raise click.BadParameter(f"wanted at most {SEEDS_MAX} seeds, found {count}")
            found |= dict.fromkeys(range(int(ends[0]), int(ends[-1]) + 1))
        return tuple(found)

    return click.option(
        "--seeds",
        callback=seeds,
        metavar="0-9",
        help=f"Run with each of these seeds (0-9 or 1,2,5) and compare them: {places}.",
    )


# What ``--start`` gave: names with 3 or 5 numbers each.
GivenStarts = tuple[tuple[str, tuple[float, ...]], ...]


def start(text: str, *, bare_name: bool = False) -> Callable[[F], F]:
    """Give a command ``--start`` as its argument ``starts``; ``bare_name``: it may have no name."""
    form = "[NAME=]X,Y,YAW[,M,RAD]" if bare_name else "NAME=X,Y,YAW[,M,RAD]"

    def starts(_: click.Context, __: click.Parameter, given: Sequence[str]) -> GivenStarts:
        found: dict[str, tuple[float, ...]] = {}
        for value in given:
            name, equals, numbers = value.rpartition("=")
            if not name and (equals or not bare_name):
                raise click.BadParameter(
                    f"wanted NAME=x,y,yaw or NAME=x,y,yaw,metres,radians, found {value!r}"
                )
            if name in found:
                raise click.BadParameter(f"{name or 'the start'} is given twice; keep one")
            try:
                found[name] = checked_start(numbers, name or "start")
            except StartError as error:
                raise click.BadParameter(str(error)) from None
        return tuple(found.items())

    return click.option(
        "--start",
        "starts",
        multiple=True,
        callback=starts,
        metavar=form,
        help=f"{text} In metres and radians, or degrees as in 46.4deg. The search covers M metres "
        f"and RAD radians around it. [default: {START_M:g} m, {START_RAD:g} rad]",
    )


def with_starts(config: RunConfig, given: GivenStarts) -> RunConfig:
    """Return the settings with the starts of the command line in place of the file's."""
    return replace(config, start={**config.start, **dict(given)})


@contextlib.contextmanager
def start_errors(given: GivenStarts) -> Iterator[None]:
    """Report a start of the option that no input fits as wrong usage."""
    try:
        yield
    except StartError as error:
        if not given:
            raise
        raise click.BadParameter(str(error), param_hint="'--start'") from None
