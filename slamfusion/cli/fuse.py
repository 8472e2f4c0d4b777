"""``slamfusion fuse``: align saved maps and let them vote."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from slamfusion import jobs
from slamfusion.cli import options, output, tables
from slamfusion.cli.help import Choice, Command, Number
from slamfusion.cli.paths import MAP, stem_of
from slamfusion.cli.results import table_option
from slamfusion.config import PAGE, RunConfig
from slamfusion.errors import AlignmentError
from slamfusion.fleet import executor_for
from slamfusion.io.lines import saved_files
from slamfusion.jobs import outputs
from slamfusion.jobs.inputs import LIKE_PAPER, GivenMaps, PixelSizes, device_for
from slamfusion.jobs.outputs import AGREEMENT_END
from slamfusion.jobs.records import Circumstances


def _files(out: Path, given: Mapping[str, Any]) -> list[Path]:
    """Return what may be written, also for groups that may be found, and such of earlier maps."""
    stem, count = stem_of(out), len(given["maps"]) // 2
    while Path(f"{stem}-{count + 1}{AGREEMENT_END}.yaml").exists():
        count += 1
    groups = outputs.group_stems(stem, count)
    stems = [Path(f"{own}{end}") for own in groups for end in ("", AGREEMENT_END)]
    maps = [saved_files(own, image_format=form) for own in stems for form in ("pgm", "png")]
    return [Path(f"{stem}.json"), *dict.fromkeys(file for both in maps for file in both)]


@click.command(
    "fuse",
    cls=Command,
    examples=[
        "fuse a.yaml b.yaml c.yaml -o out/fused --report out/report",
        "fuse robot1.yaml robot2.yaml -o out/fused --start robot2=12.5,0,90deg",
    ],
)
@click.argument("maps", nargs=-1, required=True, type=MAP)
@options.main_output(
    "out",
    "OUT",
    "Write the fused map OUT.yaml, OUT.pgm, its agreement OUT_agreement.yaml, .pgm and the "
    "record OUT.json. Further groups of maps that overlap only each other: OUT-2.yaml ... "
    "OUT.zarr writes a Zarr store, for maps larger than memory.",
    _files,
)
@options.file("--truth", "truth_path", "MAP", "The true map. Adds the errors of all maps.", MAP)
@options.truth_scale
@click.option(
    "--format",
    "image_format",
    type=Choice(["pgm", "png"]),
    default="pgm",
    help="Image format of the maps. [default: pgm]",
)
@options.report("report_dir", lambda folder, _: [folder, folder / outputs.FAILED])
@options.open_report
@options.start(
    "Expected pose of map NAME. Several starts share one frame. A single start is given in the "
    "frame of the reference or of the only other map."
)
@options.resolution
@options.scheduler("the alignments")
@click.option(
    "--processes",
    type=Number(int, 1, 64),
    metavar="N",
    help="Run the alignments in this number of processes.",
)
@options.settings("fusion.*", "map_files", "evaluate", "report", "device", "", preset=LIKE_PAPER)
@options.common
@table_option
def command(
    maps: tuple[Path, ...],
    out: Path,
    truth_path: Path | None,
    scale: PixelSizes | None,
    report_dir: Path | None,
    image_format: str,
    is_opened: bool,
    starts: options.GivenStarts,
    resolution: float | None,
    scheduler: str | None,
    processes: int | None,
    config: RunConfig,
) -> None:
    """Align saved maps of one place and fuse them by vote.

    MAPS are map_server YAML files, or images together with --resolution. Maps that do not fit are
    named and left out; at least two must fit. The fused map covers all maps that fit, in the frame
    of the first of them.
    """
    message = "--scheduler and --processes: give one of them; --scheduler local:N has processes"
    options.refuse(scheduler is not None and processes is not None, message)
    config = options.with_starts(config, starts)
    store = out if out.suffix == outputs.STORE_END else None
    message = f"--truth and --report look at the whole map, and {out} need not fit into memory"
    options.refuse(store and (truth_path is not None or report_dir is not None), message)
    device = device_for(config)
    try:
        with (
            options.start_errors(starts),
            executor_for(scheduler, processes, config.device.device) as executor,
            output.progress_bar() as progress,
        ):
            fused = jobs.fuse.fuse_maps(
                maps, config, device,
                truth=truth_path, scale=scale, resolution=resolution, store=store,
                executor=executor, progress=progress, warn=output.notice,
            )  # fmt: skip
    except AlignmentError as error:
        # The report of an earlier fusion stays, as its map does.
        if report_dir is not None:
            jobs.fuse.write_failed_fusion(error, config, report_dir, device=device.name)
        circumstances = Circumstances(device.name, config)
        given = GivenMaps.of(maps, resolution)
        failed = jobs.fuse_documents.FuseDocument.failed(error, circumstances, given)
        if not output.print_if_json(failed) and error.pairs:
            tables.print_pairs(error.pairs, device.name)
        raise
    stem = stem_of(out)
    document = (
        fused.document()
        if store
        else jobs.fuse.save_fused_maps(fused, stem, report=report_dir, image_format=image_format)
    )
    output.notice(*map(" ".join, fused.result.remarks))
    for path, own in zip(fused.stores, fused.stems, strict=True):
        if own is None:
            output.notice(f"{path}: too large for a map server; its files are not written")
    if not output.print_if_json(document):
        _print_result(fused, stem, report_dir)
    if is_opened and report_dir is not None:
        click.launch(str(report_dir / PAGE))


def _print_result(fused: jobs.fuse.FusedMaps, stem: Path, report_dir: Path | None) -> None:
    tables.print_fusion(fused.result, fused.doubled, fused.config.fusion.reference)
    print()
    for path, own in zip(fused.stores, fused.stems, strict=True):
        output.print_facts(("fused map", path if own is None else f"{path}, {own}.yaml"))
    if fused.stores:
        return
    if fused.evaluations:
        output.notice(*jobs.fuse_documents.unaligned_sentences(fused.evaluations))
        tables.print_evaluations(fused.evaluations)
    others = fused.result.others
    _, *stems = outputs.group_stems(stem, 1 + len(others))
    quoted = shlex.quote(f"{stem}.yaml")
    output.print_facts(
        ("fused map", f"{stem}.yaml"),
        *[("agreement", f"{stem}{AGREEMENT_END}.yaml")] * output.is_verbose(),
        *(
            (f"group {number}", f"{own}.yaml ({', '.join(item.name for item in other.accepted)})")
            for number, (other, own) in enumerate(zip(others, stems, strict=True), start=2)
        ),
        ("report", report_dir and report_dir / PAGE),
        *output.map_server_facts(Path(f"{stem}.yaml")),
        ("next", f"slamfusion show {quoted}"),
        *[("", f"slamfusion evaluate {quoted} --truth TRUE_MAP.yaml")] * (not fused.evaluations),
    )
