"""Measure gmapping, part by part: accuracy, time, memory, and what goes wrong with robots.

    python -m tests.benchmarks.bench_gmapping --part recordings --seeds 5 --maps out/bench_gmapping

Of a recorded drive the error is the mean translation over all its relations [K09]; of a simulated
one the root mean square of the absolute trajectory error. A simulated part drives another course
with every seed. With --maps the first seed's maps are written as PNG, to be looked at: --first-seed
chooses which. --config takes a YAML file of settings, as the command line does.
"""

from __future__ import annotations

from slamfusion.slam.registry import BUILT_IN
from tests.benchmarks.gmapping.bench import PRODUCER
from tests.benchmarks.gmapping.large import memory
from tests.benchmarks.gmapping.recorded import no_odometry, particles, recordings
from tests.benchmarks.gmapping.simulated import (
    courses,
    outliers,
    person,
    standing,
    wrong_direction,
)
from tests.benchmarks.parts import Parts, measure, parser_of

PARTS: Parts = {
    "recordings": (recordings, 5),
    "no-odometry": (no_odometry, 5),
    "particles": (particles, 5),
    "wrong-direction": (wrong_direction, 5),
    "courses": (courses, 5),
    "person": (person, 5),
    "outliers": (outliers, 5),
    "memory": (memory, 1),
    "standing": (standing, 1),
}


def main() -> None:
    parser = parser_of(PARTS, __doc__, "5; memory and standing 1")
    parser.add_argument(
        "--producer", choices=tuple(dict.fromkeys((PRODUCER, *BUILT_IN))), default=PRODUCER
    )
    options = parser.parse_args()
    measure(PARTS, options, options.producer, 190)


if __name__ == "__main__":
    main()
