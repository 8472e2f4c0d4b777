"""Maps that agree decide; a bent one is named, and votes where it is right."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamfusion.config import FusionMode
from slamfusion.vote.tiles import WallCounts, trust_of
from tests.support.examples import examples
from tests.vote.rooms import EDGE, HEIGHT, INNER, WIDTH, bent, cells_of, decide, fuse, moved, room


def test_a_bent_map_has_no_say_and_is_named_with_the_place() -> None:
    result = fuse({"a": room(), "bent": bent(room()), "b": room()})
    assert np.array_equal(cells_of(result), room())
    assert result.weights == {"a": 1.0, "bent": 0.0, "b": 1.0}
    assert list(result.bent) == ["bent"]
    found = result.bent["bent"]
    assert found.share == result.wall_agreement["bent"] < 0.8 < result.wall_agreement["a"]
    # It is right up to column 20, that is x 2.0 m.
    assert found.x > 2.0
    (words,) = result.bent_sentences
    assert words == (
        f"bent: bent, agrees with the others on {100.0 * found.share:.0f} % of its walls; worst at "
        f"x {found.x:.1f}, y {found.y:.1f} m; it votes only where it agrees"
    )
    assert not result.others


def test_what_one_good_map_alone_saw_is_kept_and_what_a_bent_one_alone_saw_is_left_out() -> None:
    corner = np.s_[HEIGHT - 20 : HEIGHT - 10, 15:25]
    without = room()
    without[corner] = -1
    box = room()
    box[corner] = 1
    box[HEIGHT - 19 : HEIGHT - 11, 16:24] = 0
    good = fuse({"a": box, "b": without, "bent": bent(without)})
    assert np.array_equal(cells_of(good)[corner], box[corner])
    only_bent = fuse({"a": without, "b": without, "bent": bent(box)})
    assert (cells_of(only_bent)[corner] == -1).all()


def test_two_groups_that_contradict_each_other_are_fused_apart() -> None:
    one, other = room(), moved(room(), 4, 7)
    result = fuse({"a": one, "b": one, "c": other, "d": other, "e": one})
    assert [record.name for record in result.accepted] == ["a", "b", "e"]
    (second,) = result.others
    assert [record.name for record in second.accepted] == ["c", "d"]
    assert np.array_equal(cells_of(result), one)
    assert np.array_equal(cells_of(second), other)
    reason = "agrees with c, d and contradicts a, b, e; fused apart"
    assert [record.reason for record in result.rejected] == [reason] * 2


def test_of_two_maps_nobody_says_which_is_bent() -> None:
    result = fuse({"a": room(), "b": bent(room())})
    assert result.wall_agreement["a"] == pytest.approx(result.wall_agreement["b"], abs=0.02)
    assert result.wall_agreement["a"] < 0.8
    (words,) = result.bent_sentences
    assert words.startswith("a and b agree on only ")
    assert words.endswith("m: one of them is bent")


@settings(max_examples=examples(15), deadline=None)
@given(
    seeds=st.lists(st.integers(0, 8), min_size=3, max_size=4, unique=True),
    mode=st.sampled_from(("consensus", "majority")),
)
def test_an_input_that_knows_nothing_changes_nothing(seeds: list[int], mode: FusionMode) -> None:
    maps = {f"map {seed}": room(seed=seed) for seed in seeds}
    nothing = np.full((HEIGHT, WIDTH), -1, dtype=np.int8)
    trust, fused = decide(maps, mode)
    trust_beside, fused_beside = decide({**maps, "nothing": nothing}, mode)
    assert np.array_equal(fused, fused_beside)
    if trust is not None and trust_beside is not None:
        assert trust.decides_like(trust_beside.part(trust.names))


def test_maps_that_share_no_walls_are_not_bent() -> None:
    west, east = room(), room()
    west[:, 30:] = -1
    east[:, :70] = -1
    result = fuse({"west": west, "east": east})
    assert not result.bent
    together = west.copy()
    together[:, 70:] = east[:, 70:]
    assert np.array_equal(cells_of(result), together)


def test_order_of_inputs_matters_to_nothing_but_ties() -> None:
    """Maps whose walls differ in length, so that none is as good as another."""
    maps = {"a": room(), "b": room(), "c": room(), "bent": bent(room())}
    maps["b"][EDGE : EDGE + 12, INNER] = 0
    maps["c"][-EDGE - 1, 20:40] = -1
    wanted = fuse(maps)
    for order in itertools.permutations(maps):
        found = fuse({name: maps[name] for name in order})
        assert np.array_equal(cells_of(found), cells_of(wanted)), order
        assert found.weights == wanted.weights
        assert found.bent == wanted.bent


def test_maps_in_a_chain_are_as_right_as_its_weakest_link() -> None:
    """Twenty maps in a row, each agrees with the next on 95 %: the far ones are not bent."""
    seen = 1000 * (np.eye(20, k=1, dtype=int) + np.eye(20, k=-1, dtype=int))
    met = seen * 95 // 100
    trust = trust_of([f"map {n}" for n in range(20)], WallCounts(seen, met, met, 0 * seen))
    assert trust.agreement.tolist() == [0.95] * 20
    assert trust.weights.tolist() == [255] * 20


def test_thick_walls_are_the_error_of_the_map_that_has_them() -> None:
    """Two maps with walls of five cells, which agree with each other, and two of one cell."""
    thick = cv2.dilate((room() == 1).astype(np.uint8), np.ones((5, 5), dtype=np.uint8))
    blurred = np.where(thick > 0, 1, room()).astype(np.int8)
    result = fuse({"a": room(), "b": room(), "thick 1": blurred, "thick 2": blurred})
    assert np.array_equal(cells_of(result), room())
    assert not result.others
    assert result.weights["a"] > result.weights["thick 1"] == result.weights["thick 2"]
