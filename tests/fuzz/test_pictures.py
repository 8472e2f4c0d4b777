"""Libraries that decode pictures print nothing of their own."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.fuzz.mutate import mutant
from tests.fuzz.readers import Seed, as_pixels, encoded, repacked_png
from tests.fuzz.run import Counts, run_one


@pytest.mark.parametrize("kind", ["png", "bmp"])
def test_damaged_pictures_print_nothing(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], kind: str
) -> None:
    """Checksums are made right again, so that it is the pixels that are damaged."""
    seed = Seed("picture", f"a.{kind}", encoded(kind), as_pixels, is_text=False)
    counts = Counts()
    for number in range(150):
        data = mutant(seed.data, number, is_text=False)
        run_one(seed, repacked_png(data) if kind == "png" else data, tmp_path, counts, number)
    assert counts.refused > 50
    assert not counts.failures
    assert capfd.readouterr() == ("", "")
