"""What a chunk saw is no evidence for itself, nor is the other face of a thin wall."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import psutil
import pytest

from slamfusion.compute import ComputeDevice
from slamfusion.compute.layout import BEAM_HALF, BEAM_ONE, FACINGS, TILE

PAGES = np.array([[0, 0, 0], [0, 1, 0], [0, 0, 0]], dtype=np.int32)
# A beam from cell (50, 40) to the centre of cell (40, 40), which is hit on a face to the east.
BEAM = np.array([[40, 40, 50, 40]]) * BEAM_ONE + BEAM_HALF
BIT = 1 << 5


def look_up(
    device: ComputeDevice,
    cell: tuple[int, int] = (40, 40),
    facing: int = 0,
    left_out: int = 0,
    reach: int = 4,
) -> list[int]:
    """Mark the one beam, and look a hit up at the centre of a cell."""

    def up(values: npt.ArrayLike, kind: type) -> Any:
        return device.upload(np.array(values, dtype=kind))

    hits = device.zeros((2, FACINGS, TILE, TILE), np.uint32)
    seen = device.zeros((2, TILE, TILE), np.uint32)
    pages = up(PAGES, np.int32)
    device.mark_chunks(
        hits, seen, pages, up(BEAM, np.int32), up([0], np.int32), up([BIT], np.uint32)
    )
    place = np.array([[*cell, *cell]]) * BEAM_ONE + BEAM_HALF
    beams = up(place, np.int32), up([facing], np.int32), up([left_out], np.uint32)
    return device.nearest_marks(hits, seen, pages, *beams, reach)[0].tolist()


def test_a_hit_is_found_with_its_distance(pocl: ComputeDevice):
    assert look_up(pocl) == [0, 1]
    assert look_up(pocl, (43, 40)) == [(3 * BEAM_ONE) ** 2, 1]
    assert look_up(pocl, (39, 42)) == [5 * BEAM_ONE**2, 0]
    assert look_up(pocl, (45, 40)) == [-1, 1]
    assert look_up(pocl, (35, 40)) == [-1, 0]


def test_what_is_left_out_is_neither_hit_nor_seen(pocl: ComputeDevice):
    assert look_up(pocl, left_out=BIT) == [-1, 0]
    assert look_up(pocl, left_out=2 * BIT) == [0, 1]


@pytest.mark.parametrize("facing", range(FACINGS))
def test_the_other_face_of_a_wall_is_not_found(pocl: ComputeDevice, facing: int):
    is_alike = facing in {0, 1, 2, FACINGS - 2, FACINGS - 1}
    assert look_up(pocl, facing=facing) == [0 if is_alike else -1, 1]


def test_beyond_the_window_there_is_nothing(pocl: ComputeDevice):
    for cell in ((-5, 40), (40, -5), (500, 40), (40, 500), (10, 10)):
        assert look_up(pocl, cell) == [-1, 0]


def test_where_nothing_is_marked_no_memory_is_taken(pocl: ComputeDevice):
    before = psutil.Process().memory_info().rss
    hits = pocl.zeros((4096, FACINGS, TILE, TILE), np.uint32)
    taken = psutil.Process().memory_info().rss - before
    assert taken < 0.1 * hits.size * hits.dtype.itemsize


def test_memory_stays_until_the_kernels_that_write_to_it_have_ended(pocl: ComputeDevice):
    count, seen = 1 << 20, pocl.zeros((2, TILE, TILE), np.uint32)
    rows = pocl.upload(PAGES), 3, 3, pocl.upload(np.repeat(BEAM, count, axis=0).astype(np.int32))
    zeros = pocl.upload(np.zeros(count, np.int32))
    hits = pocl.zeros((2, FACINGS, TILE, TILE), np.uint32)
    marks = pocl.opencl.launch("mark_chunks", (count,), hits, seen, *rows, zeros, zeros, count)
    del hits
    assert marks.command_execution_status == 0


def test_an_array_stays_until_the_kernel_that_fills_it_has_ended(
    pocl: ComputeDevice, monkeypatch: pytest.MonkeyPatch
):
    launch, events = pocl.opencl.launch, []
    monkeypatch.setattr(
        pocl.opencl, "launch", lambda *given: events.append(launch(*given)) or events[-1]
    )
    planes = [pocl.zeros((1 << 24,), kind) for kind in (np.uint16, np.uint8, np.uint8)]
    sums = pocl.start_known_by_distance(*planes)
    del sums
    assert events[-1].command_execution_status == 0
