"""Claims about opening logs of any kind, and about counting what is left out."""

from __future__ import annotations

import gzip
import pickle
from pathlib import Path

import numpy as np
import pytest

from slamfusion.config import LogConfig
from slamfusion.errors import LogError
from slamfusion.geometry import Pose2
from slamfusion.io import open_log
from slamfusion.io.carmen import CarmenLog
from slamfusion.io.log import Continuity, LogScan, Skips
from slamfusion.io.tinyslam_dat import TinySlamDat
from slamfusion.scan import LaserScan
from tests.io.logs import flaser, write_lines
from tests.io.test_tinyslam_dat import row


@pytest.mark.parametrize("name", ["a.clf", "a.log", "a.txt", "a.gfs", "a.carmen", "A.LOG"])
@pytest.mark.parametrize("packed", [False, True])
def test_carmen_logs_are_known_by_their_names(tmp_path: Path, name: str, packed: bool) -> None:
    data = f"{flaser(1)}\n".encode()
    path = tmp_path / (f"{name}.gz" if packed else name)
    path.write_bytes(gzip.compress(data) if packed else data)
    log = open_log(path)
    assert isinstance(log, CarmenLog)
    sent = pickle.dumps(log)  # as it is to another process
    assert len(sent) < 10_000
    path.unlink()  # it is parsed once
    for again in (log, pickle.loads(sent)):  # noqa: S301 - our own
        assert [item.line for item in again] == [1]


def test_the_content_speaks_before_the_name(tmp_path: Path) -> None:
    assert isinstance(open_log(write_lines(tmp_path / "a.dat", flaser(1))), CarmenLog)
    assert isinstance(open_log(write_lines(tmp_path / "a.log", row(1))), TinySlamDat)


def test_the_configuration_reaches_the_reader(tmp_path: Path) -> None:
    path = write_lines(tmp_path / "a.log", flaser(1, [1.0, 6.0]))
    assert next(iter(open_log(path, LogConfig(no_return_m=5.0)))).scan.range_max_m == 5.0


