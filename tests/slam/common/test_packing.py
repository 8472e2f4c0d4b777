"""States are taken apart into plain values and arrays, and come back as they were."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import pytest

from slamfusion.geometry import Pose2
from slamfusion.slam.common.packing import pack, unpack


@dataclass(frozen=True, eq=False)
class Inner:
    rows: npt.NDArray[np.float64]
    kind: Literal["a", "b"]


@dataclass(frozen=True, eq=False)
class Outer:
    number: int
    maybe: float | None
    pose: Pose2
    no_pose: Pose2 | None
    inner: Inner
    several: tuple[Inner, ...]
    pairs: tuple[tuple[int, int, Pose2], ...]
    counts: dict[str, int]
    pools: dict[str, npt.NDArray[Any]]
    lines: list[tuple[float, float]]
    free: dict[str, Any]


def made() -> Outer:
    rng = np.random.default_rng(0)
    rows = [Inner(rng.normal(size=(count, 3)), "b") for count in (2, 0, 5)]
    return Outer(
        number=-3,
        maybe=0.1 + 0.2,
        pose=Pose2(1.0 / 3.0, -2.0, 3.1),
        no_pose=None,
        inner=rows[0],
        several=tuple(rows[1:]),
        pairs=((1, 2, Pose2(0.1)), (3, 4, Pose2())),
        counts={"a reason": 2},
        pools={"pool_field": np.arange(6, dtype=np.uint8).reshape(2, 3)},
        lines=[(0.1, 2.0)],
        free={"nested": {"deep": [1, None]}, "large": 1 << 100},
    )


def plain(value: Any) -> Any:
    """Return a state as something that can be compared, types included."""
    if isinstance(value, np.ndarray):
        return (value.dtype, value.shape, value.tobytes())
    if dataclasses.is_dataclass(value):
        names = [item.name for item in dataclasses.fields(value)]
        return (type(value), [plain(getattr(value, name)) for name in names])
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return (type(value), [plain(item) for item in value])
    return value


def test_a_state_comes_back_through_json_to_the_bit():
    record, arrays = pack(made())
    again = unpack(Outer, json.loads(json.dumps(record)), arrays)
    assert plain(again) == plain(made())


def test_arrays_are_named_by_their_paths():
    assert set(pack(made())[1]) == {
        "inner.rows",
        "several.0.rows",
        "several.1.rows",
        "pools.pool_field",
    }


@pytest.mark.parametrize("name", ["several.1.rows", "pools.pool_field"])
def test_an_array_that_is_missing_is_named(name: str):
    record, arrays = pack(made())
    del arrays[name]
    with pytest.raises(KeyError, match=name):
        unpack(Outer, record, arrays)


def test_a_value_that_is_missing_is_named():
    record, arrays = pack(made())
    del record["pairs"][1][2]["yaw_rad"]
    with pytest.raises(KeyError, match=r"pairs\.1\.2\.yaw_rad"):
        unpack(Outer, record, arrays)
