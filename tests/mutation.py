"""Change what decides whether a map is believed, one place at a time, and see that a test fails.

    python -m tests.mutation --at-least 0.9
    python -m tests.mutation accept --show

Each mutant runs the tests of its module in a pytest process of its own, forked from this one, which
has loaded the libraries and nothing of slamfusion; the changed module is given on import, the files
stay as they are. Killed is a mutant that a test fails with; one that runs out of time is not.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import importlib.abc
import importlib.machinery
import os
import signal
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import pytest
from hypothesis import HealthCheck, Phase, settings

from tests.support.mutants import Mutant, mutants_of

ROOT = Path(__file__).resolve().parents[1]
# A mutant has this many times as long as the module without a change, and some seconds.
TIMES, SPARE_S = 5.0, 20.0
POLL_S = 0.02
# What every run would load again; without it the run is as right, and slower.
LIBRARIES = ("numpy", "scipy.ndimage", "cv2", "hypothesis.strategies", "yaml", "rich.console")
# Whether a test fails is asked, and not for the smallest example.
settings.register_profile(
    "mutants",
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
    phases=[Phase.explicit, Phase.generate],
)


@dataclass(frozen=True)
class Target:
    """A module and the tests that are to notice every change of it.

    Attributes:
        module: dotted name.
        tests: files below the repository's root, the quickest first.
        equivalent: mutants that answer as the module does, by ``Mutant.key``, and why.
    """

    module: str
    tests: tuple[str, ...]
    equivalent: dict[tuple[str, str], str]

    @property
    def path(self) -> Path:
        """The module's file."""
        return ROOT / f"{self.module.replace('.', '/')}.py"

    @property
    def name(self) -> str:
        """The last part of the module's name."""
        return self.module.rpartition(".")[2]


