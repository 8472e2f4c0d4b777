"""A search can be given up between any two operations of the device, and is not changed by that."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import pytest

from slamfusion.align.align import align_pair, track_pair
from slamfusion.align.cancel import CancelledSearchError, CancelToken, watched_by
from slamfusion.align.features import GridFeatures
from slamfusion.align.normalize import normalize_grid
from slamfusion.align.pair import Pair
from slamfusion.align.records import Alignment
from slamfusion.compute import ComputeDevice
from slamfusion.config import AlignConfig, NormalizeConfig
from tests.fusion.live.maps import three, trio

# Carry bytes to and from the device; all others compute.
COPIES = {"upload", "download", "finish"}


class Told:
    """A device that notes what it was told to compute since it last finished."""

    def __init__(self, device: ComputeDevice) -> None:
        self.open: list[str] = []
        self._device = device

    def finish(self) -> None:
        self._device.finish()
        self.open = []

    def __getattr__(self, name: str) -> Any:
        operation = getattr(self._device, name)

        def noted(*given: Any, **named: Any) -> Any:
            if name not in COPIES:
                self.open.append(name)
            return operation(*given, **named)

        return noted if callable(operation) else operation


def features(name: str, device: ComputeDevice, cancel: CancelToken | None = None) -> GridFeatures:
    with watched_by(cancel):
        grid = normalize_grid(trio()[name], 0.05, NormalizeConfig(), device)
    return GridFeatures(grid, device)


def figures(pair: Alignment) -> tuple[object, ...]:
    return pair.transform, pair.accepted, pair.reason, pair.score, pair.overlap, pair.statistics


@pytest.mark.parametrize("step", [None, 8])
def test_a_search_with_a_token_is_that_without_and_asks_between_all_operations(
    device: ComputeDevice, step: int | None
) -> None:
    told = Told(device)
    watched = cast("ComputeDevice", told)
    most, asked = 0, 0

    def is_wanted() -> bool:
        nonlocal asked
        asked += 1
        return False

    class Watching(CancelToken):
        def check(self) -> None:
            nonlocal most
            most = max(most, len(told.open))
            super().check()

    cancel = Watching(is_wanted, watched)
    config = AlignConfig(step=step)
    grids = [features(name, watched, cancel) for name in "ab"]
    pair = align_pair(Pair(grids[0], grids[1], cancel), config)
    start = pair.transform
    tracked = track_pair(Pair(grids[0], grids[1], cancel), start)
    assert most <= 1
    assert asked > 20

    plain = [features(name, device) for name in "ab"]
    assert figures(align_pair(Pair(plain[0], plain[1]), config)) == figures(pair)
    assert figures(track_pair(Pair(plain[0], plain[1]), start)) == figures(tracked)


def test_a_search_is_given_up_at_any_question_and_can_be_begun_again(device: ComputeDevice) -> None:
    config = AlignConfig()

    def asking(answer: Callable[[int], bool]) -> tuple[CancelToken, list[int]]:
        asked: list[int] = []

        def is_wanted() -> bool:
            asked.append(len(asked) + 1)
            return answer(asked[-1])

        return CancelToken(is_wanted, device), asked

    grids = [features(name, device) for name in "ab"]
    never, count = asking(lambda _: False)
    wanted = align_pair(Pair(grids[0], grids[1], never), config)
    again = [features(name, device) for name in "ab"]
    for at in (1, 2, 7, len(count) // 2):
        cancel, asked = asking(lambda number, at=at: number == at)
        with pytest.raises(CancelledSearchError):
            align_pair(Pair(again[0], again[1], cancel), config)
        assert len(asked) == at
    assert figures(align_pair(Pair(again[0], again[1]), config)) == figures(wanted)


def test_cells_of_another_size_are_made_with_questions_between(device: ComputeDevice) -> None:
    left = 3

    def is_wanted() -> bool:
        nonlocal left
        left -= 1
        return left == 0

    with pytest.raises(CancelledSearchError), watched_by(CancelToken(is_wanted, device)):
        normalize_grid(three()["a"], 0.07, NormalizeConfig(), device)
    assert left == 0
