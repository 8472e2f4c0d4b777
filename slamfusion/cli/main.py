"""Entry points of the ``slamfusion`` command and of the programs that ``ros2 run`` starts.

Exit codes: 0 done; 1 expected failure, with one line on stderr; 2 wrong usage; 130 interrupted;
141 the reader of the output is gone.
"""

from __future__ import annotations

import contextlib
import gc
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from slamfusion.cores import GC_OBJECTS


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and exit with the documented code."""
    gc.set_threshold(GC_OBJECTS)
    # For BLAS, before NumPy is imported, and for the processes that this one starts: its threads
    # wait busily for work that comes in small pieces.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        from slamfusion.cli.program import run_program  # noqa: PLC0415 - loads slowly

        code = run_program(words)
    except KeyboardInterrupt:  # while that was loading
        with contextlib.suppress(OSError, AttributeError):
            print("slamfusion: interrupted", file=sys.stderr)
        code = 130
    sys.exit(code)


def node() -> None:
    """Run the node that this program is named after (``NAME_node``); never returns."""
    main(["node", Path(sys.argv[0]).name.removesuffix("_node"), *sys.argv[1:]])
