"""Assign maps and paths to cases, each named by its ground truth or log.

A file belongs to the case whose name is a word of its file name or of a folder above it:
``graph/intel.tum``, ``intel_graph.tum`` and ``intel/graph.tum`` belong to ``intel``; the other
words name the method: ``graph``. The word ``seed3`` or ``s3`` is the repetition.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from slamfusion.errors import ConfigError
from slamfusion.jobs.inputs import LogFiles

_BETWEEN = r"[-_. ]+"
# The method of files that are named by case and seed only.
ONLY_SEED = "run"
_SEED = re.compile(rf"(?:^|{_BETWEEN})(?:seed[-_. ]?|s)(\d+)(?=$|{_BETWEEN})", re.IGNORECASE)


@dataclass(frozen=True)
class CaseFile:
    """A file and its case; an empty case is derived from the file's name."""

    path: Path
    case: str = ""

    @classmethod
    def parse(cls, text: str) -> CaseFile:
        """Return ``CASE=FILE`` in parts; a file whose own name has a ``=`` stays whole."""
        case, _, rest = text.partition("=")
        if not case or not rest or "/" in case or Path(text).exists():
            return cls(Path(text))
        return cls(Path(rest), case)


@dataclass(frozen=True)
class Placed:
    """A map or path in its case."""

    case: str
    """What it was measured against: a place, a log or a truth, by name."""
    method: str
    """What made it: what its file's name says besides case and seed."""
    path: Path = field(repr=False)
    seed: str = ""
    """Number of the repetition of this method in this case; empty for a single one."""

    @property
    def name(self) -> str:
        """What tells it from the other files of its case."""
        return f"{self.method} seed {self.seed}" if self.seed else self.method

    @property
    def keys(self) -> tuple[str, str, str]:
        """Case, seed and method: what names its rows in a table of results."""
        return self.case, self.seed, self.method


def case_names(files: Sequence[CaseFile]) -> list[str]:
    """Return the distinct names of the cases of truths or logs, in order.

    Raises:
        ConfigError: two have the same name, or a name cannot be a folder's.
    """
    names = [file.case or case_of(file.path) for file in files]
    for name, count in Counter(names).items():
        if count > 1:
            raise ConfigError(f"{count} files of the case {name!r}; write another name: NAME=FILE")
        if name in {"", ".", ".."}:
            raise ConfigError(f"{name!r} cannot name a case; write NAME=FILE")
    return names


def shared_case_names(*kinds: Sequence[CaseFile]) -> list[str]:
    """Return the distinct names of the cases of files of several kinds, in order.

    The kind with the most files names them; on a tie, one with a ``CASE=``. New ``CASE=`` names of
    the other kinds follow. Raises as ``case_names``.
    """
    leading = max(kinds, key=lambda files: (len(files), any(file.case for file in files)))
    names = case_names(leading)
    others = {file.case: file for files in kinds for file in files if file.case}
    return case_names([*leading, *(others[name] for name in others if name not in names)])


def files_by_case(cases: Sequence[str], files: Sequence[CaseFile], what: str) -> dict[str, Path]:
    """Return the file of each case that has one.

    Raises:
        ConfigError: a file belongs to no case or to several, or a case has two files.
    """
    found: dict[str, Path] = {}
    for file in files:
        case = _case_of(cases, file)
        if case in found:
            message = f"{what}: {found[case]} and {file.path} are both of {case!r}; give one a case"
            raise ConfigError(message)
        found[case] = file.path
    return found


def known_files(cases: Sequence[str], **given: Sequence[CaseFile]) -> dict[str, LogFiles]:
    """Return the log of each case and the files that its paths are measured with.

    Args:
        given: files by the name of their option: ``log``, ``relations``, ``odometry``, ``truth``,
            ``scan_odometry``.

    Raises as ``files_by_case``.
    """
    found = {
        kind: files_by_case(cases, own, f"--{kind.replace('_', '-')}")
        for kind, own in given.items()
    }
    return {
        case: LogFiles(**{kind: own.get(case) for kind, own in found.items()}) for case in cases
    }


