"""``slamfusion fuse``: align saved maps and let them vote."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from slamfusion.cli.evaluate import Evaluation, evaluate_maps, print_evaluations
from slamfusion.cli.inputs import check_writable, load_maps
from slamfusion.cli.options import common_options, map_resolution_option, with_config
from slamfusion.cli.output import (
    notice,
    number,
    print_json,
    print_table,
    progress_bar,
    versions,
)
from slamfusion.config import RunConfig, to_mapping
from slamfusion.errors import AlignmentError, MapFileError, SlamFusionError
from slamfusion.grid import OccupancyGrid

if TYPE_CHECKING:
    from slamfusion.fusion.records import Alignment, FusionResult, InputRecord

__all__ = ["command"]


@dataclass(frozen=True)
class _Outputs:
    """Where the two maps go: stems, without suffix."""

    fused: Path
    agreement: Path

    @classmethod
    def of(cls, out: Path) -> _Outputs:
        """Take ``OUT`` as a stem; a .yaml written out by the user is dropped."""
        if out.name in {"", ".."} or out.is_dir():
            message = f"-o {out}: name the map too, e.g. -o {out / 'fused'}"
            raise click.UsageError(message)
        stem = out.with_suffix("") if out.suffix in {".yaml", ".yml"} else out
        return cls(stem, stem.with_name(stem.name + "_agreement"))

    def refuse_inputs(self, maps: Sequence[Path]) -> None:
        """Stop before an output replaces an input."""
        written = {
            Path(f"{stem}{suffix}").absolute()
            for stem in (self.fused, self.agreement)
            for suffix in (".yaml", ".pgm", ".png")
        }
        for path in maps:
            if path.absolute() in written:
                message = f"-o {self.fused} would replace the input {path}; choose another name"
                raise click.UsageError(message)


@click.command("fuse")
@click.argument("maps", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "-o",
    "--output",
    "out",
    required=True,
    type=click.Path(path_type=Path),
    metavar="OUT",
    help="Write OUT.yaml, OUT.pgm and OUT_agreement.yaml, OUT_agreement.pgm.",
)
@click.option(
    "--truth",
    "truth_path",
    type=click.Path(path_type=Path),
    metavar="MAP",
    help="Evaluate every input and the fused map against this one.",
)
@click.option(
    "--report",
    "report_dir",
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="Write a self-contained HTML report with its pictures here.",
)
@map_resolution_option
@with_config(
    "fusion",
    "fusion.normalize",
    "fusion.align",
    "fusion.vote",
    "evaluate",
    "device",
    "",
)
@common_options
def command(
    maps: tuple[Path, ...],
    out: Path,
    truth_path: Path | None,
    report_dir: Path | None,
    resolution: float | None,
    config: RunConfig,
    as_json: bool,
) -> int:
    """Align saved MAPS of one place and fuse them by vote.

    MAPS are map_server YAML files, or bare images together with --resolution. At least two have
    to fit each other; those that do not are named and left out.
    """
    from slamfusion.compute import open_backend  # noqa: PLC0415
    from slamfusion.fusion import fuse_grids  # noqa: PLC0415

    outputs = _Outputs.of(out)
    outputs.refuse_inputs(maps if truth_path is None else (*maps, truth_path))
    if len(maps) < 2:
        message = f"{maps[0]}: one map alone cannot be fused; fuse needs at least two"
        raise SlamFusionError(message)
    check_writable(outputs.fused.parent)
    if report_dir is not None:
        import slamfusion.report  # noqa: F401, PLC0415  (says early when its extra is missing)

        check_writable(report_dir)
    grids = load_maps(maps, resolution)
    truth = None if truth_path is None else load_maps([truth_path], resolution)[0]
    backend = open_backend(config.device.device)

    evaluations: list[Evaluation] = []
    try:
        with progress_bar() as progress:
            result = fuse_grids(grids, config.fusion, backend, progress)
            if config.fusion.require_all and result.rejected:
                raise _AllRequiredError(result)
            if truth is not None:
                judged = [*grids, result.fused.with_name("fused")]
                evaluations = evaluate_maps(judged, truth, config, backend, progress=progress)
    except AlignmentError as error:
        _report_failure(error, grids, config, backend.name, report_dir, as_json)
        raise

    _save(result, outputs)
    if report_dir is not None:
        from slamfusion.report import write_fusion_report  # noqa: PLC0415

        errors = [evaluation.error for evaluation in evaluations]
        write_fusion_report(result, report_dir, config=config, evaluations=errors)

    for record in result.rejected:
        notice(f"rejected: {record.name}: {record.reason}")
    if as_json:
        print_json(_document(result, outputs, evaluations, config))
    else:
        _print_result(result, outputs, evaluations, report_dir)
    return 0


def _save(result: FusionResult, outputs: _Outputs) -> None:
    """Write the fused and the agreement map, both or neither."""
    from slamfusion.io import AtomicFiles, save_map  # noqa: PLC0415

    folder = outputs.fused.parent
    with TemporaryDirectory(prefix="slamfusion-") as name, AtomicFiles() as files:
        staging = Path(name)
        try:
            save_map(result.fused, staging / outputs.fused.name, mode="trinary")
            save_map(result.agreement, staging / outputs.agreement.name, mode="raw")
        except MapFileError as error:  # name the file that was wanted, not its draft
            raise MapFileError(str(error).replace(name, str(folder))) from None
        for made in sorted(staging.iterdir()):
            files.add(folder / made.name, made.read_bytes())


def _rejections(result: FusionResult) -> str:
    """Say how many inputs were fused and what became of the others."""
    text = f"fused {len(result.accepted)} of {len(result.inputs)} inputs"
    if result.rejected:
        reasons = ", ".join(f"{record.name}: {record.reason}" for record in result.rejected)
        text += f"; rejected: {reasons}"
    return text


def _document(
    result: FusionResult,
    outputs: _Outputs,
    evaluations: Sequence[Evaluation],
    config: RunConfig,
) -> dict[str, Any]:
    """Return the JSON document of a fusion."""
    from slamfusion.evaluation import doubled_wall_share  # noqa: PLC0415

    normalize = config.fusion.normalize
    doubled = {
        record.name: doubled_wall_share(record.grid, normalize=normalize)
        for record in result.inputs
    }
    return {
        "inputs": [_input(record, result.reference) for record in result.inputs],
        "reference": result.reference,
        "fused": f"{outputs.fused}.yaml",
        "agreement": f"{outputs.agreement}.yaml",
        "fused_count": len(result.accepted),
        "phantom_cells": result.phantom_cells,
        "doubled_wall_share": {
            "inputs": doubled,
            "fused": doubled_wall_share(result.fused, normalize=normalize),
            "added_by_fusion": _added_doubled(result),
        },
        "weights": result.weights,
        "pairs": [pair.to_json() for pair in result.pairs],
        "evaluations": [evaluation.to_json() for evaluation in evaluations],
        **_circumstances(config, result.device),
        "time_s": result.time_s,
    }


def _added_doubled(result: FusionResult) -> float:
    """Return the share of fused wall cells that are doubled in no input."""
    from slamfusion.evaluation import added_doubled_share  # noqa: PLC0415

    cells = result.fused.cells
    aligned = [record.aligned for record in result.accepted if record.aligned is not None]
    return added_doubled_share(np.sign(cells).astype(np.int8), aligned)


def _circumstances(config: RunConfig, device: str) -> dict[str, Any]:
    return {
        "device": device,
        "seed": config.seed,
        "config": to_mapping(config),
        "versions": versions(),
    }


NO_ALIGNMENT = {
    "dx_m": None,
    "dy_m": None,
    "yaw_rad": None,
    "score": None,
    "overlap": None,
    "error": None,
    "runner_up": None,
    "bound_gap": None,
    "time_s": None,
}


def _input(record: InputRecord, reference: str | None) -> dict[str, Any]:
    """Return one input's record: its alignment, and what became of it."""
    alignment = NO_ALIGNMENT if record.alignment is None else record.alignment.to_json()
    return {
        **alignment,
        "name": record.name,
        "reference": record.alignment.reference if record.alignment else reference,
        "accepted": record.accepted,
        "reason": record.reason,
    }


