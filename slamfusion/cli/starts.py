"""``--start``: where inputs are expected to lie."""

from __future__ import annotations

import contextlib
import typing
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, TypeVar

import click

from slamfusion.config import START_M, START_RAD, RunConfig, checked_start
from slamfusion.errors import StartError

F = TypeVar("F", bound=Callable[..., Any])

# What ``--start`` gave: names with 3 or 5 numbers each.
GivenStarts = tuple[tuple[str, tuple[float, ...]], ...]

OPTION = "--start"
NUMBERS = 3


def start_option(text: str, *, bare_name: bool = False) -> Callable[[F], F]:
    """Give a command ``--start`` as its argument ``starts``.

    Args:
        text: of help: in which frame starts are told.
        bare_name: a start may have no name, and is the empty one's then.
    """
    form = "NAME=X,Y,YAW[,M,RAD]"
    return click.option(
        OPTION,
        "starts",
        multiple=True,
        type=_Start(bare_name=bare_name),
        callback=_refuse_twice,
        metavar=f"[NAME=]{form.removeprefix('NAME=')}" if bare_name else form,
        help=f"{text}, in m and rad, or degrees as in 46.4deg; searched only within M metres and "
        f"RAD radians of it. [default: {START_M:g} m, {START_RAD:g} rad]",
    )


class _Start(click.ParamType):  # type: ignore[type-arg]  # generic from click 8.3 on
    """A name, and 3 or 5 numbers."""

    name = "start"

    def __init__(self, *, bare_name: bool) -> None:
        self._bare_name = bare_name

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, tuple[float, ...]]:
        """Return the name, empty where it is left out, and the numbers."""
        if not isinstance(value, str):
            return typing.cast("tuple[str, tuple[float, ...]]", value)
        name, equals, numbers = value.rpartition("=")
        if not name and (equals or not self._bare_name):
            self.fail(f"wanted NAME=x,y,yaw or NAME=x,y,yaw,metres,radians, found {value!r}")
        try:
            return name, checked_start(numbers, name or "start")
        except StartError as error:
            self.fail(str(error), param, ctx)


def _refuse_twice(context: click.Context, option: click.Parameter, given: GivenStarts) -> Any:
    """Refuse a name that has several starts."""
    names = [name for name, _ in given]
    for name in names:
        if names.count(name) > 1:
            message = f"{name or 'the start'} is given twice; keep one"
            raise click.BadParameter(message, context, option)
    return given


def with_starts(config: RunConfig, given: GivenStarts) -> RunConfig:
    """Return the settings with the starts of the command line in place of the file's."""
    return replace(config, start={**config.start, **dict(given)})


@contextlib.contextmanager
def start_errors(given: GivenStarts) -> Iterator[None]:
    """Take a start that is refused beside the inputs for wrong usage, where the option gave it."""
    try:
        yield
    except StartError as error:
        if not given:
            raise
        raise click.BadParameter(str(error), param_hint=f"'{OPTION}'") from None


class JoinedStart(click.Command):
    """A command that takes ``--start X Y YAW`` for ``--start X,Y,YAW``, as it once was."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Put commas between three numbers that follow ``--start``."""
        rest, joined = list(args), []
        while rest:
            joined.append(rest.pop(0))
            numbers = rest[:NUMBERS] if joined[-1] == OPTION else []
            if len(numbers) == NUMBERS and all(map(_is_number, numbers)):
                joined.append(",".join(numbers))
                del rest[:NUMBERS]
        return super().parse_args(ctx, joined)


def _is_number(text: str) -> bool:
    try:
        float(text.removesuffix("deg"))
    except ValueError:
        return False
    return True
