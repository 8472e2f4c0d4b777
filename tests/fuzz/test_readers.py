"""Whatever a file holds, its reader ends in a value or in one line, soon and in little memory."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.fuzz.corpus import CORPUS
from tests.fuzz.readers import Seed, seeds
from tests.fuzz.run import Counts, OverTimeError, limits, run_mutants, run_one, table
from tests.support.examples import examples

pytestmark = pytest.mark.once
EVERY_RUN = 200
FULL_RUN = 100_000


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> list[Seed]:
    return seeds(tmp_path_factory.mktemp("seeds"))


def place(seed: Seed, folder: Path) -> None:
    """Put the file beside a seed there."""
    if seed.beside is not None:
        (folder / seed.beside[0]).write_bytes(seed.beside[1])


def test_every_good_file_is_read(good: list[Seed], tmp_path: Path) -> None:
    """A seed that is refused would hide whatever lies behind the refusal."""
    for seed in good:
        place(seed, tmp_path)
        counts = Counts()
        run_one(seed, seed.data, tmp_path, counts, "as it is")
        assert (counts.read, counts.refused, counts.failures) == (1, 0, []), seed.title


def assert_clean(counts: dict[str, Counts], mutants: int) -> None:
    print(table(counts))
    failures = [failure for one in counts.values() for failure in one.failures]
    assert not failures, "\n".join(failures[:5])
    assert sum(one.total for one in counts.values()) == mutants
    assert sum(one.refused for one in counts.values()) > mutants // 4


def test_mutants_end_in_a_value_or_in_one_line(tmp_path: Path) -> None:
    assert_clean(run_mutants(EVERY_RUN, tmp_path), EVERY_RUN)


@pytest.mark.full
def test_a_hundred_thousand_mutants_end_so_too(tmp_path: Path) -> None:
    assert_clean(run_mutants(FULL_RUN, tmp_path, first=EVERY_RUN), FULL_RUN)


@settings(max_examples=examples(60), suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_bytes_of_any_kind_do_so_too(good: list[Seed], tmp_path: Path, data: st.DataObject) -> None:
    """What hypothesis finds it also makes small."""
    seed = data.draw(st.sampled_from(good), label="seed")
    head = data.draw(st.sampled_from((b"", seed.data[:8], seed.data[: len(seed.data) // 2])))
    rest = data.draw(st.binary(max_size=200) | st.text(max_size=200).map(str.encode))
    place(seed, tmp_path)
    counts = Counts()
    run_one(seed, head + rest, tmp_path, counts, "of hypothesis")
    assert not counts.failures


@pytest.mark.parametrize("name", CORPUS)
def test_what_has_once_gone_wrong_is_one_line(good: list[Seed], tmp_path: Path, name: str) -> None:
    reader, suffix, make = CORPUS[name]
    seed = next(item for item in good if item.reader == reader and item.name.endswith(suffix))
    place(seed, tmp_path)
    counts = Counts()
    run_one(seed, make(seed.data), tmp_path, counts, name)
    assert (counts.refused, counts.failures) == (1, [])


# -- what would find nothing would never fail ------------------------------------------------------


def failing(read: Callable[[Path], object], folder: Path) -> list[str]:
    counts = Counts()
    run_one(Seed("none", "a.txt", b"", read), b"", folder, counts, 7)
    return counts.failures


def test_a_traceback_a_long_line_and_a_hang_are_found(tmp_path: Path) -> None:
    def fails(_: Path) -> object:
        return dict[str, int]()["none"]

    def talks(path: Path) -> object:
        raise OSError(f"{path}\n")

    assert "KeyError" in failing(fails, tmp_path)[0]
    assert "a message of" in failing(talks, tmp_path)[0]
    assert "MemoryError" in failing(lambda _: bytearray(3 << 30), tmp_path)[0]
    assert failing(lambda _: 1, tmp_path) == []

    def hang() -> None:
        with limits(time_s=0.05):
            while True:
                pass

    with pytest.raises(OverTimeError):
        hang()
