"""The proof: bounds hold for every member, the score is its definition, the best is found."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamfusion.compute import ComputeDevice
from slamfusion.config import AlignConfig
from slamfusion.fusion.proof import (
    APART,
    MEMBERS_KEPT,
    TOP,
    LatticeScore,
    _BlockBounds,
    _bound_all,
    neighbourhood_best,
    prove,
)
from slamfusion.fusion.search import SearchWindow, search
from slamfusion.grid import OccupancyGrid
from tests.fusion.definitions import Side, landings, look_up, side_of, surface_of
from tests.fusion.drawings import building, degraded, features_of, random_grid
from tests.support.examples import examples

CONFIG = AlignConfig()
OPEN = SearchWindow()


def lattice_of(
    device: ComputeDevice,
    reference: OccupancyGrid,
    moving: OccupancyGrid,
    window: SearchWindow = OPEN,
    config: AlignConfig = CONFIG,
) -> LatticeScore:
    a, b = features_of(reference, device), features_of(moving, device)
    return LatticeScore(a, b, config, window, device)


def all_scores(lattice: LatticeScore, yaws: range | None = None) -> np.ndarray:
    """Every member's score, (yaws, rows, columns); or those of some yaws."""
    count, height, width = lattice.shape
    index = np.array(yaws if yaws is not None else range(count), dtype=np.int64)
    return lattice.score_box(index, (0, height), (0, width))


