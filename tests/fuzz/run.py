"""Mutants through every reader, counted: ``python -m tests.fuzz.run [MUTANTS] [FIRST]``.

Each ends in a value or in one of the errors that the command line turns into one line, within a
time and a memory that no file of a few kilobytes needs; everything else is printed with its seed.
"""

from __future__ import annotations

import contextlib
import logging
import resource
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType

from slamfusion.errors import SlamFusionError
from tests.fuzz.mutate import mutant
from tests.fuzz.readers import Seed, repacked_png, seeds

__all__ = ["Counts", "run_mutants", "run_one"]

TIME_S = 20.0
MEMORY_BYTES = 2 << 30
# A message is one line; a path may stand in it twice.
LONGEST = 1500


@dataclass
class Counts:
    """What came of the mutants of one reader."""

    read: int = 0
    refused: int = 0
    failures: list[str] = field(default_factory=list)
    slowest_s: float = 0.0

    @property
    def total(self) -> int:
        """Mutants."""
        return self.read + self.refused + len(self.failures)


class OverTimeError(BaseException):
    """A mutant took longer than any may; no reader catches it."""


@contextlib.contextmanager
def limits(time_s: float = TIME_S, memory_bytes: int = MEMORY_BYTES) -> Iterator[None]:
    """Let the ``with`` block take this much time and this much more address space at most."""

    def stop(_: int, __: FrameType | None) -> None:
        raise OverTimeError

    used = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * 4096
    before = resource.getrlimit(resource.RLIMIT_AS)
    handler = signal.signal(signal.SIGALRM, stop)
    resource.setrlimit(resource.RLIMIT_AS, (used + memory_bytes, before[1]))
    signal.setitimer(signal.ITIMER_REAL, time_s)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        resource.setrlimit(resource.RLIMIT_AS, before)
        signal.signal(signal.SIGALRM, handler)


def run_one(seed: Seed, data: bytes, folder: Path, counts: Counts, what: object) -> None:
    """Read a file and count what came of it.

    Args:
        seed: whose reader reads it, under its name.
        data: the file.
        folder: where it is written.
        counts: of the reader.
        what: the mutant is called where it fails.
    """
    path = folder / seed.name
    path.write_bytes(data)
    began_s = time.perf_counter()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with limits():
                seed.read(path)
        counts.read += 1
    except (SlamFusionError, OSError) as error:
        message = str(error)
        if "\n" in message or len(message) > LONGEST:
            counts.failures.append(f"{seed.title} {what}: a message of {len(message)} characters")
        else:
            counts.refused += 1
    except (Exception, OverTimeError):  # noqa: BLE001 - that is what is looked for
        counts.failures.append(f"{seed.title} {what}: {traceback.format_exc(limit=-3)}")
    counts.slowest_s = max(counts.slowest_s, time.perf_counter() - began_s)


def run_mutants(mutants: int, folder: Path, first: int = 0) -> dict[str, Counts]:
    """Return the counts by reader; each seed has about as many mutants as any other.

    Args:
        mutants: of all seeds together.
        folder: for their files, empty.
        first: number of the first mutant; those of a number are always the same.
    """
    (folder / "seeds").mkdir()
    found = seeds(folder / "seeds")
    counts: dict[str, Counts] = {}
    for place, seed in enumerate(found):
        own = counts.setdefault(seed.reader, Counts())
        if seed.beside is not None:
            (folder / seed.beside[0]).write_bytes(seed.beside[1])
        for number in range(first + place, first + mutants, len(found)):
            data = mutant(seed.data, number, is_text=seed.is_text)
            if seed.name.endswith(".png") and number % 2:
                data = repacked_png(data)
            run_one(seed, data, folder, own, number)
    return counts


def table(counts: dict[str, Counts]) -> str:
    """Return the counts as lines."""
    lines = [f"{'reader':<16}{'mutants':>9}{'read':>9}{'refused':>9}{'failed':>8}{'slowest':>11}"]
    for name, one in sorted(counts.items()):
        row = f"{one.total:>9}{one.read:>9}{one.refused:>9}{len(one.failures):>8}"
        lines.append(f"{name:<16}{row}{one.slowest_s:>9.2f} s")
    total = sum(one.total for one in counts.values())
    failed = sum(len(one.failures) for one in counts.values())
    return "\n".join([*lines, f"{total} mutants, {failed} failed"])


def main() -> int:
    """Run as many mutants as asked for, print the counts, and what failed."""
    words = [int(word) for word in sys.argv[1:]]
    mutants, first = [*words, *(1000, 0)[len(words) :]][:2]
    logging.disable(logging.CRITICAL)
    with tempfile.TemporaryDirectory() as folder:
        counts = run_mutants(mutants, Path(folder), first)
    kinds: Counter[str] = Counter()
    for one in counts.values():
        for failure in one.failures:
            kinds[failure.rstrip().rsplit("\n", 1)[-1][:100]] += 1
            if kinds[failure.rstrip().rsplit("\n", 1)[-1][:100]] <= 2:
                print(failure)
    print(table(counts))
    return int(bool(kinds))


if __name__ == "__main__":
    sys.exit(main())
