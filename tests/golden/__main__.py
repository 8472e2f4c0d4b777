"""Check or record the corpus: ``python -m tests.golden [--record] [NAME ...]``."""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from pathlib import Path

from tests.golden.corpus import (
    ENVIRONMENT,
    FAILED,
    RECORDED,
    difference,
    load_entries,
    run_entries,
    this_machine,
)

# Lines of a difference that are shown; --long shows all.
SHOWN = 40


def main() -> int:
    """Run the entries; return 1 where one differs from what was recorded."""
    entries = load_entries()
    parser = argparse.ArgumentParser(prog="python -m tests.golden", description=main.__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="entries; default: all")
    parser.add_argument("--record", action="store_true", help="write what is found as expected")
    parser.add_argument("--fast", action="store_true", help="only the part of the test suite")
    parser.add_argument("--long", action="store_true", help="show differences in full length")
    parser.add_argument("--workers", type=int, default=2, help="processes; default: 2")
    asked = parser.parse_args()
    if unknown := set(asked.names) - entries.keys():
        parser.error(f"no entry {', '.join(sorted(unknown))}; there are {', '.join(entries)}")
    chosen = asked.names or [n for n, entry in entries.items() if entry.is_fast or not asked.fast]
    os.environ.update(ENVIRONMENT)
    began, differing, seen = time.monotonic(), [], []
    with tempfile.TemporaryDirectory(prefix="golden-") as work:
        for name, text in run_entries(chosen, Path(work), asked.workers):
            if name not in chosen:
                continue
            seen.append(name)
            entry = entries[name]
            if unlike := difference(entry, text, to_the_digit=asked.record):
                differing.append(name)
                lines = unlike.splitlines()[: None if asked.long else SHOWN]
                print("\n".join([f"=== {name}", *lines]), flush=True)
            if asked.record and not text.startswith(FAILED):
                entry.expected.write_text(text, encoding="utf-8")
    if asked.record:
        _finish_record({entry.expected for entry in entries.values()})
    if left_out := [name for name in chosen if name not in seen]:
        print(f"left out, since shared/datasets is not beside the checkout: {', '.join(left_out)}")
    words = f"{len(seen)} entries in {time.monotonic() - began:.0f} s, {len(differing)} differ"
    print(f"{words}{', recorded' if asked.record else ''}: {' '.join(differing) or '-'}")
    return int(bool(differing) and not asked.record)


def _finish_record(expected: set[Path]) -> None:
    """Note the machine, and remove the texts of entries that are no more."""
    RECORDED.write_text(json.dumps(this_machine(), indent=2) + "\n", encoding="utf-8")
    for path in set(RECORDED.parent.glob("expected/*.txt")) - expected:
        path.unlink()


if __name__ == "__main__":
    sys.exit(main())
