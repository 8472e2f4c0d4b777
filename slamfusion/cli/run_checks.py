"""What ``slamfusion run`` refuses before any work, of one log and of several."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from pathlib import Path

import click

from slamfusion.jobs.inputs import check_writable, real_path
from slamfusion.jobs.outputs import FAILED, possible_outputs

__all__ = ["check_run"]


def check_run(
    out: Path,
    folders: Sequence[Path],
    read: Sequence[Path | None],
    maps: Sequence[Path | None],
) -> None:
    """Refuse a run that could not write its report or its files, or would replace its inputs.

    Args:
        out: as ``-o`` has it.
        folders: in which the files of a log go: ``out``, or of several logs those in it.
        read: files that are read, but for maps; None: not given.
        maps: maps that are read, likewise.

    Raises:
        SlamFusionError: matplotlib is missing, or ``out`` cannot be written.
        click.UsageError: ``out`` is a file, or an input would be replaced.
    """
    # The import takes longer than the look: it is made while the producers are at work.
    if importlib.util.find_spec("matplotlib") is None:
        import slamfusion.report  # noqa: F401, PLC0415  (says what to install)
    if out.exists() and not out.is_dir():
        message = f"-o {out} is not a folder; name one for the maps and the report"
        raise click.UsageError(message)
    inputs = {real_path(path) for path in (*read, *maps) if path is not None}
    # Also the image of a map that is named by its YAML file.
    inputs |= {real_path(path).with_suffix(".pgm") for path in maps if path is not None}
    for folder in folders:
        # What may be written or removed there, but for reports.
        for path in (*possible_outputs(folder), *possible_outputs(folder / FAILED)):
            if real_path(path) in inputs:
                message = f"-o {out} would replace the input {path}; choose another folder"
                raise click.UsageError(message)
    check_writable(out)