def block_maxima(scores: np.ndarray, step: int) -> np.ndarray:
    """The best member of each block of ``step`` yaws, rows and columns."""
    pad = [(0, -size % step) for size in scores.shape]
    padded = np.pad(scores, pad, constant_values=-1)
    groups, rows, cols = (size // step for size in padded.shape)
    return padded.reshape(groups, step, rows, step, cols, step).max(axis=(1, 3, 5))


def assert_bounds_hold(lattice: LatticeScore, scores: np.ndarray, steps: tuple[int, ...]) -> None:
    for step in steps:
        best = block_maxima(scores, step)
        bounds = _bound_all(lattice, step)
        assert bounds.shape == best.shape
        assert np.all(bounds >= best), step
        listed = np.stack(np.indices(best.shape), axis=-1).reshape(-1, 3)
        listed = np.ascontiguousarray(listed[:: max(1, len(listed) // 4000)], dtype=np.int32)
        blocks = np.ascontiguousarray(listed * np.array([1, step, step]), dtype=np.int32)
        own = _BlockBounds(lattice, step, blocks).bounds(blocks)
        at = (listed[:, 0], listed[:, 1], listed[:, 2])
        assert np.all(own >= best[at]), step
        assert np.array_equal(own, bounds[at]), "both ways to a bound agree"


@settings(max_examples=examples(40), deadline=None, derandomize=True)
@given(first=st.integers(0, 10_000), second=st.integers(0, 10_000))
def test_no_member_of_a_block_exceeds_its_bound(
    device: ComputeDevice, first: int, second: int
) -> None:
    lattice = lattice_of(device, random_grid(first, 20, 36), random_grid(second, 20, 36))
    assert_bounds_hold(lattice, all_scores(lattice), (2, 4, 8))


@pytest.mark.parametrize("seed", range(3))
def test_bounds_hold_for_maps_of_sixty_cells_and_large_blocks(
    device: ComputeDevice, seed: int
) -> None:
    lattice = lattice_of(device, random_grid(seed, 50, 60), random_grid(seed + 70, 50, 60))
    assert_bounds_hold(lattice, all_scores(lattice), (2, 4, 16, 32))


def test_bounds_hold_inside_a_window(device: ComputeDevice) -> None:
    window = SearchWindow((20.3, 17.8, 1.3), 9.0, 0.4)
    lattice = lattice_of(device, random_grid(5), random_grid(6), window)
    assert_bounds_hold(lattice, all_scores(lattice), (2, 4, 8))


def test_bounds_hold_for_a_sample_of_the_points(device: ComputeDevice) -> None:
    lattice = lattice_of(
        device, random_grid(5), random_grid(6), config=AlignConfig(proof_points=16)
    )
    assert len(lattice.own) == 16
    assert_bounds_hold(lattice, all_scores(lattice), (2, 8))


@pytest.mark.parametrize("sigma", [0.5, 1.0, 12.0])
def test_bounds_hold_for_narrow_and_wide_walls(device: ComputeDevice, sigma: float) -> None:
    config = AlignConfig(proof_sigma_cells=sigma)
    lattice = lattice_of(device, random_grid(8), random_grid(9), config=config)
    assert_bounds_hold(lattice, all_scores(lattice), (4,))


def test_bounds_of_single_members_are_their_scores(device: ComputeDevice) -> None:
    lattice = lattice_of(device, random_grid(3), random_grid(4))
    scores = all_scores(lattice)
    rng = np.random.default_rng(0)
    members = np.stack([rng.integers(0, size, 3000) for size in lattice.shape], axis=1)
    blocks = np.ascontiguousarray(members, dtype=np.int32)
    assert np.array_equal(_BlockBounds(lattice, 1, blocks).bounds(blocks), scores[tuple(members.T)])


def test_a_bound_is_no_larger_than_all_points_on_a_wall(device: ComputeDevice) -> None:
    lattice = lattice_of(device, random_grid(3), random_grid(4))
    assert _bound_all(lattice, 4).max() <= TOP * len(lattice.own)


def scores_by_definition(
    reference: Side, moving: Side, base: int, motions: np.ndarray
) -> np.ndarray:
    """Scores of motions (N, 3): the moving walls on the reference's evidence; unknown is base."""
    landed = [landings(moving.points, motion, moving.centre) for motion in motions]
    own = base * len(moving.points)
    return np.array([own + look_up(reference.value, places).sum() for places in landed])


@pytest.mark.parametrize("seed", range(4))
def test_scores_equal_their_definition(device: ComputeDevice, seed: int) -> None:
    reference, moving = random_grid(seed), random_grid(seed + 100)
    # Away from quarter turns, where a point would lie on the line between two cells.
    lattice = lattice_of(device, reference, moving, SearchWindow((0.0, 0.0, 0.1234)))
    sigma = CONFIG.proof_sigma_cells
    a, b = (side_of(features_of(grid, device), sigma, TOP) for grid in (reference, moving))
    assert 0 < lattice.base < TOP
    rng = np.random.default_rng(seed)
    count, height, width = lattice.shape
    for k in rng.integers(0, count, 8):
        scores = lattice.score_box(np.array([k]), (0, height), (0, width))[0]
        members = np.stack(
            (np.full(200, k), rng.integers(0, height, 200), rng.integers(0, width, 200)), axis=1
        )
        wanted = scores_by_definition(a, b, lattice.base, lattice.motions(members))
        assert np.array_equal(scores[members[:, 1], members[:, 2]], wanted)


@pytest.mark.parametrize("seed", range(4))
def test_the_search_set_holds_every_shift_under_which_the_maps_overlap(
    device: ComputeDevice, seed: int
) -> None:
    """Beyond its edges every moving wall lies off the reference and is worth the base."""
    reference, moving = random_grid(seed), random_grid(seed + 100)
    lattice = lattice_of(device, reference, moving)
    scores = all_scores(lattice)
    edges = (scores[:, 0], scores[:, -1], scores[:, :, 0], scores[:, :, -1])
    assert all(np.all(edge == lattice.base * len(lattice.own)) for edge in edges)
    farthest = np.hypot(*lattice.own.T).max()
    assert lattice.rows[0] + 0.5 + farthest < 0.0
    assert lattice.cols[1] - 0.5 - farthest > reference.width


def test_a_part_of_the_search_set_scores_as_in_the_whole(device: ComputeDevice) -> None:
    lattice = lattice_of(device, random_grid(1), random_grid(2))
    whole = all_scores(lattice)
    yaws = np.array([3, 90, 17], dtype=np.int64)
    part = lattice.score_box(yaws, (5, 19), (7, 50))
    assert np.array_equal(part, whole[yaws, 5:19, 7:50])


def test_the_twins_score_alike(device: ComputeDevice, twins: ComputeDevice) -> None:
    window = SearchWindow((12.0, 12.0, 0.4), 4.0, 0.3)
    grids = random_grid(1, 20, 24), random_grid(2, 20, 24)
    a, b = (lattice_of(on_device, *grids, window) for on_device in (device, twins))
    assert np.array_equal(all_scores(a), all_scores(b))
    best = int(all_scores(a).max()) - 20
    proofs = [prove(lattice, best, 60.0) for lattice in (a, b)]
    assert proofs[0].bound_gap == proofs[1].bound_gap
    assert np.array_equal(proofs[0].rivals, proofs[1].rivals)


def test_a_map_so_full_of_walls_that_none_tells_anything_is_proven_still(
    device: ComputeDevice,
) -> None:
    """All that is left is what speaks against: free ground farther from walls than elsewhere."""
    cells = np.full((30, 30), 100, dtype=np.int8)
    cells[1:-1, 1:-1][:, np.arange(28) % 4 != 3] = 0
    cells[10:20, 8:22] = 0
    grid = OccupancyGrid(cells, 0.1)
    lattice = lattice_of(device, grid, grid, SearchWindow((15.0, 15.0, 0.1), 6.0, 0.3))
    assert lattice.base == TOP
    scores = all_scores(lattice)
    best, worst = int(scores.max()), int(scores.min())
    assert worst < best == TOP * len(lattice.own)
    assert prove(lattice, best, 60.0).bound_gap == 0.0
    proof = prove(lattice, worst, 60.0)
    assert proof.finished
    assert proof.bound_gap == pytest.approx((best - worst) / len(lattice.own))


@pytest.mark.parametrize("seed", range(4))
def test_one_yaw_step_moves_the_farthest_wall_by_at_most_a_cell(
    device: ComputeDevice, seed: int
) -> None:
    moving = building(seed)
    lattice = lattice_of(device, random_grid(9), moving)
    rows, cols = np.nonzero(surface_of(np.where(moving.cells == 100, 1, moving.cells)))
    far = np.hypot(cols + 0.5 - moving.width / 2, rows + 0.5 - moving.height / 2).max()
    assert lattice.yaw_step * far <= 1.0 + 1e-9
    assert lattice.yaw_step * lattice.turn == pytest.approx(2 * math.pi)


def test_members_and_motions_are_one_to_one(device: ComputeDevice) -> None:
    for window in (OPEN, SearchWindow((20.3, 17.8, 1.3), 9.0, 0.4)):
        lattice = lattice_of(device, random_grid(5), random_grid(6), window)
        corners = itertools.product(*((0, size // 3, size - 1) for size in lattice.shape))
        for member in corners:
            motion = lattice.motions(np.array([member], dtype=np.int64))[0]
            assert lattice.member(motion) == member


def test_a_window_holds_the_members_within_it_only(device: ComputeDevice) -> None:
    window = SearchWindow((20.3, 17.8, 1.3), 9.0, 0.4)
    lattice = lattice_of(device, random_grid(5), random_grid(6), window)
    ends = np.array([(0, 0, 0), np.array(lattice.shape) - 1], dtype=np.int64)
    motions = lattice.motions(ends)
    assert np.abs(motions[:, 0] - 20.3).max() <= 10.0
    assert np.abs(motions[:, 1] - 17.8).max() <= 10.0
    assert np.abs(motions[:, 2] - 1.3).max() <= 0.4 + 1e-9


@pytest.mark.parametrize("seed", range(5))
def test_the_best_of_all_is_proven(device: ComputeDevice, seed: int) -> None:
    lattice = lattice_of(device, random_grid(seed), random_grid(seed + 20))
    proof = prove(lattice, int(all_scores(lattice).max()), 60.0)
    assert proof.finished
    assert proof.bound_gap == 0.0
    assert len(proof.rivals) == 0


@pytest.mark.parametrize("seed", range(5))
def test_every_better_member_is_a_rival_or_beside_one(device: ComputeDevice, seed: int) -> None:
    lattice = lattice_of(device, random_grid(seed), random_grid(seed + 20))
    scores = all_scores(lattice)
    ordered = np.sort(scores, axis=None)[::-1]
    answer = int(ordered[200])
    proof = prove(lattice, answer, 60.0)
    better = np.argwhere(scores > answer)
    rivals = np.array([lattice.member(motion) for motion in proof.rivals])
    apart = np.abs(better[:, None, :] - rivals[None]).max(axis=2)
    assert len(rivals) < MEMBERS_KEPT
    assert apart.min(axis=1).max() <= APART, "none is hidden by another peak"
    assert all(scores[tuple(rival)] > answer for rival in rivals)
    assert scores[tuple(rivals[0])] == ordered[0], "the best comes first"
    assert proof.bound_gap == pytest.approx((ordered[0] - answer) / lattice.scale)
    assert proof.finished


@settings(max_examples=examples(25), deadline=None, derandomize=True)
@given(
    first=st.integers(0, 10_000),
    second=st.integers(0, 10_000),
    rank=st.integers(0, 150),
    points=st.sampled_from((16, 1024)),
)
def test_no_better_member_is_dropped(
    device: ComputeDevice, first: int, second: int, rank: int, points: int
) -> None:
    config = AlignConfig(proof_points=points)
    grids = random_grid(first, 14, 24), random_grid(second, 14, 24)
    lattice = lattice_of(device, *grids, config=config)
    scores = all_scores(lattice)
    answer = int(np.sort(scores, axis=None)[-1 - rank])
    proof = prove(lattice, answer, 60.0)
    assert proof.finished
    assert proof.bound_gap == pytest.approx((scores.max() - answer) / lattice.scale)
    better = np.argwhere(scores > answer)
    rivals = np.array([lattice.member(motion) for motion in proof.rivals]).reshape(-1, 3)
    assert len(rivals) < MEMBERS_KEPT
    assert (len(rivals) > 0) == (len(better) > 0)
    for member in better:
        assert np.abs(rivals - member).max(axis=1).min() <= APART


def test_of_many_better_members_the_best_peaks_are_kept(device: ComputeDevice) -> None:
    lattice = lattice_of(device, random_grid(1), random_grid(21))
    scores = all_scores(lattice)
    ordered = np.sort(scores, axis=None)[::-1]
    proof = prove(lattice, int(ordered[20_000]), 60.0)
    members = np.array([lattice.member(motion) for motion in proof.rivals])
    found = scores[tuple(members.T)]
    assert len(found) <= MEMBERS_KEPT
    assert found[0] == ordered[0]
    assert np.all(np.diff(found) <= 0)
    apart = np.abs(members[:, None, :] - members[None]).max(axis=2)
    assert (apart + np.eye(len(members)) * 99).min() > APART


def test_a_deadline_that_has_passed_leaves_a_gap(device: ComputeDevice) -> None:
    lattice = lattice_of(device, building(1), building(2))
    k, row, col = (size // 2 for size in lattice.shape)
    answer = int(lattice.score_box(np.array([k]), (row, row + 1), (col, col + 1))[0, 0, 0])
    proof = prove(lattice, answer, 0.0)
    assert not proof.finished
    assert proof.bound_gap > 0


def test_the_gap_left_by_a_deadline_covers_the_best(device: ComputeDevice) -> None:
    """What was not decided may be as good as the gap says, and the best of all is no better."""
    lattice = lattice_of(device, building(1), building(2))
    answer, _ = neighbourhood_best(lattice, np.array([40.0, 30.0, 0.3]), 4)
    gap = prove(lattice, answer, 0.0).bound_gap
    yaws = range(0, lattice.shape[0], 3)
    assert all_scores(lattice, yaws).max() <= answer + gap * lattice.scale + 1e-6


def test_the_best_of_a_neighbourhood_is_the_best_of_it(device: ComputeDevice) -> None:
    lattice = lattice_of(device, random_grid(5), random_grid(6))
    scores = all_scores(lattice)
    for member in ((40, 30, 30), (0, 20, 25), (lattice.shape[0] - 1, 0, 0)):
        motion = lattice.motions(np.array([member], dtype=np.int64))[0]
        best, where = neighbourhood_best(lattice, motion, 3)
        k, row, col = member
        yaws = np.arange(k - 3, k + 4) % lattice.shape[0]
        box = scores[yaws, max(row - 3, 0) : row + 4, max(col - 3, 0) : col + 4]
        assert best == box.max()
        assert scores[lattice.member(where)] == best


def assert_search_is_proven(
    device: ComputeDevice, reference: OccupancyGrid, moving: OccupancyGrid
) -> None:
    """The proof and brute force say the same of the search's answer."""
    a, b = features_of(reference, device), features_of(moving, device)
    _, motions, _ = search(a, b, CONFIG, OPEN, device)
    lattice = LatticeScore(a, b, CONFIG, OPEN, device)
    answer, _ = neighbourhood_best(lattice, motions[0], 8)
    best = max(
        int(all_scores(lattice, range(k, min(k + 16, lattice.shape[0]))).max())
        for k in range(0, lattice.shape[0], 16)
    )
    assert answer == best, "the search found the best of the search set"
    proof = prove(lattice, answer, 600.0)
    assert proof.finished
    assert proof.bound_gap == 0.0
    assert len(proof.rivals) == 0
    worse = prove(lattice, best - 1, 600.0)
    assert worse.bound_gap == pytest.approx(1 / lattice.scale)
    k, row, col = lattice.member(worse.rivals[0])
    assert lattice.score_box(np.array([k]), (row, row + 1), (col, col + 1))[0, 0, 0] == best


def test_brute_force_agrees_on_maps_of_a_hundred_cells(device: ComputeDevice) -> None:
    truth = building(7, 10.0, 9.0)
    moving, _ = degraded(truth, 3, yaw_rad=2.0, crop_share=0.8, flip_share=0.02)
    assert_search_is_proven(device, truth, moving)


@pytest.mark.full
@pytest.mark.parametrize("seed", range(3))
def test_brute_force_agrees_on_maps_of_two_hundred_cells(device: ComputeDevice, seed: int) -> None:
    truth = building(seed, 10.0, 10.0, 0.05)
    moving, _ = degraded(
        truth,
        seed,
        yaw_rad=-1.1 + 2 * seed,
        crop_share=0.7,
        flip_share=0.03,
        wall_change_cells=seed - 1,
    )
    assert_search_is_proven(device, truth, moving)