def _print_result(
    result: FusionResult,
    outputs: _Outputs,
    evaluations: Sequence[Evaluation],
    report_dir: Path | None,
) -> None:
    """Print the alignments, the evaluation and where everything went."""
    print_table(
        PAIR_COLUMNS[1:],
        [_row(record, result.reference) for record in result.inputs],
        title=f"Alignment to {result.reference}, on {result.device}",
    )
    print(_rejections(result))
    print(
        f"{result.phantom_cells} phantom cells, {_added_doubled(result):.1%} of the walls doubled "
        f"by the fusion, {result.time_s:.2f} s"
    )
    if evaluations:
        print()
        print_evaluations(evaluations)
    print(f"fused map: {outputs.fused}.yaml")
    print(f"agreement: {outputs.agreement}.yaml")
    if report_dir is not None:
        print(f"report:    {report_dir}")


PAIR_COLUMNS = (
    "reference ",
    "input ",
    "accepted ",
    "dx m",
    "dy m",
    "yaw deg",
    "score",
    "overlap",
    "runner-up",
    "gap",
    "time s",
    "reason ",
)


def _row(record: InputRecord, reference: str) -> list[str]:
    """Return an input's row of the alignment table."""
    accepted = "yes" if record.accepted else "NO"
    if record.name == reference:
        accepted = "reference"
    if record.alignment is None:
        return [record.name, accepted, *["-"] * 8, record.reason]
    return [record.name, *_cells(record.alignment, accepted)[1:-1], record.reason]


