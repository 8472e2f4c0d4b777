"""Measure the graph SLAM, part by part: accuracy, time, more buildings, loops, events.

    python -m tests.benchmarks.bench_graph --part recordings --seeds 5 --maps out/bench_graph

recordings: mean translation over all relations [K09] at the end, as first reported, and of the best
trajectory in the folder (the floor), which ends early on Intel: ours is given on its relations too;
the relations at scans apart; times.
logs: gmapping-corrected logs of more buildings, driven by their reconstructed odometry. With --maps
a map and a report of each, to be looked at: there is no truth.
floors: simulated loops of 100 m and 300 m and places that look alike; closures that join what is
over 0.5 m or 0.1 rad apart are false.
events: an hour without a scan, a robot that is carried away, a log that starts in mid-loop.

A simulated part drives another course with every seed. With --maps the first seed's maps are
written as PNG, to be looked at: --first-seed chooses which. --config takes a YAML file of settings,
as the command line does.
"""

from __future__ import annotations

from tests.benchmarks.graph.recorded import logs, recordings
from tests.benchmarks.graph.simulated import events, floors
from tests.benchmarks.parts import Parts, measure, parser_of

PRODUCER = "graph"
PARTS: Parts = {
    "recordings": (recordings, 5),
    "logs": (logs, 1),
    "floors": (floors, 5),
    "events": (events, 3),
}


def main() -> None:
    parser = parser_of(PARTS, __doc__, "5; events 3, logs 1")
    parser.add_argument(
        "--only", action="append", metavar="NAME", help="drive, log, floor or event"
    )
    options = parser.parse_args()
    measure(PARTS, options, PRODUCER, 230, options.only or ())


if __name__ == "__main__":
    main()
