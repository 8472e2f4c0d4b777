"""Run kernels on the Oclgrind simulator: ``python -m tests.kernels.simulated WHAT``.

``checks`` runs every operation on one small size, ``sizes`` on several; ``toys`` runs a kernel that
writes beyond its bounds, one with a race, and a sound one. Oclgrind writes what it finds to the
file that ``OCLGRIND_LOG`` names.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import numpy as np
import pyopencl as cl  # noqa: TID251 - toy kernels

from slamfusion.compute import open_device
from tests.kernels.checks import CHECKS, Sample, differences

SAMPLES = (
    Sample((13, 35), seed=21),
    Sample((1, 37), seed=22),
    Sample((31, 1), seed=23),
    Sample((7, 40), seed=24, known_share=0.0),
    Sample((9, 33), seed=25, away=5000.0),
)
TOYS = """
__kernel void beyond(__global int *cells) { cells[get_global_id(0) + 1] = 1; }
__kernel void race(__global int *cells) { cells[0] += get_global_id(0); }
__kernel void sound(__global int *cells) { cells[get_global_id(0)] += 1; }
"""


def run_checks(samples: Sequence[Sample]) -> int:
    """Run every operation; return how many differ from their twins."""
    device = open_device("oclgrind")
    found = [differences(name, device, sample) for name in CHECKS for sample in samples]
    return sum(1 for words in found if words)


def run_toys() -> int:
    """Run every toy kernel on 16 cells."""
    device = open_device("oclgrind")
    program = cl.Program(device.context, TOYS).build()
    for kernel in program.all_kernels():
        cells = device.upload(np.zeros(16, dtype=np.int32))
        kernel(device.queue, (16,), (4,), cells.buffer)
        device.download(cells)
    return 0


if __name__ == "__main__":
    checked = {"checks": SAMPLES[:1], "sizes": SAMPLES}
    what = sys.argv[1]
    sys.exit(run_checks(checked[what]) if what in checked else run_toys())
