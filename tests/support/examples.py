"""``examples``: how many examples hypothesis draws for a test in this run of the suite.

What is drawn differs from run to run, so that a bit each time finds what much at once would. The
profiles are chosen in ``tests/conftest.py``.
"""

from __future__ import annotations

from hypothesis import settings

# Examples of a test that says no number, under --full.
FULL = 100


def examples(wanted: int) -> int:
    """Return of a number of examples the share that this run draws, at least three.

    Args:
        wanted: under ``--full``.
    """
    return max(min(3, wanted), wanted * settings().max_examples // FULL)