def _cells(found: Alignment, accepted: str) -> list[str]:
    """Return an alignment's cells of the table, from the input's name to the reason."""
    return [
        found.moving,
        accepted,
        number(found.transform.x),
        number(found.transform.y),
        number(math.degrees(found.transform.yaw_rad), 2),
        number(found.score),
        number(found.overlap),
        number(None if found.runner_up is None else found.runner_up.ratio, 2),
        number(found.bound_gap),
        number(found.time_s, 2),
        found.reason,
    ]


class _AllRequiredError(AlignmentError):
    """A fusion that had to leave an input out, where ``--require-all`` forbids it."""

    def __init__(self, result: FusionResult) -> None:
        rejected = ", ".join(f"{record.name} ({record.reason})" for record in result.rejected)
        super().__init__(f"--require-all, but rejected: {rejected}; nothing was fused")
        self.pairs = result.pairs
        self.result = result


def _report_failure(
    error: AlignmentError,
    grids: Sequence[OccupancyGrid],
    config: RunConfig,
    device: str,
    report_dir: Path | None,
    as_json: bool,
) -> None:
    """Show what was tried: the report, and the JSON document or the table of pairs."""
    pairs: tuple[Alignment, ...] = getattr(error, "pairs", ())
    if report_dir is not None:
        from slamfusion.report import write_failure_report, write_fusion_report  # noqa: PLC0415

        if isinstance(error, _AllRequiredError):
            write_fusion_report(error.result, report_dir, config=config, failure=str(error))
        else:
            write_failure_report(grids, pairs, str(error), report_dir, config=config, device=device)
    if not as_json:
        print_table(
            PAIR_COLUMNS,
            [[pair.reference, *_cells(pair, _verdict(pair))] for pair in pairs],
            title=f"Nothing was fused, on {device}",
        )
        return
    print_json(
        {
            "inputs": [
                {
                    **NO_ALIGNMENT,
                    "name": grid.name,
                    "reference": None,
                    "accepted": False,
                    "reason": _reason(grid.name, pairs, str(error)),
                }
                for grid in grids
            ],
            "reference": None,
            "fused": None,
            "agreement": None,
            "fused_count": 0,
            "phantom_cells": None,
            "doubled_wall_share": None,
            "weights": {},
            "pairs": [pair.to_json() for pair in pairs],
            "evaluations": [],
            "error": str(error),
            **_circumstances(config, device),
            "time_s": None,
        }
    )


def _verdict(pair: Alignment) -> str:
    return "yes" if pair.accepted else "NO"


def _reason(name: str, pairs: Sequence[Alignment], otherwise: str) -> str:
    """Return why an input found no partner: the reason of its best rejected pair."""
    rejected = [
        pair for pair in pairs if name in {pair.reference, pair.moving} and not pair.accepted
    ]
    if not rejected:
        return otherwise
    best = max(rejected, key=lambda pair: pair.score)
    other = best.reference if best.moving == name else best.moving
    return f"against {other}: {best.reason}"