# Mutants of these answer as the module does, each for its reason.
ACCEPT = {
    (
        "_decide_fit",
        (
            "excess = (match - chance) / (1.0 - chance) if chance < 1.0 else 0.0"
            " => excess = (match - chance) / (1.0 - chance) if chance < 1.0 else 0.1"
        ),
    ): "any excess below EXCESS_MIN says the same",
    (
        "Evidence.undecided",
        "return 1.0 if self.is_cut else self.gap => return 1.1 if self.is_cut else self.gap",
    ): "what is undecided counts as 1 at most",
    (
        "_decide",
        "abs(evidence.scale - 1.0) >= SCALE_MAX => abs(evidence.scale - 1.0) > SCALE_MAX",
    ): "no scale that float64 knows is just 0.03 from 1",
    (
        "_decide",
        "abs(evidence.scale - 1.0) >= SCALE_SAID => abs(evidence.scale - 1.0) > SCALE_SAID",
    ): "nor 0.01",
    **{
        (
            "piece_weight",
            f"max(1.0 - share, 1e-09) => max(1.0 - share, {least})",
        ): "all of it explained is worth the most either way, and no share is as near to that"
        for least in (1.1000000000000001e-09, 9.000000000000001e-10)
    },
}
CONSISTENCY = {
    (
        "largest_group",
        "range(len(names), 1, -1) => range(len(names), 0, -1)",
    ): "the first input alone is also what is returned where no group is found",
    (
        "_closes",
        "turn > CLOSURE_YAW_RAD => turn >= CLOSURE_YAW_RAD",
    ): "no turn that wrap_angle rounds to equals the limit",
    (
        "_stands",
        (
            "{pair.reference, pair.moving} <= set(members)"
            " => {pair.reference, pair.moving} < set(members)"
        ),
    ): "no other pair puts two that are alone anywhere",
    (
        "_grown_group",
        "key <= set(trial) => key < set(trial)",
    ): "a trial has three members at least, a key two",
    (
        "_grown_group",
        (
            "rank_of(group, names) > rank_of(best, names)"
            " => rank_of(group, names) >= rank_of(best, names)"
        ),
    ): "groups of one rank are one group",
}
RIVALS = {
    (
        "_is_believed",
        (
            "plain.wrong(pairs, found.prior) < EXPECTED_WRONG_MAX"
            " => plain.wrong(pairs, found.prior) <= EXPECTED_WRONG_MAX"
        ),
    ): "no pieces that a table has make the exponential just a hundredth",
    (
        "_others",
        "range(1, len(motions)) => range(0, len(motions))",
    ): "the first is no other answer than itself",
    (
        "is_distinct",
        "turn > DISTINCT_YAW_RAD => turn >= DISTINCT_YAW_RAD",
    ): "no turn that displacement rounds to equals the limit",
}
TRACKING = {
    (
        "Tracker",
        "step_s: float = 0.0 => step_s: float = 0.1",
    ): "not read before the second pose, which sets it; until then the step is none",
    (
        "Tracker",
        "stamp_s: float = 0.0 => stamp_s: float = 0.1",
    ): "not read before the first pose, which sets it",
    (
        "Tracker.match",
        (
            "again.score > match.score + SECOND_SEARCH_GAIN"
            " => again.score >= match.score + SECOND_SEARCH_GAIN"
        ),
    ): "scores are sums of bytes over 255 times the hits: none is just a tenth of 1 above another "
    "but by the rounding of float32",
}
SUPERVISOR = {
    (
        "InputSupervisor.__init__",
        "self._now_s = 0.0 => self._now_s = 0.1",
    ): "every round sets it first",
    (
        "InputSupervisor._choose_reference",
        "reasons and (not self.voters) => reasons or not self.voters",
    ): "a voter is contradicted by nobody, and of those that stand without a vote all are",
    (
        "InputSupervisor._realign",
        (
            "reference is None or not reference.accepted => "
            "reference is None and (not reference.accepted)"
        ),
    ): "a round begins with one that is accepted, and only the last that is due can cost it that: "
    "without another voter nobody is left, and with one that takes its place",
}
ALIGN = {
    (
        "Aligner.restore",
        f"_Searched(score, 1.0, 0.0, '') => _Searched(score, {changed}, '')",
    ): "any clear match is one whose walls must go on to match"
    for changed in ("1.1, 0.0", "0.9, 0.0", "1.0, 0.1")
}
BEGIN = {
    (
        "align_first",
        (
            "t.features(resolution, thresholds, -1.0, device) => "
            f"t.features(resolution, thresholds, {share}, device)"
        ),
    ): "no change at all is more than any share below none"
    for share in ("-1.1", "-0.9")
}
RESOLUTIONS = {
    (
        "odd_resolution",
        "size > typical => size >= typical",
    ): "equal ones are not odd, and have left before",
}
POSES = {
    **{
        (
            "PoseWatch.contradictions",
            change,
        ): "who has most has most, whatever is counted for each and from wherever"
        for change in (
            "rivals.get(name, 0) => rivals.get(name, 1)",
            "rivals.get(name, 0) => rivals.get(name, -1)",
            "rivals[name] = rivals.get(name, 0) + 1 => rivals[name] = rivals.get(name, 0) + 2",
        )
    },
    (
        "_share",
        (
            "return value / limit if limit > 0.0 else math.inf if value > 0.0 else 0.0 => "
            "return value / limit if limit > 0.0 else math.inf if value > 0.0 else 0.1"
        ),
    ): "a tenth is within every share of a limit, as none is",
}
TRACK = {
    (
        "_known_after",
        "overlap(box, new.box) or box => overlap(box, new.box) and box",
    ): "outside of a layer nothing is known, and where none was lost not all of a change is there",
    **{
        ("_around", change): "a strip without a cell knows none"
        for change in (
            "strip.height > 0 and strip.width > 0 => strip.height > 0 or strip.width > 0",
            "strip.height > 0 => strip.height >= 0",
            "strip.height > 0 => strip.height > -1",
            "strip.width > 0 => strip.width >= 0",
            "strip.width > 0 => strip.width > -1",
        )
    },
}

LIVE = "slamfusion.fusion.live"


def _live_tests(*names: str) -> tuple[str, ...]:
    return tuple(f"tests/fusion/live/test_{name}.py" for name in names)


