"""Mutants through every reader: ``python -m tests.fuzz.run [MUTANTS] [FIRST]``.

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
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from types import FrameType

from slamfusion.errors import SlamFusionError
from tests.fuzz.mutate import mutant
from tests.fuzz.readers import Seed, repacked_png, seeds

TIME_S = 20.0
MEMORY_BYTES = 2 << 30
# A message is one line; a path may stand in it twice.
LONGEST = 1500
READ, REFUSED = "read", "refused"


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


def run_one(seed: Seed, data: bytes, folder: Path) -> str:
    """Read a file in place of a seed; return ``READ``, ``REFUSED`` or what went wrong."""
    if seed.beside is not None:
        (folder / seed.beside[0]).write_bytes(seed.beside[1])
    path = folder / seed.name
    path.write_bytes(data)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with limits():
                seed.read(path)
    except (SlamFusionError, OSError) as error:
        message = str(error)
        if "\n" in message or len(message) > LONGEST:
            return f"a message of {len(message)} characters"
        return REFUSED
    except (Exception, OverTimeError):  # noqa: BLE001 - that is what is looked for
        return traceback.format_exc(limit=-3)
    return READ


def run_mutants(mutants: int, folder: Path, first: int = 0) -> Iterator[tuple[str, str]]:
    """Yield the name and the outcome of each mutant; each seed has about as many as any other.

    Args:
        mutants: of all seeds together.
        folder: for their files, empty.
        first: number of the first mutant; those of a number are always the same.
    """
    (folder / "seeds").mkdir()
    found = seeds(folder / "seeds")
    for place, seed in enumerate(found):
        for number in range(first + place, first + mutants, len(found)):
            data = mutant(seed.data, number, is_text=seed.is_text)
            if seed.name.endswith(".png") and number % 2:
                data = repacked_png(data)
            yield f"{seed.title} {number}", run_one(seed, data, folder)


def main() -> int:
    """Run as many mutants as asked for; print what failed, twice each kind, and the counts."""
    words = [int(word) for word in sys.argv[1:]]
    mutants, first = [*words, *(1000, 0)[len(words) :]][:2]
    logging.disable(logging.CRITICAL)
    kinds: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        for name, outcome in run_mutants(mutants, Path(folder), first):
            kind = outcome.rstrip().rsplit("\n", 1)[-1][:100]
            kinds[kind] += 1
            if outcome not in {READ, REFUSED} and kinds[kind] <= 2:
                print(f"{name}: {outcome}")
    print(", ".join(f"{count} x {kind}" for kind, count in kinds.most_common()))
    return int(bool(kinds.keys() - {READ, REFUSED}))


if __name__ == "__main__":
    sys.exit(main())
