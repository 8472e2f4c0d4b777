"""Whatever a file holds, its reader ends in a value or in one line, soon and in little memory."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.fuzz.corpus import CORPUS
from tests.fuzz.mutate import mutant
from tests.fuzz.readers import Seed, as_pixels, encoded, repacked_png, seeds
from tests.fuzz.run import READ, REFUSED, OverTimeError, limits, run_mutants, run_one

pytestmark = pytest.mark.once
EVERY_RUN = 200
FULL_RUN = 100_000


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> list[Seed]:
    return seeds(tmp_path_factory.mktemp("seeds"))


def test_every_good_file_is_read(good: list[Seed], tmp_path: Path) -> None:
    """A seed that is refused would hide whatever lies behind the refusal."""
    for seed in good:
        assert run_one(seed, seed.data, tmp_path) == READ, seed.title


@pytest.mark.parametrize(
    ("mutants", "first"),
    [(EVERY_RUN, 0), pytest.param(FULL_RUN, EVERY_RUN, marks=pytest.mark.full)],
)
def test_mutants_end_in_a_value_or_in_one_line(tmp_path: Path, mutants: int, first: int) -> None:
    outcomes = list(run_mutants(mutants, tmp_path, first))
    assert [item for item in outcomes if item[1] not in {READ, REFUSED}][:5] == []
    assert len(outcomes) == mutants
    assert sum(outcome == REFUSED for _, outcome in outcomes) > mutants // 4


@pytest.mark.parametrize("name", CORPUS)
def test_what_has_once_gone_wrong_is_one_line(good: list[Seed], tmp_path: Path, name: str) -> None:
    reader, suffix, make = CORPUS[name]
    seed = next(item for item in good if item.reader == reader and item.name.endswith(suffix))
    assert run_one(seed, make(seed.data), tmp_path) == REFUSED


@pytest.mark.parametrize("kind", ["png", "bmp"])
def test_libraries_that_decode_damaged_pictures_print_nothing(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], kind: str
) -> None:
    """Checksums are made right again, so that it is the pixels that are damaged."""
    seed = Seed("picture", f"a.{kind}", encoded(kind), as_pixels, is_text=False)
    mutants = [mutant(seed.data, number, is_text=False) for number in range(150)]
    data = [repacked_png(own) if kind == "png" else own for own in mutants]
    outcomes = [run_one(seed, own, tmp_path) for own in data]
    assert outcomes.count(REFUSED) > 50
    assert set(outcomes) <= {READ, REFUSED}
    assert capfd.readouterr() == ("", "")


# -- what would find nothing would never fail ------------------------------------------------------


def test_a_traceback_a_long_line_and_a_hang_are_found(tmp_path: Path) -> None:
    def outcome(read: Callable[[Path], object]) -> str:
        return run_one(Seed("none", "a.txt", b"", read), b"", tmp_path)

    def talks(path: Path) -> object:
        raise OSError(f"{path}\n")

    assert "KeyError" in outcome(lambda _: dict[str, int]()["none"])
    assert "a message of" in outcome(talks)
    assert "MemoryError" in outcome(lambda _: bytearray(3 << 30))
    assert outcome(lambda _: 1) == READ

    def hang() -> None:
        with limits(time_s=0.05):
            while True:
                pass

    with pytest.raises(OverTimeError):
        hang()