def measured_inputs(
    placed: Sequence[Placed], known: Mapping[str, LogFiles]
) -> list[tuple[str, str, Path]]:
    """Return role, case and path of paths and of the files that they are measured with."""
    found = [("path", item.case, item.path) for item in placed]
    return found + [file for case, files in known.items() for file in files.inputs(case)]


def place_files(cases: Sequence[str], files: Sequence[CaseFile]) -> list[Placed]:
    """Return the case and method of each map or path, in the order given.

    Methods have the same names in all cases: the file's name without case and seed, and the folders
    needed to distinguish the files of a case. A single case has every file.

    Raises:
        ConfigError: a file belongs to no case, or to several.
    """
    own = [_case_of(cases, file) for file in files]
    parted = [_rest(case, file.path) for case, file in zip(own, files, strict=True)]
    seeds = [seed for _, seed in parted]
    for depth in range(1, max((len(rest) for rest, _ in parted), default=1) + 1):
        methods = ["/".join(reversed(rest[:depth])) for rest, _ in parted]
        if len(set(zip(own, methods, seeds, strict=True))) == len(files):
            break
    seen: Counter[tuple[str, str, str]] = Counter()
    placed = []
    for case, method, seed, file in zip(own, methods, seeds, files, strict=True):
        seen[case, method, seed] += 1
        again = seen[case, method, seed]
        name = method if again == 1 else f"{method}#{again}"
        placed.append(Placed(case, name, file.path, seed))
    return placed


def _case_of(cases: Sequence[str], file: CaseFile) -> str:
    known = ", ".join(cases)
    if file.case:
        if file.case not in cases:
            message = f"{file.case}={file.path}: no case {file.case!r}; wanted one of {known}"
            raise ConfigError(message)
        return file.case
    if len(cases) == 1:
        return cases[0]
    for part in _parts(file.path):
        named = [case for case in cases if _word(case).search(part)]
        # Of "intel" and "intel-910" the longer one is meant.
        named = [
            case
            for case in named
            if not any(case != other and _word(case).search(other) for other in named)
        ]
        if len(named) == 1:
            return named[0]
        if named:
            raise ConfigError(
                f"{file.path}: its name fits {' and '.join(named)}; write CASE={file.path}"
            )
    # A case that is named with its folders: every part of it is a word of the path.
    parts = _parts(file.path)
    named = [
        case
        for case in cases
        if "/" in case and all(any(map(_word(piece).search, parts)) for piece in case.split("/"))
    ]
    if len(named) == 1:
        return named[0]
    raise ConfigError(
        f"{file.path}: its name says none of the cases {known}; write CASE={file.path}, with one "
        "of them for CASE"
    )


def _rest(case: str, path: Path) -> tuple[list[str], str]:
    """Return the words of a path besides case and seed, the file's name first, and the seed."""
    rests, seed = [], ""
    for part in _parts(path):
        rest = _word(case).sub("-", part)
        found = _SEED.search(rest)
        if found and not seed:
            seed, rest = found[1], _SEED.sub("", rest, count=1)
        rests.append(rest.strip("-_. "))
    return [rest for rest in rests if rest] or [ONLY_SEED if seed else case_of(path)], seed


def _parts(path: Path) -> list[str]:
    """Return the parts of a path as it was given, the file's stem first."""
    folders = [part for part in path.parent.parts if part not in {"/", ".", ".."}]
    return [case_of(path), *reversed(folders)]


def _word(case: str) -> re.Pattern[str]:
    """Return what finds a case as words of their own, with what parts them from others."""
    return re.compile(rf"(?:^|{_BETWEEN}){re.escape(case)}(?:$|{_BETWEEN})", re.IGNORECASE)


def case_of(path: Path) -> str:
    """Return a file's name without its suffixes of a format and of gzip."""
    from slamfusion.io.lines import strip_gz  # noqa: PLC0415  (OpenCV loads slowly)

    name = path.name
    if strip_gz(name) != name.lower():
        name = name[: -len(".gz")]
    return Path(name).stem or name
