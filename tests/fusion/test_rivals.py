"""Which way of weighing an answer is taken, and what limits the pieces that speak for it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from slamfusion.compute import ComputeDevice
from slamfusion.fusion import judge, rivals
from slamfusion.fusion.pieces import WallPieces
from slamfusion.fusion.rivals import Found, Standing, chosen_standing
from slamfusion.fusion.search import CoarseSearch
from tests.fusion.drawings import building, features_of

# About counting, not about NumPy: one leg is enough.
pytestmark = pytest.mark.once

NOWHERE = np.zeros((1, 3))


def standing(pieces: int, seen_m: float, doubt: float) -> Standing:
    """An answer for which so many equal pieces speak, without a rival."""
    evidence = np.ones((1, pieces))
    table = WallPieces(evidence, evidence, evidence, np.array([seen_m]), doubt)
    return Standing(1.5, NOWHERE, [], table, [])


@pytest.mark.parametrize(
    ("seen_m", "doubt", "better"),
    [(2.0, 2.0, 4.0), (5.9, 2.0, 11.8), (6.1, 2.0, 12.0), (2.0, 0.0, 12.0)],
)
def test_a_metre_of_common_wall_of_good_maps_has_two_witnesses(
    seen_m: float, doubt: float, better: float
) -> None:
    assert standing(12, seen_m, doubt).better == pytest.approx(better)


@pytest.mark.parametrize(("better", "is_sided"), [(3.51, True), (3.49, False)])
def test_an_answer_by_sides_of_walls_needs_more_pieces(
    device: ComputeDevice, monkeypatch: pytest.MonkeyPatch, better: float, *, is_sided: bool
) -> None:
    def plain(*_: object, sided: bool) -> Standing:
        # Enough by the expected number of wrong ones in either way.
        return standing(12, better / 2.0 if sided else 6.0, 2.0)

    monkeypatch.setattr(rivals, "_plain_standing", plain)
    grid = building(1)
    features = features_of(grid, device)
    coarse = CoarseSearch(4, np.zeros(1), np.ones(1), NOWHERE, np.ones(1), 1, is_cut=False)
    motion = np.array([[*features.centre, 0.0]])
    found = Found(motion, coarse, None, "full")
    chosen = chosen_standing(features, features, device, found, 1, None)
    assert chosen.better == pytest.approx(better if is_sided else 12.0)


@pytest.mark.parametrize(("off_deg", "rounds"), [(0.0, 1), (1.2, 2), (3.0, 4), (9.0, 4)])
def test_the_last_fit_goes_on_while_it_turns(
    device: ComputeDevice, monkeypatch: pytest.MonkeyPatch, off_deg: float, rounds: int
) -> None:
    features = features_of(building(1), device)
    right = math.radians(off_deg)
    asked: list[int] = []

    def polish(_: object, __: object, begun: np.ndarray, *___: object) -> np.ndarray:
        asked.append(len(begun))
        return begun

    def scores(
        _: object, __: object, motions: np.ndarray, *___: object, **____: object
    ) -> np.ndarray:
        return -abs(motions[:, 2] - right)

    monkeypatch.setattr(judge, "polish", polish)
    monkeypatch.setattr(judge, "score_motions", scores)
    start = np.array([*features.centre, 0.0])
    fitted = judge._polished(features, features, start, device, None)
    assert len(asked) == rounds
    assert abs(fitted[2] - min(right, math.radians(4 * 1.2))) < math.radians(0.31)
