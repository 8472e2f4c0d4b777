"""The report in headless Chromium: it loads, every picture decodes, and it is not blank."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import cv2
import pytest

from slamfusion.config import NormalizeConfig, RunConfig
from slamfusion.evaluation import compare_to_truth
from slamfusion.report import write_fusion_report
from tests.report.drawn import colours_of, fusion, room

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")

pytestmark = [
    pytest.mark.once,
    pytest.mark.skipif(
        CHROMIUM is None, reason="no chromium on the PATH; apt-get install chromium"
    ),
]

PROBE = """<script>
window.addEventListener('load', () => {
  const sizes = [...document.images].map(image => image.naturalWidth);
  const wide = document.documentElement.scrollWidth - window.innerWidth;
  document.body.innerHTML =
    `<p id=probe>${sizes.length} ${Math.min(...sizes)} ${wide} ${window.ran ?? 'nothing ran'}</p>`;
});
</script>"""


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    truth = room("truth", 7)
    errors = [
        compare_to_truth(room("fused", 0), truth, normalize=NormalizeConfig(), tolerance_m=0.1)
    ]
    name = "<img src=x onerror='window.ran=1'><script>window.ran = 2</script>"
    return write_fusion_report(
        fusion(rejected_name=name),
        tmp_path_factory.mktemp("report"),
        config=RunConfig(),
        evaluations=errors,
    )


def browse(profile: Path, page: Path, *options: str) -> str:
    """Open a page in a browser of its own and return what it prints."""
    assert CHROMIUM is not None
    done = subprocess.run(
        [
            CHROMIUM,
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--disable-background-networking",
            "--disable-dev-shm-usage",
            "--hide-scrollbars",
            f"--user-data-dir={profile}",
            *options,
            page.as_uri(),
        ],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    return done.stdout


@pytest.mark.parametrize("width", [1360, 700])
def test_every_picture_decodes_and_no_name_runs(report: Path, tmp_path: Path, width: int) -> None:
    html = report.read_text(encoding="utf-8")
    # The page's own policy forbids every script, the probe too.
    allowed = re.sub(r"<meta http-equiv=\"Content-Security-Policy\"[^>]*>", "", html)
    assert allowed != html
    copy = tmp_path / "probe.html"
    copy.write_text(allowed.replace("</head>", PROBE + "</head>"), encoding="utf-8")
    dom = browse(tmp_path / "profile", copy, "--dump-dom", f"--window-size={width},900")
    found = re.search(r'<p id="probe">(\d+) (\d+) (-?\d+) (.*?)</p>', dom)
    assert found is not None, dom[:500]
    assert int(found[1]) == html.count("<img ")
    assert int(found[2]) > 100
    assert int(found[3]) <= 0, "the page is wider than its window"
    assert found[4] == "nothing ran"


def test_the_page_is_not_blank(report: Path, tmp_path: Path) -> None:
    shot = tmp_path / "shot.png"
    browse(tmp_path / "profile", report, f"--screenshot={shot}", "--window-size=1360,1600")
    image = cv2.imread(str(shot), cv2.IMREAD_COLOR)
    assert image is not None
    assert image.shape[1] == 1360
    assert len(colours_of(image)) > 200
    # The headline's bar is drawn in the colour of a warning: one input was rejected.
    assert tuple(int(value) for value in image[3, 700, ::-1]) == (0x9A, 0x5B, 0x00)


def test_the_title_names_the_program(report: Path, tmp_path: Path) -> None:
    dom = browse(tmp_path / "profile", report, "--dump-dom")
    assert "<title>SLAMfusion report</title>" in dom
