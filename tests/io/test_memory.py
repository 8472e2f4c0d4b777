"""Claims about what memory there is and when work is refused."""

from __future__ import annotations

import psutil
import pytest

from slamfusion.errors import MemoryBudgetError
from slamfusion.io import available_memory, check_memory, files


def test_no_more_is_available_than_the_machine_has() -> None:
    assert 0 < available_memory() <= psutil.virtual_memory().total


def test_what_fits_passes_and_what_does_not_is_refused_with_numbers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(files, "available_memory", lambda: 3 * 2**30)
    check_memory(3 * 2**30, "a map", "here.yaml")
    with pytest.raises(MemoryBudgetError) as caught:
        check_memory(5 * 2**30, "fusing 3 maps", "here.yaml")
    assert str(caught.value) == (
        "here.yaml: fusing 3 maps needs 5.0 GiB of memory, but only 3.0 GiB is available; "
        "free memory, crop it or use a coarser cell"
    )
