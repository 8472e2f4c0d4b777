"""What nodes of one session say once, and how far a log is."""

from __future__ import annotations

from pathlib import Path

import pytest

rclpy = pytest.importorskip("rclpy", reason="rclpy is absent: install the extra ros")

from slamfusion.ros.base import Diagnostics, Level  # noqa: E402
from slamfusion.ros.player_progress import APART_S, ProgressLines  # noqa: E402
from slamfusion.ros.session import SESSION_VARIABLE, is_first_to_say  # noqa: E402

pytestmark = [pytest.mark.ros, pytest.mark.once]


class Log:
    """Keeps warnings, as a logger of rclpy takes them."""

    def __init__(self) -> None:
        self.said: list[str] = []

    def warning(self, text: str) -> None:
        self.said.append(text)


def test_of_the_nodes_of_a_session_one_says_what_holds_for_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    logs = Log(), Log()
    first, second = (Diagnostics(log) for log in logs)
    monkeypatch.setenv(SESSION_VARIABLE, str(tmp_path))
    for told in (first, second):
        told.add("device", Level.WARN, "no GPU", is_of_all=True)
        told.add("own", Level.WARN, "no scans")
    assert [log.said for log in logs] == [["no GPU", "no scans"], ["no scans"]]
    # Each goes on to have it in its diagnostics.
    assert second.worst() == (Level.WARN, "no GPU; no scans")


@pytest.mark.parametrize("folder", [None, "gone", "file"])
def test_a_node_alone_and_one_whose_session_cannot_be_written_speak(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, folder: str | None
) -> None:
    (tmp_path / "file").touch()  # no folder
    monkeypatch.delenv(SESSION_VARIABLE, raising=False)
    if folder is not None:
        monkeypatch.setenv(SESSION_VARIABLE, str(tmp_path / folder))
    assert [is_first_to_say("no GPU") for _ in range(2)] == [True, True]


def test_each_tenth_of_a_log_is_a_line_but_none_comes_too_soon() -> None:
    said: list[str] = []
    now_s = [0.0]
    progress = ProgressLines(said.append, lambda: now_s[0])

    def tell(share: float, after_s: float) -> None:
        now_s[0] += after_s
        progress.tell(share, f"at {share}")

    tell(0.05, APART_S)
    tell(0.11, 0.1)
    tell(0.12, 0.1)
    tell(0.25, APART_S - 0.2)
    tell(0.31, 0.2)
    tell(1.0, APART_S)  # the end has a line of its own
    assert said == ["played 11%: at 0.11", "played 31%: at 0.31"]
    tell(0.1, APART_S)  # played again
    assert said[2:] == ["played 10%: at 0.1"]
