"""``slamfusion fuse``: align saved maps and let them vote."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from slamfusion.cli.earlier import FAILED, failure_folder, remove_empty, report_files
from slamfusion.cli.evaluate import Evaluation, evaluate_maps, print_evaluations
from slamfusion.cli.fused import (
    AllRequiredError,
    DoubledWalls,
    circumstances,
    failure_document,
    fusion_document,
    fusion_sentences,
    print_alignments,
    print_pairs,
)
from slamfusion.cli.inputs import check_writable, load_maps
from slamfusion.cli.options import (
    common_options,
    file_option,
    map_resolution_option,
    report_option,
    with_config,
)
from slamfusion.cli.output import notice, print_json, progress_bar
from slamfusion.config import RunConfig
from slamfusion.errors import AlignmentError, SlamFusionError
from slamfusion.grid import OccupancyGrid

if TYPE_CHECKING:
    from slamfusion.fusion.records import Alignment, FusionResult
    from slamfusion.jobs.records import FailedFuseDocument, FuseDocument

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
@file_option(
    "--truth", "truth_path", "MAP", "Evaluate every input and the fused map against this one."
)
@report_option("report_dir")
@map_resolution_option
@with_config(
    "fusion",
    "fusion.normalize",
    "fusion.align",
    "fusion.vote",
    "map_files",
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
    from slamfusion.compute import open_device  # noqa: PLC0415
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
    grids = load_maps(maps, resolution, config.map_files)
    truth = None if truth_path is None else load_maps([truth_path], resolution, config.map_files)[0]
    device = open_device(config.device.device)

    evaluations: list[Evaluation] = []
    try:
        with progress_bar() as progress:
            result = fuse_grids(grids, config.fusion, device, progress)
            if config.fusion.require_all and result.rejected:
                raise AllRequiredError(result)
            if truth is not None:
                judged = [*grids, result.fused.with_name("fused")]
                evaluations = evaluate_maps(judged, truth, config, device, progress=progress)
    except AlignmentError as error:
        _report_failure(error, grids, config, device.name, report_dir, as_json)
        raise

    _save(result, outputs, evaluations, config, report_dir)
    for record in result.rejected:
        notice(f"rejected: {record.name}: {record.reason}")
    if as_json:
        document: FuseDocument = {
            **fusion_document(result, DoubledWalls.of(result, config)),
            "fused": f"{outputs.fused}.yaml",
            "agreement": f"{outputs.agreement}.yaml",
            "evaluations": [evaluation.to_json() for evaluation in evaluations],
            **circumstances(config, result.device),
            "time_s": result.time_s,
        }
        print_json(document)
    else:
        _print_result(result, outputs, evaluations, config, report_dir)
    return 0


def _save(
    result: FusionResult,
    outputs: _Outputs,
    evaluations: Sequence[Evaluation],
    config: RunConfig,
    report_dir: Path | None,
) -> None:
    """Write the fused map, the agreement and the report, all or none."""
    from slamfusion.io import AtomicFiles, save_map  # noqa: PLC0415

    with AtomicFiles() as files:
        save_map(result.fused, outputs.fused, files=files)
        save_map(result.agreement, outputs.agreement, mode="raw", files=files)
        if report_dir is not None:
            from slamfusion.report import write_fusion_report  # noqa: PLC0415

            errors = [evaluation.error for evaluation in evaluations]
            write_fusion_report(result, report_dir, config=config, evaluations=errors, files=files)
            for path in report_files(report_dir / FAILED):
                files.remove(path)
    if report_dir is not None:
        remove_empty(report_dir / FAILED)


def _print_result(
    result: FusionResult,
    outputs: _Outputs,
    evaluations: Sequence[Evaluation],
    config: RunConfig,
    report_dir: Path | None,
) -> None:
    """Print the alignments, the evaluation and where everything went."""
    print_alignments(result)
    for sentence in fusion_sentences(result, DoubledWalls.of(result, config)):
        print(sentence)
    if evaluations:
        print()
        print_evaluations(evaluations)
    print(f"fused map: {outputs.fused}.yaml")
    print(f"agreement: {outputs.agreement}.yaml")
    if report_dir is not None:
        print(f"report:    {report_dir}")


def _report_failure(
    error: AlignmentError,
    grids: Sequence[OccupancyGrid],
    config: RunConfig,
    device: str,
    report_dir: Path | None,
    as_json: bool,
) -> None:
    """Show what was tried: the report, and the JSON document or the table of pairs.

    The report of an earlier fusion stays, as its map does.
    """
    pairs: tuple[Alignment, ...] = getattr(error, "pairs", ())
    if report_dir is not None:
        from slamfusion.report import write_failure_report, write_fusion_report  # noqa: PLC0415

        folder = failure_folder(report_dir, report_files(report_dir))
        if isinstance(error, AllRequiredError):
            write_fusion_report(error.result, folder, config=config, failure=str(error))
        else:
            write_failure_report(grids, pairs, str(error), folder, config=config, device=device)
    if not as_json:
        print_pairs(pairs, device)
        return
    document: FailedFuseDocument = {
        **failure_document(grids, pairs, str(error)),
        "fused": None,
        "agreement": None,
        "evaluations": [],
        "error": str(error),
        **circumstances(config, device),
        "time_s": None,
    }
    print_json(document)
