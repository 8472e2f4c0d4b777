"""``slamfusion slam``: one producer of maps on a recorded or simulated drive."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from slamfusion import evaluation, jobs
from slamfusion.cli import options, tables
from slamfusion.cli.help import Command, Number, ProducerGroup
from slamfusion.cli.output import Table, notice, print_facts, print_if_json, progress_bar
from slamfusion.cli.paths import FILE, MAP, stem_of
from slamfusion.cli.results import print_items, table_option
from slamfusion.config import PAGE, RunConfig
from slamfusion.errors import SlamFusionError
from slamfusion.io.files import open_regular
from slamfusion.jobs.cases import case_of
from slamfusion.jobs.outputs import output_files
from slamfusion.json_values import record_keys


def _stems(stem: Path, seeds: Sequence[int]) -> dict[int | None, Path]:
    """Return the stem of the files of each seed; without seeds that of the only run."""
    return {seed: stem.with_name(f"{stem.name}_seed-{seed}") for seed in seeds} or {None: stem}


def _files(out: Path, given: Mapping[str, Any]) -> list[Path]:
    stems = _stems(stem_of(out), given["seeds"]).values()
    return [file for stem in stems for file in output_files(stem, probabilities=True)]


def _state_options(function: Any) -> Any:
    """Give the command of a producer that can go on from a file what that takes."""
    stop_after = click.option(
        "--stop-after", "limit", type=Number(int, 1), metavar="N", help="Stop after N scans."
    )
    resume = options.file(
        "--resume",
        "resume",
        "FILE",
        "Continue from a saved state with its settings; skip the scans of LOG that it knows.",
    )
    save_state = options.output(
        "--save-state", "state", metavar="FILE", help="Write the final state, for --resume."
    )
    return save_state(resume(stop_after(function)))


def _make_command(name: str) -> click.Command:
    """Return the command of one producer; its settings become options."""
    from slamfusion.slam.registry import producer, with_producers  # noqa: PLC0415

    record = producer(name)
    base = with_producers(RunConfig(), [name])

    @click.command(name, cls=Command, examples=[f"slam {name} drive.log.gz -o out/{name}"])
    @click.argument("log", type=FILE)
    @options.main_output(
        "out",
        "OUT",
        "Write the map OUT.yaml, OUT.pgm, the path OUT.tum and the record OUT.json.",
        _files,
    )
    @options.seeds("OUT_seed-N")
    @options.drive_files("path")
    @options.probabilities
    @options.file("--truth", "truth", "FILE", "The true trajectory. Adds the errors of the path.")
    @options.file("--truth-map", "truth_map", "MAP", "The true map. Adds the map errors.", MAP)
    @options.report("report")
    @(_state_options if record.load is not None else lambda function: function)
    @options.settings(
        f"producers.{name}", "log", "trajectory", "map_files", "report", "device", "", base=base
    )
    @options.common
    @table_option
    def run(log: Path, out: Path, seeds: tuple[int, ...], **asked: Any) -> None:
        if not seeds:
            _run(name, log, stem_of(out), **asked)
        else:
            _run_seeds(name, log, _stems(stem_of(out), seeds), **asked)

    run.help = (
        f"Map a log with {record.summary}.\n\n"
        "LOG is a CARMEN or tinySLAM log, or a ROS bag. Without odometry in LOG, the SLAM assumes "
        "constant velocity between scans."
    )
    return run


@click.group("slam", cls=ProducerGroup, make=_make_command)
def command() -> None:
    """Map a log with one SLAM."""


def _run(
    name: str,
    log: Path,
    stem: Path,
    config: RunConfig,
    *,
    probabilities: bool,
    report: Path | None,
    resume: Path | None = None,
    state: Path | None = None,
    **asked: Any,
) -> None:
    options.check_odometry(asked["odometry"], asked["relations"])
    if resume is not None:
        open_regular(resume, SlamFusionError).close()
    with progress_bar() as progress:
        mapped = jobs.map_log.map_log(
            log, name, config, resume=resume, progress=progress, warn=notice, **asked
        )
    saved = jobs.map_log.save_mapped_log(
        mapped, stem, probabilities=probabilities, state=state, report=report
    )
    if mapped.failure is not None:
        message = f"{mapped.failure} (the map and the path were written all the same)"
        raise SlamFusionError(message) from mapped.failure
    notice(*mapped.notices(), of=f"{name}: ")
    if print_if_json(saved):
        return
    _print(mapped.result, log)
    for path in saved.result.files:
        print(path)
    if report is not None:
        print(report / PAGE)


def _run_seeds(
    name: str,
    log: Path,
    stems: Mapping[int | None, Path],
    config: RunConfig,
    *,
    probabilities: bool,
    **asked: Any,
) -> None:
    """Run with each seed, write the files of each, and print one table with their means."""
    message = "--report, --resume and --save-state belong to one run; leave out --seeds"
    for option in ("report", "resume", "state"):
        options.refuse(asked.pop(option, None) is not None, message)
    rows = []
    saved: list[jobs.map_log.MappedLog] = []
    with progress_bar() as progress:
        for done, (seed, stem) in enumerate(stems.items()):
            progress("seeds", done, len(stems))
            own = replace(config, seed=seed or 0)
            mapped = jobs.map_log.map_log(log, name, own, progress=progress, warn=notice, **asked)
            notice(*mapped.notices(), of=f"{name} seed {seed}: ")
            saved.append(jobs.map_log.save_mapped_log(mapped, stem, probabilities=probabilities))
            result = mapped.result
            figures: dict[str, float | None] = {**result.measures.figures()}
            figures["time_per_scan_ms"] = result.run.time_per_scan_ms.mean
            if result.map_error is not None:
                figures |= evaluation.measured.map_figures(result.map_error)
            rows += evaluation.measured.result_rows(case_of(log), str(seed), name, figures)
            if mapped.failure is not None:
                raise SlamFusionError(f"seed {seed}: {mapped.failure}") from mapped.failure
    if not print_if_json({**record_keys(saved[-1]), "producers": [own.result for own in saved]}):
        print_items(rows, "SLAM", ("ate_rmse_m", "relations_mean_m", "error"))
        print_facts(*((f"seed {seed}", f"{stem}.yaml") for seed, stem in stems.items()))


def _print(result: jobs.map_log.ProducerResult, log: Path) -> None:
    run = result.run
    Table(
        ("what ", "value "),
        [[name, value] for name, value in result.figures()],
        title=f"{run.name} on {log}",
        has_head=False,
    ).print()
    for where, sentence in jobs.map_log.run_remarks(run):
        print(f"{where}: {sentence}")
    if result.measures.relations is not None or result.measures.truth is not None:
        tables.print_measures(run.trajectory, result.measures)
    if result.map_error is not None:
        tables.print_evaluations([result.map_error])