TARGETS = (
    Target("slamfusion.fusion.accept", ("tests/fusion/test_accept.py",), ACCEPT),
    Target("slamfusion.fusion.consistency", ("tests/fusion/test_consistency.py",), CONSISTENCY),
    Target("slamfusion.fusion.rivals", ("tests/fusion/test_rivals.py",), RIVALS),
    Target("slamfusion.fusion.resolutions", ("tests/fusion/test_resolutions.py",), RESOLUTIONS),
    Target("slamfusion.slam.common.tracking", ("tests/slam/common/test_tracking.py",), TRACKING),
    Target("slamfusion.slam.common.state", ("tests/slam/common/test_state.py",), {}),
    Target(
        f"{LIVE}.supervisor", _live_tests("supervisor_rules", "supervisor", "fusion"), SUPERVISOR
    ),
    Target(f"{LIVE}.recovery", _live_tests("recovery_rules", "recovery", "supervisor"), {}),
    Target(f"{LIVE}.align", _live_tests("align_rules", "align"), ALIGN),
    Target(f"{LIVE}.begin", _live_tests("begin"), BEGIN),
    Target(f"{LIVE}.intake", _live_tests("intake"), {}),
    Target(f"{LIVE}.limits", _live_tests("limits"), {}),
    Target(f"{LIVE}.mirror", _live_tests("mirror"), {}),
    Target(f"{LIVE}.poses", _live_tests("poses"), POSES),
    Target(f"{LIVE}.searched", _live_tests("searched", "align_rules"), {}),
    Target(f"{LIVE}.track", _live_tests("track_rules", "track"), TRACK),
)


