"""What the scans say in the live fusion: doubts, the map drawn from them, the first frame."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from slamfusion.compute import ComputeDevice
from slamfusion.fusion.live import Evidence, State
from slamfusion.geometry import Pose2
from slamfusion.grid import CellBox, OccupancyGrid
from slamfusion.vote.lattice import Lattice
from tests.fusion.live.maps import (
    Drive,
    assert_same_lattice,
    live_fusion,
    moved_frame,
    on_lattice,
    shifted,
    started,
    three,
)

WHY = "the scans contradict its path since stamp 7.0 s"


def place_of(drive: Drive) -> tuple[Lattice, dict[str, Pose2]]:
    """Return the fused lattice and where the inputs lie in it."""
    lattice = drive.live.lattice
    assert lattice is not None
    records = drive.live.inputs()
    return lattice, {r.name: r.transform for r in records if r.transform is not None}


def tell(
    drive: Drive, doubts: Mapping[str, str] | None = None, drawn: OccupancyGrid | None = None
) -> None:
    """Let the scans say something of all three inputs."""
    lattice, transforms = place_of(drive)
    drive.live.put_evidence(Evidence(transforms, doubts or {}, lattice, drawn))
    assert drive.live.has_new
    drive.step()
    assert not drive.live.has_new


def test_scans_take_a_vote_and_give_it_back(device: ComputeDevice) -> None:
    drive = started(device)
    tell(drive, {"b": WHY})
    assert drive.accepted() == "ac"
    assert drive.input("b").state is State.DOUBTED
    assert drive.input("b").reason == WHY
    tell(drive)
    assert drive.accepted() == "abc"


def test_the_reference_hands_over_when_the_scans_contradict_it(device: ComputeDevice) -> None:
    drive = started(device)
    lattice, _ = place_of(drive)
    tell(drive, {"a": WHY})
    assert drive.accepted() == "bc"
    assert drive.live.lattice == lattice
    assert drive.input("b").fit.score == 1.0 or drive.input("c").fit.score == 1.0


def test_scans_decide_and_not_how_far_poses_are_apart(device: ComputeDevice) -> None:
    """Poses of a that leave the others doubt it; where the scans support a, they do not."""

    def part(drive: Drive) -> None:
        _, transforms = place_of(drive)
        for number in range(120):
            away = 3.0 if number > 40 else 0.0
            for name, transform in transforms.items():
                here = Pose2(0.1 * number, away if name == "a" else 0.0, 0.0)
                drive.live.hear(name, 0.1 * number, transform.inverse().compose(here))

    drive = started(device)
    part(drive)
    drive.step(*three().values())
    assert drive.accepted() == "bc"
    tell(drive)
    assert drive.accepted() == "abc"


def test_the_map_drawn_from_scans_takes_the_vote_of_those_it_was_drawn_by(
    device: ComputeDevice,
) -> None:
    drive = started(device)
    before = drive.fused
    drawn = shifted(before, 3)
    tell(drive, drawn=drawn)
    assert_same_lattice(before, drive.fused)
    assert np.array_equal(on_lattice(drive.fused, drawn), drawn.cells)
    cells = drawn.cells.copy()
    cells[40:44, 50:54] = 100
    more = OccupancyGrid(cells, drawn.resolution, drawn.origin, "drawn")
    drive.live.put_evidence(Evidence(place_of(drive)[1], {}, place_of(drive)[0], more))
    drive.step()
    assert np.array_equal(on_lattice(drive.fused, more), cells)
    assert drive.accepted() == "abc"


def test_a_map_without_poses_votes_next_to_the_drawn_one(device: ComputeDevice) -> None:
    drive = started(device)
    before = drive.fused
    lattice, transforms = place_of(drive)
    half = before.crop(CellBox(0, 0, before.height, before.width // 2)).with_name("drawn")
    del transforms["c"]
    drive.live.put_evidence(Evidence(transforms, {}, lattice, half))
    drive.step()
    # What the drawn map has not seen is known by c.
    assert drive.fused.width > half.width + before.width // 4


def test_the_map_drawn_first_gives_the_frame(device: ComputeDevice) -> None:
    """A single map fuses nothing by itself; drawn from the scans it is where its poses say."""
    drive = Drive(live_fusion(device))
    place = three()["a"]
    away = Pose2(4.0, -2.0, 0.7)
    drive.step(moved_frame(place, away))
    assert drive.live.lattice is None
    lattice = Lattice(place.resolution, place.origin)
    drive.live.put_evidence(Evidence({"a": away.inverse()}, {}, lattice, place))
    drive.step()
    assert drive.live.lattice == lattice
    assert drive.accepted() == "a"
    assert np.array_equal(on_lattice(drive.fused, place) == 100, place.cells == 100)


def test_a_map_drawn_on_another_frame_is_not_used(device: ComputeDevice) -> None:
    drive = started(device)
    before, (lattice, transforms) = drive.fused, place_of(drive)
    other = Lattice(lattice.resolution, Pose2(1.0, 2.0, 0.3))
    drawn = moved_frame(shifted(before, 3), Pose2(1.0, 2.0, 0.3))
    drive.live.put_evidence(Evidence(transforms, {}, other, drawn))
    drive.step()
    assert drive.fused is before


def test_reset_forgets_what_the_scans_said(device: ComputeDevice) -> None:
    drive = started(device)
    tell(drive, {"b": WHY})
    drive.live.reset()
    drive.step()
    assert drive.accepted() == "abc"
