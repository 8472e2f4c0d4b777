"""``--save-results FILE``: everything a command measured, in one file to be compared later."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from slamfusion.cli.options import output_option
from slamfusion.cli.output import Settings

if TYPE_CHECKING:
    from slamfusion.evaluation import MeasuredItem
    from slamfusion.jobs.results_file import InputFile

__all__ = ["results_option", "save_results"]

F = TypeVar("F", bound=Callable[..., Any])

SUFFIX = ".zip"


def results_option(function: F) -> F:
    """Give a command ``--save-results``, which it then hands to ``save_results``."""
    option = output_option(
        "--save-results",
        "results_path",
        metavar="FILE.zip",
        help="Save what was measured, its settings and the inputs' SHA-256, for slamfusion "
        "compare.",
    )

    @functools.wraps(function)
    def wrapper(*arguments: Any, results_path: Path | None, **given: Any) -> Any:
        if results_path is not None and results_path.suffix.lower() != SUFFIX:
            message = f"{results_path}: wanted a name that ends in {SUFFIX}"
            raise click.BadParameter(message, param_hint="'--save-results'")
        return function(*arguments, results_path=results_path, **given)

    return option(wrapper)  # type: ignore[return-value]


def save_results(
    path: Path | None,
    document: Mapping[str, Any],
    items: Callable[[], Sequence[MeasuredItem]],
    inputs: Callable[[], Sequence[InputFile]] = list,
) -> None:
    """Write what the running command measured, where it was asked for.

    Args:
        path: as ``--save-results`` has it; None: it was not asked for.
        document: what the command prints with ``--json``.
        items: returns what was measured.
        inputs: returns the files that it rests on.
    """
    if path is None:
        return
    from slamfusion.jobs.results_file import write_results_file  # noqa: PLC0415  (loads slowly)

    context = click.get_current_context()
    words = context.command_path.split()[1:]
    write_results_file(
        path,
        command=" ".join(words),
        arguments=context.ensure_object(Settings).arguments,
        document=document,
        items=items(),
        inputs=inputs(),
    )
