"""``--scheduler`` and ``--processes``: where the tasks of a command are done."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Any, TypeVar

import click

from slamfusion.config import RunConfig
from slamfusion.errors import ConfigError

if TYPE_CHECKING:
    from concurrent.futures import Executor

F = TypeVar("F", bound=Callable[..., Any])


def scheduler_option(tasks: str) -> Callable[[F], F]:
    """Return the option ``--scheduler`` of a command.

    Args:
        tasks: what is done there, as help says it.
    """
    return click.option(
        "--scheduler",
        "scheduler",
        metavar="WHERE",
        callback=_checked,
        help=f"Let the workers of a Dask cluster do {tasks}: local or local:N (N processes of this "
        "machine), tcp://HOST:PORT or tls://HOST:PORT (a scheduler that runs).",
    )


def processes_option(tasks: str) -> Callable[[F], F]:
    """Return the option ``--processes`` of a command whose settings have none."""
    return click.option(
        "--processes",
        "processes",
        type=click.IntRange(1, 64),
        metavar="N",
        help=f"Let so many processes of this machine do {tasks}.",
    )


def asked_executor(
    where: str | None, config: RunConfig, processes: int | None
) -> AbstractContextManager[Executor | None]:
    """Open what the options ask for; see ``executor_for``."""
    if where is not None and processes is not None:
        message = "--scheduler and --processes: give one of them; --scheduler local:N has processes"
        raise click.UsageError(message)
    from slamfusion.fleet import executor_for  # noqa: PLC0415

    return executor_for(where, processes, config.device.device)


def _checked(_: click.Context, __: click.Parameter, where: str | None) -> str | None:
    """Refuse what is no address before any work."""
    from slamfusion.fleet import check_address  # noqa: PLC0415

    if where is not None:
        try:
            check_address(where)
        except ConfigError as error:
            raise click.BadParameter(str(error)) from None
    return where
