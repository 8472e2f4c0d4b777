"""Records as JSON has them."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slamfusion.json_values import plain
from tests.support import make_schema


@dataclass(frozen=True, eq=False)
class Measured:
    """A result with the array that a picture is drawn from."""

    share: float
    """Share of the walls."""
    file: Path
    """Where it lies."""
    cells: Any = field(repr=False)
    """(H, W) of the picture."""


@dataclass(frozen=True)
class Turned:
    """A result whose keys are not its fields."""

    yaw_rad: float

    def to_json(self) -> dict[str, float]:
        """Return the heading in degrees."""
        return {"yaw_deg": float(np.rad2deg(self.yaw_rad))}


def test_the_fields_of_a_record_are_its_keys_but_not_what_its_repr_leaves_out() -> None:
    found = Measured(float("nan"), Path("a.yaml"), np.zeros((2, 2)))
    assert plain({"maps": (found,)}) == {"maps": [{"share": None, "file": "a.yaml"}]}


def test_a_record_may_say_its_keys_itself() -> None:
    assert plain([Turned(np.pi)]) == [{"yaw_deg": 180.0}]


def test_the_schema_of_a_record_has_the_keys_that_are_printed() -> None:
    found: dict[str, Any] = {}
    make_schema.add_record(Measured, found)
    assert list(found["Measured"]["properties"]) == ["share", "file"]


@dataclass(frozen=True)
class Nameless:
    """A record with a field that nobody describes."""

    name: str
    """What it is called."""
    size: int


def test_a_field_without_a_text_makes_no_schema() -> None:
    with pytest.raises(ValueError, match=r"Nameless\.size has no text below it"):
        make_schema.add_record(Nameless, {})


@dataclass(frozen=True)
class Counts:
    values: tuple[int, ...]

    def to_json(self) -> list[int]:
        return list(self.values)


@dataclass(frozen=True)
class Wrapped:
    def to_json(self) -> Holder:
        return Holder(Counts((1, 2)))


@dataclass(frozen=True)
class Holder:
    counts: Counts


def test_a_record_prints_what_its_method_returns_a_list_or_another_record() -> None:
    assert plain(Holder(Counts((1, 2)))) == {"counts": [1, 2]}
    assert plain(Wrapped()) == {"counts": [1, 2]}
