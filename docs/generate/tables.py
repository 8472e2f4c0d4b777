"""The pages' tables of ``slamfusion experiment`` and ``run``, from their documents.

A document is what the command prints with ``--json``. Each table is its columns and its rows, all
texts.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from slamfusion.experiments.real_logs import REFERENCE
from slamfusion.experiments.tinyslam import ATE, RELATIONS
from slamfusion.jobs.outputs import DRAWN
from slamfusion.jobs.records import p_text
from slamfusion.slam.registry import BUILT_IN

__all__ = [
    "TableText",
    "failures",
    "fused_path",
    "ground_obstacle",
    "paths_and_faces",
    "real_logs",
    "repeated_runs",
]

Document = Mapping[str, Any]
TableText = tuple[tuple[str, ...], tuple[tuple[str, ...], ...]]

PRODUCERS = {"tinyslam": "tinySLAM"}
MEASURES = {RELATIONS: "relations", ATE: "ATE"}
# Of a recorded drive: key, name, share of 1 or not, decimals, and what is best.
MAP_FIGURES: tuple[tuple[str, str, float, int, Callable[..., float]], ...] = (
    ("error", "error [F16]", 1.0, 0, min),
    ("wall_f1", "wall F1", 1.0, 3, max),
    ("doubled_wall_share", "doubled walls %", 100.0, 1, min),
)


def ground_obstacle(documents: Sequence[Document]) -> TableText:
    """Return mean ± deviation of each method; below, each vote against the best input."""
    document = _only(documents)
    votes = list(document["overall"])
    methods = [*BUILT_IN, *votes]
    errors = _means(document, "error")
    rows: list[tuple[str, ...]] = []
    for case, own in errors.items():
        least = min(own[name]["mean"] for name in methods)
        cells = [_bold(_spread(own[m], 1), own[m]["mean"] == least) for m in methods]
        rows.append((case, *cells))
        against = {
            item["fusion"]: item for item in document["against_best_input"] if item["case"] == case
        }
        best = _shown(against[votes[0]]["best_input"])
        cells = [_interval(against[name]) if name in against else "" for name in methods]
        rows.append((f"against {best}, 95 %", *cells))
    return ("", *map(_shown, methods)), tuple(rows)


def paths_and_faces(documents: Sequence[Document]) -> TableText:
    """Return the fused path and the drawn map of an experiment with ``--draw`` and all others.

    Raises:
        ValueError: the drives were not drawn.
    """
    document = _only(documents)
    pairs = [item for item in document["comparisons"] if item["first"] in {"fused path", DRAWN}]
    if not any(item["first"] == DRAWN for item in pairs):
        raise ValueError("wanted drives of which maps were drawn; give --draw to the experiment")
    names = {"ate_rmse_m": "ATE m", "faces_f1": "faces F1 at 0.1 m"}
    against = list(dict.fromkeys(item["second"] for item in pairs))
    rows = []
    for (case, figure, first), own in _by(pairs, "case", "figure", "first").items():
        means = _means(document, figure)[case]
        cells = {
            item["second"]: f"{means[item['second']]['mean']:.3f} (p {p_text(item['p_rank'])})"
            for item in own
        }
        what = f"{case}, {names[figure]}, {first}"
        mean = f"{means[first]['mean']:.3f}"
        rows.append((what, mean, *(cells.get(name, "-") for name in against)))
    return ("mean of", "", *map(_shown, against)), tuple(rows)


def failures(documents: Sequence[Document]) -> TableText:
    """Return each vote against the best input, per cent, of all documents side by side.

    Raises:
        ValueError: the documents are not of the same cases.
    """
    by_world = [
        {(item["case"], item["fusion"]): item["ratio"] for item in document["against_best_input"]}
        for document in documents
    ]
    if any(ratios.keys() != by_world[0].keys() for ratios in by_world):
        raise ValueError("wanted documents of the same conditions; found others in one of them")
    cases = list(dict.fromkeys(case for case, _ in by_world[0]))
    votes = list(dict.fromkeys(vote for _, vote in by_world[0]))
    rows = [
        (name, *(_changes((ratios[name, vote] for ratios in by_world), 0) for vote in votes))
        for name in cases
    ]
    overall = [document["overall"] for document in documents]
    for key, name in (("ratio", f"mean of the {len(cases)}"), ("worst", "worst")):
        cells = [_changes((item[vote][key] for item in overall), 1) for vote in votes]
        rows.append(tuple(_bold(cell, key == "ratio") for cell in (name, *cells)))
    sums = [_changes((item[vote]["of_sums"] for item in overall), 1) for vote in votes]
    return ("course, lidar", *votes), (*rows, ("of the sums", *sums))


def real_logs(documents: Sequence[Document]) -> TableText:
    """Return three figures of each map of each recorded drive, the best one bold."""
    document = _only(documents)
    figures = {key: _means(document, key) for key, *_ in MAP_FIGURES}
    logs = next(iter(figures.values()))
    names = list(dict.fromkeys(name for own in logs.values() for name in own))
    rows = []
    for log in logs:
        for number, (key, title, unit, digits, best_of) in enumerate(MAP_FIGURES):
            own = figures[key].get(log, {})
            values = {name: unit * own[name]["mean"] for name in names if name in own}
            best = best_of(values.values()) if len(set(values.values())) > 1 else None
            cells = [
                _bold(f"{values[name]:.{digits}f}", values[name] == best) if name in values else "-"
                for name in names
            ]
            rows.append((log if number == 0 else "", title, *cells))
    return ("log", "", *map(_shown, names)), tuple(rows)


def repeated_runs(documents: Sequence[Document]) -> TableText:
    """Return mean ± deviation (worst) of each method, metres, and p of every two of them."""
    document = _only(documents)
    methods = list(dict.fromkeys(item["method"] for item in document["summaries"]))
    pairs = list(itertools.combinations(methods, 2))
    tested = {
        (item["case"], item["figure"], item["first"], item["second"]): item["p_t"]
        for item in document["comparisons"]
    }
    rows = []
    for case in dict.fromkeys(item["case"] for item in document["summaries"]):
        for figure, name in MEASURES.items():
            own = _means(document, figure).get(case)
            if own is not None:
                cells = [
                    f"{_spread(own[m], 3)} ({own[m]['max']:.3f})" if m in own else "-"
                    for m in methods
                ]
                shown = [p_text(tested.get((case, figure, *pair))) for pair in pairs]
                rows.append((case, name, *cells, *shown))
    heads = [f"p {a} / {b}" for a, b in pairs] if len(pairs) > 1 else ["p"] * len(pairs)
    return ("drive", "measure", *methods, *heads), tuple(rows)


def fused_path(documents: Sequence[Document]) -> TableText:
    """Return the mean translation left on the relations of each path of each run, metres."""
    rows = []
    for document in documents:
        paths = {item["name"]: item for item in document["producers"] if item["failed"] is None}
        paths["fused path"] = document["fused_path"]
        means = {name: item["translation"]["mean"] for name, item in paths.items()}
        best = min(means.values())
        cells = {name: _bold(f"{mean:.4f}", mean == best) for name, mean in means.items()}
        rows.append((Path(document["log"]).name.split(".")[0], cells))
    names = list(dict.fromkeys(name for _, cells in rows for name in cells if name != "fused path"))
    names.append("fused path")
    shown = tuple((log, *(cells.get(name, "-") for name in names)) for log, cells in rows)
    return ("log", *map(_shown, names)), shown


def _only(documents: Sequence[Document]) -> Document:
    if len(documents) != 1:
        raise ValueError(f"wanted one document; found {len(documents)}")
    return documents[0]


def _by(items: Iterable[Document], *keys: str) -> dict[tuple[str, ...], list[Document]]:
    """Return the records in groups, in order."""
    groups: dict[tuple[str, ...], list[Document]] = {}
    for item in items:
        groups.setdefault(tuple(item[key] for key in keys), []).append(item)
    return groups


def _means(document: Document, figure: str) -> dict[str, dict[str, Document]]:
    """Return the summaries of a figure, by case and method; those of a reference are left out."""
    found: dict[str, dict[str, Document]] = {}
    for item in document["summaries"]:
        if item["figure"] == figure and item["method"] != REFERENCE:
            found.setdefault(item["case"], {})[item["method"]] = item
    return found


def _shown(name: str) -> str:
    return PRODUCERS.get(name, name)


def _bold(text: str, is_bold: bool) -> str:  # noqa: FBT001 - of the one thing that it is for
    return f"**{text}**" if is_bold else text


def _spread(summary: Document, digits: int) -> str:
    spread = "" if summary["std"] is None else f" ± {summary['std']:.{digits}f}"
    return f"{summary['mean']:.{digits}f}{spread}"


def _change(ratio: float, digits: int) -> str:
    return f"{100.0 * (ratio - 1.0):+.{digits}f}"


def _changes(ratios: Iterable[float], digits: int) -> str:
    return " / ".join(_change(ratio, digits) for ratio in ratios)


def _interval(item: Document) -> str:
    """Return the interval of a ratio, or the ratio of a single drive, per cent."""
    ends = (item["ratio"],) if item["low"] is None else (item["low"], item["high"])
    return " to ".join(_change(end, 1) for end in ends) + " %"