def refusal(path: Path) -> str:
    """Return the one line with which a path is refused."""
    with pytest.raises(LogError) as caught:
        open_log(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    return message


@pytest.mark.parametrize("name", ["a.log", "a.clf.gz", "a.dat", "a.bag", "a.db3", "a.mcap"])
def test_an_empty_file_is_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.touch()
    assert "the file is empty" in refusal(path)


@pytest.mark.parametrize(
    "data", [gzip.compress(b"FLASER", mtime=0)[:9], b"\x1f\x8b and no more of gzip"]
)
def test_a_packed_file_of_which_nothing_can_be_read_is_not_called_empty(
    tmp_path: Path, data: bytes
) -> None:
    path = tmp_path / "a.log.gz"
    path.write_bytes(data)
    assert "the packed file ends early or is damaged; copy it again" in refusal(path)


@pytest.mark.parametrize("name", ["a.xyz", "a", "a.gz", "a.pgm.gz"])
def test_an_unknown_extension_is_refused_whatever_is_inside(tmp_path: Path, name: str) -> None:
    message = refusal(write_lines(tmp_path / name, flaser(1)))
    assert ".clf" in message
    assert ".mcap" in message


def test_a_path_or_a_map_is_not_to_be_renamed(tmp_path: Path) -> None:
    for name, line, words in (
        ("graph.tum", "1 0 0 0 0 0 0 1", "found a path; `slamfusion trajectory` and `judge`"),
        ("results.zip", "PK", "found a zip; `slamfusion compare` reads those of --save-results"),
        ("drive.scans", flaser(1), "found a log that ends in '.scans'; rename it by its kind"),
    ):
        assert words in refusal(write_lines(tmp_path / name, line))


@pytest.mark.parametrize("name", ["a.log", "a.clf", "a.txt", "a.dat"])
def test_binary_junk_is_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(np.random.default_rng(1).bytes(5000))
    assert "found binary data" in refusal(path)


def test_a_log_without_a_laser_says_what_it_has(tmp_path: Path) -> None:
    lines = ["PARAM a b h 0", *["ODOM 0 0 0 0 0 0 1 h 0"] * 3]
    message = refusal(write_lines(tmp_path / "a.log", *lines))
    assert "no laser in it" in message
    assert "3 ODOM, 1 PARAM" in message


def test_a_log_whose_scans_are_all_damaged_says_why(tmp_path: Path) -> None:
    message = refusal(write_lines(tmp_path / "a.log", flaser(1)[:20], flaser(2)[:20]))
    assert "2 x wrong number of fields (a cut-off line?) (line 1, 2)" in message


def test_what_a_folder_that_is_no_bag_holds_is_named(tmp_path: Path) -> None:
    assert "found nothing in it; name a log or a bag's folder" in refusal(tmp_path)
    store = tmp_path / "out.zarr"
    store.mkdir()
    assert "found a store of fused maps; the Python package zarr reads it" in refusal(store)
    (tmp_path / "graph.tum").touch()
    assert "found one with graph.tum, a path; `slamfusion trajectory`" in refusal(tmp_path)
    for name in ("a.log", "b.log"):
        write_lines(tmp_path / name, flaser(1))
    assert "found several logs (a.log, b.log); name one" in refusal(tmp_path)


def test_the_only_log_of_a_folder_is_taken(tmp_path: Path) -> None:
    write_lines(tmp_path / "a.log", flaser(1))
    (tmp_path / "notes.md").write_text("notes", encoding="utf-8")
    assert len(list(open_log(tmp_path))) == 1


def test_a_line_without_end_is_refused_before_it_fills_the_memory(tmp_path: Path) -> None:
    path = tmp_path / "a.log"
    path.write_bytes(b"FLASER 3 " + b"1 " * (9 << 20))
    assert "line 1 is longer than 16 MiB" in refusal(path)


def test_skips_keep_the_first_lines_of_each_reason() -> None:
    skips = Skips()
    for line in range(1, 8):
        skips.add("b", line)
    skips.add("a", 9)
    assert skips.total == 8
    assert skips.sentences() == ("1 x a (line 9)", "7 x b (line 1, 2, 3, 4, 5, ...)")
    assert skips.to_json()[1] == {"reason": "b", "count": 7, "first_lines": [1, 2, 3, 4, 5]}


def accepted(*scans: tuple[float, Pose2 | None]) -> tuple[list[bool], Skips, Skips]:
    skips, warnings = Skips(), Skips()
    continuity = Continuity(skips, warnings)
    used: list[int] = []
    for line, (stamp_s, pose) in enumerate(scans, start=1):
        scan = LaserScan(stamp_s, np.ones(3, np.float32), -1.0, 1.0, 0.0, 10.0)
        used += [item.line for item in continuity.passed(LogScan(scan, pose, line))]
    used += [item.line for item in continuity.rest()]
    return [line in used for line in range(1, len(scans) + 1)], skips, warnings


@pytest.mark.parametrize("ahead_s", [20.0, 3600.0, 86_400.0])
def test_one_stray_stamp_ahead_keeps_no_other_scan_out(ahead_s: float) -> None:
    stamps_s = [100.0 + 0.1 * index for index in range(50)]
    stamps_s[20] += ahead_s
    flags, skips, warnings = accepted(*((stamp_s, None) for stamp_s in stamps_s))
    assert [line for line, is_used in enumerate(flags) if not is_used] == [20]
    assert skips.lines == {"a time stamp far ahead of those before and after it": [21]}
    assert warnings.total == 0


def test_a_pause_is_no_stray_stamp_also_at_the_end() -> None:
    flags, skips, _ = accepted(*((stamp_s, None) for stamp_s in (0.0, 0.1, 30.0, 30.1, 30.2, 90.0)))
    assert all(flags)
    assert skips.total == 0


def test_time_must_go_on() -> None:
    flags, skips, _ = accepted((5.0, None), (5.0, None), (4.0, None), (5.1, None))
    assert flags == [True, False, False, True]
    assert skips.lines == {"two scans of one stamp": [2], "time goes back": [3]}


@pytest.mark.parametrize(("gap_s", "warned"), [(3599.0, 0), (3600.0, 1)])
def test_a_gap_is_warned_of_from_an_hour_on(gap_s: float, warned: int) -> None:
    flags, _, warnings = accepted((0.0, None), (gap_s, None), (gap_s + 1.0, None))
    assert all(flags)
    assert warnings.total == warned


@pytest.mark.parametrize(("jump_m", "warned"), [(49.9, 0), (50.0, 1)])
def test_a_jump_is_warned_of_from_50_m_on(jump_m: float, warned: int) -> None:
    scans = ((0.0, Pose2()), (1.0, None), (2.0, Pose2(0.0, jump_m, 0.0)))
    flags, _, warnings = accepted(*scans)
    assert all(flags)
    assert warnings.total == warned
