"""The files that jobs write, and earlier results in the same folder.

A failed job writes into ``failed`` in the folder and keeps earlier results; a successful one
replaces all of them at once, ``failed`` too.
"""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from slamfusion.config import PAGE, PICTURE_FORMS, PICTURES
from slamfusion.io.lines import saved_files

# The files of a producer's run: the map, its picture, the path and the record.
SUFFIXES = (".yaml", ".pgm", ".tum", ".json")
# The map with its probabilities, where that is asked for: the map itself has three classes.
PROBABILITY = "_probability"
PROBABILITY_SUFFIXES = (f"{PROBABILITY}.yaml", f"{PROBABILITY}.png")
FAILED = "failed"
# What a run calls its maps and the folder of its report.
FUSED, REPORT = "fused", "report"
# Added to the name of a fused map: the map of how many agreed.
AGREEMENT_END = "_agreement"
AGREEMENT = FUSED + AGREEMENT_END
# What a run calls the map that is drawn at the fused path.
DRAWN = "drawn"
# Folder of finished runs in that of an experiment, which a later one goes on with.
TRIALS = "trials"
# How the name of a store ends, of a fused map that is written tile by tile.
STORE_END = ".zarr"
# The file of the fused path.
FUSED_PATH = FUSED + ".tum"
# The record of a run that made a fused map: its JSON document.
RUN_RECORD = FUSED + ".json"
# What the alignment of a floor plan calls the plan and the map that lies in its frame, the plan's
# world file, and the picture of both.
PLAN, PLACED, WORLD_FILE, OVERLAY = "plan", "map", "plan.pgw", "overlay.png"


def output_files(stem: Path, *, probabilities: bool = False) -> list[Path]:
    """Return the files that a run writes: map, its picture, path, record; then probabilities."""
    suffixes = (*SUFFIXES, *PROBABILITY_SUFFIXES) if probabilities else SUFFIXES
    return [stem.with_name(stem.name + suffix) for suffix in suffixes]


def failure_folder(folder: Path, results: Iterable[Path]) -> Path:
    """Return where the files of a failed job go: ``failed`` in a folder that holds results."""
    return folder / FAILED if any(path.exists() for path in results) else folder


def possible_report(folder: Path) -> list[Path]:
    """Return the page of a report, and what of a folder its pictures may replace."""
    pictures = [folder.glob(f"{PICTURES}.{form}") for form in PICTURE_FORMS]
    return [folder / PAGE, *sorted(path for paths in pictures for path in paths)]


def remove_empty(*folders: Path) -> None:
    """Remove folders in which nothing is left; in this order."""
    for folder in folders:
        with suppress(OSError):
            folder.rmdir()


def possible_outputs(folder: Path) -> list[Path]:
    """Return every file that a run into a folder may write, but for the report's."""
    from slamfusion.slam.registry import producer_names  # noqa: PLC0415  (the SLAMs load slowly)

    names = [folder / name for name in producer_names()]
    files = [path for name in names for path in output_files(name, probabilities=True)]
    files += [file for name in (FUSED, AGREEMENT, DRAWN) for file in saved_files(folder / name)]
    return [*files, folder / FUSED_PATH, folder / RUN_RECORD]


def group_stems(stem: Path, count: int) -> list[Path]:
    """Return the paths, without suffix, of the fused maps of groups: OUT, OUT-2, OUT-3 ..."""
    return [stem, *(stem.with_name(f"{stem.name}-{number}") for number in range(2, count + 1))]


def plan_files(folder: Path) -> list[Path]:
    """Return the files that the alignment of a floor plan writes."""
    maps = [saved_files(folder / stem, image_format="png") for stem in (PLAN, PLACED)]
    return [*maps[0], *maps[1], folder / WORLD_FILE, folder / OVERLAY]