class Changed(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Gives a changed source where one module is imported."""

    def __init__(self, name: str, path: Path, source: str) -> None:
        self.name, self.path, self.source = name, path, source

    def find_spec(
        self, fullname: str, path: object = None, target: object = None
    ) -> importlib.machinery.ModuleSpec | None:
        del path, target
        if fullname != self.name:
            return None
        return importlib.machinery.ModuleSpec(fullname, self, origin=str(self.path))

    def exec_module(self, module: ModuleType) -> None:
        module.__file__ = str(self.path)
        exec(compile(self.source, str(self.path), "exec"), module.__dict__)  # noqa: S102


@dataclass
class Run:
    """A pytest process under way.

    Attributes:
        mutant: what it runs; None: the module as it is.
        process: its id.
        output: what it prints.
        began_s: when it was started.
    """

    mutant: Mutant | None
    process: int
    output: Path
    began_s: float


def start(target: Target, mutant: Mutant | None, folder: Path, tests: Sequence[str]) -> Run:
    """Start the tests of a module on one mutant."""
    output = folder / f"{time.monotonic_ns()}.txt"
    began_s = time.monotonic()
    process = os.fork()
    if process:
        return Run(mutant, process, output, began_s)
    code = 99
    try:
        os.setsid()
        written = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        os.dup2(written, 1)
        os.dup2(written, 2)
        os.chdir(ROOT)
        source = target.path.read_text() if mutant is None else mutant.source
        sys.meta_path.insert(0, Changed(target.module, target.path, source))
        options = ("-x", "-q", "--tb=line", "-p", "no:cacheprovider", "-p", "no:faulthandler")
        examples = ("--hypothesis-seed=0", "--hypothesis-profile=mutants")
        for test in tests:  # one after the other: the quick ones first
            code = int(pytest.main([*options, *examples, test]))
            if code != pytest.ExitCode.OK:
                break
        sys.stdout.flush()
    finally:
        os._exit(code)


def results(
    target: Target,
    mutants: Sequence[Mutant | None],
    folder: Path,
    limit_s: float,
    jobs: int,
    tests: Sequence[str],
) -> Iterator[tuple[Mutant | None, str, float]]:
    """Yield each mutant with ``killed``, ``survived``, ``timeout``, and how long it took."""
    waiting, running = list(mutants), list[Run]()
    while waiting or running:
        while waiting and len(running) < jobs:
            running.append(start(target, waiting.pop(0), folder, tests))
        time.sleep(POLL_S)
        for run in tuple(running):
            took_s = time.monotonic() - run.began_s
            process, status = os.waitpid(run.process, os.WNOHANG)
            if process:
                running.remove(run)
                yield run.mutant, _verdict(run, os.waitstatus_to_exitcode(status)), took_s
            elif took_s > limit_s:
                running.remove(run)
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(run.process, signal.SIGKILL)
                os.waitpid(run.process, 0)
                yield run.mutant, "timeout", took_s


def _verdict(run: Run, code: int) -> str:
    if code == pytest.ExitCode.OK:
        return "survived"
    # A module that cannot even be imported interrupts the collection.
    if code in {pytest.ExitCode.TESTS_FAILED, pytest.ExitCode.INTERRUPTED}:
        return "killed"
    message = f"pytest ended with {code}:\n{run.output.read_text()}"
    raise SystemExit(message)


def measure(
    target: Target, folder: Path, jobs: int, *, every: int, is_shown: bool, tests: Sequence[str]
) -> float:
    """Run every mutant of a module, print the figure and return the share of the killed."""
    began_s = time.monotonic()
    ((_, verdict, alone_s),) = results(target, [None], folder, 600.0, 1, tests)
    if verdict != "survived":
        message = f"{target.module}: its tests fail without any change; run them first"
        raise SystemExit(message)
    mutants = mutants_of(target.path.read_text())
    unknown = set(target.equivalent) - {mutant.key for mutant in mutants}
    if unknown:
        message = f"{target.module}: named as equivalent, but no mutants: {sorted(unknown)}"
        raise SystemExit(message)
    tried = [mutant for mutant in mutants if mutant.key not in target.equivalent][::every]
    left: list[tuple[Mutant, str]] = []
    limit_s = TIMES * alone_s * jobs + SPARE_S
    for mutant, verdict, _ in results(target, tried, folder, limit_s, jobs, tests):
        if verdict != "killed" and mutant is not None:
            left.append((mutant, verdict))
            if is_shown:
                print(f"{verdict}: line {mutant.line}, {mutant.where}: {mutant.change}", flush=True)
    killed = 1.0 - len(left) / len(tried)
    out_of_time = sum(verdict == "timeout" for _, verdict in left)
    print(
        f"{target.module}: {len(tried) - len(left)} of {len(tried)} mutants killed ({killed:.1%}), "
        f"{out_of_time} out of time, {len(target.equivalent)} named equivalent, "
        f"{time.monotonic() - began_s:.0f} s",
        flush=True,
    )
    return killed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("modules", nargs="*", help="last parts of their names; all by default")
    parser.add_argument("--at-least", type=float, default=0.0, help="share of the killed, 0 to 1")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--show", action="store_true", help="name the mutants that are left")
    parser.add_argument("--every", type=int, default=1, help="try each n-th mutant only")
    parser.add_argument("--tests", nargs="+", help="other tests than the module's own")
    arguments = parser.parse_args()
    names = [target.name for target in TARGETS]
    for name in arguments.modules:
        if name not in names:
            parser.error(f"no module {name}; there are {', '.join(names)}")
    for library in LIBRARIES:
        importlib.import_module(library)
    if any(name.partition(".")[0] == "slamfusion" for name in sys.modules):
        message = "slamfusion is loaded already: no mutant would take its place"
        raise SystemExit(message)
    began_s, low = time.monotonic(), []
    with tempfile.TemporaryDirectory() as folder:
        for target in TARGETS:
            if not arguments.modules or target.name in arguments.modules:
                tests = arguments.tests or target.tests
                killed = measure(
                    target,
                    Path(folder),
                    arguments.jobs,
                    every=arguments.every,
                    is_shown=arguments.show,
                    tests=tests,
                )
                if killed < arguments.at_least:
                    low.append(target.module)
    print(f"{time.monotonic() - began_s:.0f} s in all")
    if low:
        wanted = f"{arguments.at_least:.0%} of the mutants are to be killed"
        message = f"{wanted}; fewer are in {', '.join(low)}; --show names them"
        raise SystemExit(message)


if __name__ == "__main__":
    main()
