"""Loops of maps must close; the alignment that keeps them from it is named."""

from __future__ import annotations

import math

from slamfusion.align.decide import MatchEvidence
from slamfusion.align.records import Alignment
from slamfusion.fusion.grouping import AlignmentGraph
from slamfusion.geometry import Pose2

PLACES = {name: Pose2(3.0 * index, 0.5 * index, 0.3 * index) for index, name in enumerate("abcdef")}


def link(a: str, b: str, better: float = 20.0, off: Pose2 | None = None) -> Alignment:
    """Return an alignment of b to a as the places have it, or off by a motion."""
    transform = PLACES[a].inverse().compose(PLACES[b]).compose(off or Pose2())
    evidence = MatchEvidence("good", better, better, "another pose", 1.0, 0.9, 30.0, 0.1, 1e-6)
    return Alignment(
        reference=a, moving=b, accepted=True, reason="", transform=transform, score=0.5,
        overlap=0.5, error=0.0, runner_up=None, time_s=0.0, evidence=evidence,
    )  # fmt: skip


def graph_of(*edges: str) -> AlignmentGraph:
    graph = AlignmentGraph("abcdef")
    for a, b in edges:
        graph.believe(link(a, b))
    return graph


def test_links_join_groups_and_poses_follow_from_them() -> None:
    graph = graph_of("ab", "cb", "de")
    assert graph.groups() == [("a", "b", "c"), ("d", "e"), ("f",)]
    assert graph.is_joined("a", "c")
    assert not graph.is_joined("c", "d")
    assert graph.mates("e") == ("d", "e")
    assert graph.path("a", "c") == [frozenset("cb"), frozenset("ab")]
    for name, pose in graph.poses("abc").items():
        wanted = PLACES["a"].inverse().compose(PLACES[name])
        assert math.isclose(pose.x, wanted.x, abs_tol=1e-9)
        assert math.isclose(pose.y, wanted.y, abs_tol=1e-9)
        assert math.isclose(pose.yaw_rad, wanted.yaw_rad, abs_tol=1e-9)


def test_further_links_close_loops_over_those_of_the_tree() -> None:
    graph = graph_of("ab", "bc", "cd", "ad")
    assert graph.loops() == {frozenset(key): 1 for key in ("ab", "bc", "cd")}
    assert graph.links_inside("abcd")[-1].moving == "d"
    assert not graph.drop_false()


def test_a_contradicted_bridge_is_taken_back() -> None:
    """Both sides of the link c to d are borne out by loops, and what lies across it is not."""
    graph = graph_of("ab", "bc", "cd", "de", "ef", "ac", "df")
    graph.contradict(frozenset("be"), None)
    assert graph.drop_false()
    assert list(graph.false) == [frozenset("cd")]
    assert "loops over other maps" in graph.false[frozenset("cd")]
    assert graph.groups() == [("a", "b", "c"), ("d", "e", "f")]
    assert not graph.against
    assert not graph.drop_false()


def test_a_pair_that_alone_contradicts_closed_loops_is_the_false_one() -> None:
    graph = graph_of("ab", "bc", "cd", "ac", "bd", "ad")
    own = link("a", "d", off=Pose2(4.0, 0.0))
    del graph.links[frozenset("ad")]
    graph.contradict(frozenset("ad"), own)
    assert graph.drop_false()
    assert list(graph.false) == [frozenset("ad")]
    assert graph.groups()[0] == ("a", "b", "c", "d")


def test_walls_that_contradict_closed_loops_take_nothing_back() -> None:
    graph = graph_of("ab", "bc", "ac", "cd", "bd")
    graph.contradict(frozenset("ad"), None)
    assert not graph.drop_false()


def test_of_a_triangle_that_does_not_close_the_weakest_goes() -> None:
    graph = AlignmentGraph("abc")
    graph.believe(link("a", "b", 60.0))
    graph.believe(link("b", "c", 50.0))
    graph.contradict(frozenset("ac"), link("a", "c", 6.0, Pose2(5.0, 0.0)))
    assert graph.drop_false()
    assert list(graph.false) == [frozenset("ac")]


def test_of_a_triangle_of_equals_nothing_is_believed_that_may_be_false() -> None:
    graph = AlignmentGraph("abc")
    graph.believe(link("a", "b", 60.0))
    graph.believe(link("b", "c", 11.0))
    graph.contradict(frozenset("ac"), link("a", "c", 10.0, Pose2(5.0, 0.0)))
    assert graph.drop_false()
    assert set(graph.false) == {frozenset("ac"), frozenset("bc")}
    assert graph.groups() == [("a", "b"), ("c",)]
