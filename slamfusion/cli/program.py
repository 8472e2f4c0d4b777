"""The ``slamfusion`` command: the table of subcommands and the one error handler."""

from __future__ import annotations

import contextlib
import io
import logging
import os
import sys
import traceback
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import click
from click.shell_completion import shell_complete

from slamfusion.cli.help import Group
from slamfusion.cli.output import Settings, one_line, print_json
from slamfusion.errors import SlamFusionError, error_text
from slamfusion.version import __version__

# Every command: where it is, and what it does. A module is loaded when its command is used.
COMMANDS = {
    "run": ("run:command", "Map a log with several SLAMs, fuse their maps, write a report."),
    "fuse": ("fuse:command", "Align saved maps of one place and fuse them by vote."),
    "info": ("info:command", "Describe a log, a bag, a map or a run."),
    "show": ("show:command", "Show the maps of a run in the browser."),
    "slam": ("slam:command", "Map a log with one SLAM."),
    "judge": ("judge:command", "Rank the paths of a log by its scans, without ground truth."),
    "evaluate": ("evaluate:command", "Measure the errors of maps."),
    "trajectory": ("trajectory:command", "Measure the errors of paths."),
    "compare": ("compare:command", "Compare saved results, with p-values."),
    "align": ("align:command", "Align one map with another, or with a floor plan."),
    "simulate": ("simulate:command", "Simulate a robot's log, with the true map and path."),
    "experiment": ("experiment:command", "Repeat an experiment of a paper."),
    "graph": ("graph:command", "Optimise a pose graph in a file."),
    "node": ("node:command", "Run a ROS 2 node."),
    "live": ("live:command", "Query and control a running fusion node."),
    "devices": ("doctor:devices_command", "List the OpenCL devices."),
    "doctor": ("doctor:command", "Check this installation."),
}

EXIT_FAILURE = 1
EXIT_USAGE = 2
EXIT_INTERRUPTED = 130
EXIT_PIPE_CLOSED = 141
# The variable by which a shell asks for completions: bash_source, zsh_complete, ...
COMPLETE = "_SLAMFUSION_COMPLETE"


@click.group(cls=Group, table=COMMANDS, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="slamfusion")
def cli() -> None:
    """Run several 2D SLAMs, align their occupancy grids, and let them vote."""


def run_program(arguments: Sequence[str]) -> int:
    """Run the command line and return its exit code, see ``slamfusion.cli.main``."""
    _open_streams()
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):  # file names need not be text
            stream.reconfigure(errors="backslashreplace")
    if wanted := os.environ.get(COMPLETE):
        return shell_complete(cli, {}, "slamfusion", COMPLETE, wanted)
    if logging.lastResort is not None:
        logging.lastResort.setFormatter(logging.Formatter("slamfusion: %(message)s"))
    settings = Settings(arguments=tuple(arguments))
    code = _run(list(arguments), settings)
    with contextlib.suppress(OSError):
        sys.stderr.flush()
    return code


class _Output(io.FileIO):
    """Standard output, which says its name where it cannot be written."""

    def write(self, data: Any, /) -> int:
        """Write some bytes; see ``io.RawIOBase.write``."""
        try:
            return cast("int", super().write(data))
        except BrokenPipeError:
            raise
        except OSError as error:
            error.filename = "standard output"
            raise


def _open_streams() -> None:
    """Replace closed streams, whose numbers the next opened files would take, and name errors."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
    for name in ("stdout", "stderr"):
        if getattr(sys, name, None) is None:
            nowhere = Path(os.devnull).open("w", encoding="utf-8")  # noqa: SIM115 - to the end
            setattr(sys, name, nowhere)
    own = cast("Any", sys.stdout)
    if own is vars(sys)["__stdout__"] and not own.isatty():
        raw = io.BufferedWriter(_Output(own.fileno(), "w", closefd=False))
        sys.stdout = io.TextIOWrapper(raw, own.encoding, own.errors)


# What the program, the command line and the system fail with on purpose.
_EXPECTED = (click.ClickException, SlamFusionError, OSError, MemoryError)


def _run(arguments: list[str], settings: Settings) -> int:
    """Run one command; every expected failure of the program ends here."""
    try:
        with warnings.catch_warnings():
            if "--debug" not in arguments:
                warnings.simplefilter("ignore")
            with cli.make_context("slamfusion", arguments, obj=settings) as context:
                code = cli.invoke(context)
        sys.stdout.flush()
    except click.exceptions.Exit as request:  # --help, --version
        code = request.exit_code
    except click.UsageError as error:
        _say(f"error: {_usage_message(error)}")
        code = EXIT_USAGE
    except (KeyboardInterrupt, click.Abort):
        _say("interrupted")
        code = EXIT_INTERRUPTED
    except BrokenPipeError:
        _drop_stdout()
        code = EXIT_PIPE_CLOSED
    except (*_EXPECTED, ImportError) as error:
        if _is_interrupt(error):
            _say("interrupted")
            code = EXIT_INTERRUPTED
        elif isinstance(error, ImportError):
            raise
        else:
            code = _fail(error_text(error), settings)
    return code if isinstance(code, int) else 0


def _is_interrupt(error: BaseException | None) -> bool:
    """Whether an interrupt caused an error: a library in C that is loading makes it another one."""
    return error is not None and (
        isinstance(error, KeyboardInterrupt) or _is_interrupt(error.__cause__)
    )


def _usage_message(error: click.UsageError) -> str:
    """Return what is wrong with the command line, in the words of our other errors."""
    message = error.format_message().removesuffix(".")
    if type(error) is click.BadParameter:
        return message.removeprefix("Invalid value for ").removeprefix("Invalid value: ")
    if isinstance(error, click.exceptions.NoSuchOption):
        near = (error.possibilities or [])[:1]
        ask = f"; did you mean {near[0]!r}?" if near else ""
        message = f"{error.option_name!r} is not an option{ask}"
    path = error.ctx.command_path if error.ctx is not None else "slamfusion"
    if error.ctx is not None and "unexpected extra argument" in message:
        message += f"; wanted {' '.join(error.ctx.command.collect_usage_pieces(error.ctx)[1:])}"
    return f"{message[0].lower()}{message[1:]}; see {path} --help"


def _fail(message: str, settings: Settings) -> int:
    """Print one line (with ``--debug`` the traceback before it, with ``--json`` a document)."""
    if settings.debug:
        traceback.print_exc()
    try:
        if settings.as_json and not settings.printed:
            print_json({"error": one_line(message)})
        sys.stdout.flush()
    except (OSError, ValueError):
        _drop_stdout()
    _say(f"error: {message}")
    return EXIT_FAILURE


def _say(message: str) -> None:
    with contextlib.suppress(OSError):
        print(f"slamfusion: {one_line(message)}", file=sys.stderr)


def _drop_stdout() -> None:
    """Send what is still buffered nowhere, so that the interpreter's last flush stays silent."""
    with contextlib.suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)
