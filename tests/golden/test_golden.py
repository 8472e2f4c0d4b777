"""The part of the golden corpus that takes seconds; see ``tests.golden``."""

from __future__ import annotations

import json
import os
from pathlib import Path
from unittest import mock

import pytest

from tests.golden.corpus import (
    ENVIRONMENT,
    EXPECTED,
    RECORDED,
    difference,
    load_entries,
    run_entries,
    this_machine,
)

pytestmark = pytest.mark.once

ENTRIES = load_entries()
FAST = [name for name, entry in ENTRIES.items() if entry.is_fast]


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    with mock.patch.dict(os.environ, ENVIRONMENT):
        return dict(run_entries(FAST, tmp_path_factory.mktemp("golden"), workers=1))


@pytest.mark.parametrize("name", FAST)
def test_the_outcome_is_the_recorded_one(name: str, found: dict[str, str]) -> None:
    if name in {"help", "failures"} and this_machine()["click"] != _recorded("click"):
        pytest.skip(f"recorded with click {_recorded('click')}, which breaks lines in its own way")
    unlike = difference(ENTRIES[name], found[name], to_the_digit=False)
    hint = f"where it is right: python -m tests.golden --record {name}"
    assert not unlike, f"{unlike}\n{hint}"


@pytest.mark.full
def test_the_rest_is_the_recorded_one(tmp_path: Path) -> None:
    rest = [name for name in ENTRIES if name not in FAST]
    with mock.patch.dict(os.environ, ENVIRONMENT):
        found = dict(run_entries(rest, tmp_path, workers=2))
    # Recorded data may be absent.
    names = [name for name in rest if name in found]
    unlike = [difference(ENTRIES[name], found[name], to_the_digit=False) for name in names]
    assert not any(unlike), "\n".join(unlike)


def _recorded(key: str) -> str:
    return str(json.loads(RECORDED.read_text(encoding="utf-8"))[key])


def test_every_entry_is_recorded_and_fast_ones_need_no_others() -> None:
    assert {path.stem for path in EXPECTED.glob("*.txt")} == ENTRIES.keys()
    assert not any(ENTRIES[name].is_shared or ENTRIES[name].needs - {*FAST} for name in FAST)
