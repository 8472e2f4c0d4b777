"""What surrounds the code says the same as the code: version, Pythons, packages, forms."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from slamfusion import __version__

ROOT = Path(__file__).resolve().parents[1]
GITHUB = ROOT / ".github"
PYTHONS = ["3.10", "3.11", "3.12", "3.13"]


def read(path: str) -> str:
    return (ROOT / path).read_text(encoding="utf-8")


@pytest.fixture
def workflow() -> dict[str, Any]:
    return yaml.safe_load(read(".github/workflows/test.yml"))


def test_the_citation_has_the_version_and_the_paper():
    citation = yaml.safe_load(read("CITATION.cff"))
    assert citation["version"] == __version__
    assert citation["license"] == "MIT"
    paper = citation["preferred-citation"]
    readme = read("README.md")
    assert all(person["family-names"] in readme for person in paper["authors"])
    assert f"year      = {{{paper['year']}}}" in readme


def test_the_workflow_tests_every_python_that_is_held(workflow: dict[str, Any]):
    matrix = workflow["jobs"]["python"]["strategy"]["matrix"]
    assert matrix["python-version"] == PYTHONS
    assert f'requires-python = ">={PYTHONS[0]}"' in read("pyproject.toml")
    for page in ("README.md", "docs/install.md"):
        assert f"Python {PYTHONS[0]} to {PYTHONS[-1]}" in read(page)


def test_the_workflow_has_the_jazzy_leg_of_test_sh(workflow: dict[str, Any]):
    (marks,) = re.findall(r'-m ("jazzy[^"]*")', read("launch_scripts/test.sh"))
    steps = " ".join(step.get("run", "") for step in workflow["jobs"]["jazzy"]["steps"])
    assert marks in steps
    assert "-c launch_scripts/constraints-jazzy.txt" in steps


def test_everything_runs_each_night():
    nightly = yaml.safe_load(read(".github/workflows/nightly.yml"))
    steps = [step.get("run", "") for step in nightly["jobs"]["full"]["steps"]]
    assert "launch_scripts/test.sh --full" in steps
    # YAML reads the key `on` as a truth value.
    assert nightly[True]["schedule"][0]["cron"]


@pytest.mark.parametrize("path", sorted(GITHUB.rglob("*.yml")), ids=lambda path: path.stem)
def test_scripts_and_files_that_workflows_name_are_there(path: Path):
    for name in re.findall(r"launch_scripts/[\w.-]+", path.read_text(encoding="utf-8")):
        assert (ROOT / name).is_file(), name


@pytest.mark.parametrize("name", ["Dockerfile", "Dockerfile.jazzy"])
def test_a_docker_file_copies_what_is_there(name: str):
    text = read(f"launch_scripts/{name}")
    for copied in re.findall(r"^COPY (.*) \S+$", text, flags=re.MULTILINE):
        for source in copied.split():
            assert (ROOT / source).exists(), source
    assert "slamfusion doctor" in text
    assert f"-f launch_scripts/{name} " in read("docs/install.md")


def test_the_jazzy_image_has_the_packages_that_the_install_page_names():
    named = set(re.findall(r"\b(?:python3-\w+|pocl-[\w-]+)", read("docs/install.md")))
    image = set(
        re.findall(r"\b(?:python3-\w+|pocl-[\w-]+)", read("launch_scripts/Dockerfile.jazzy"))
    )
    assert named - {"python3-venv", "pocl-binary-distribution"} == image


def test_the_pip_image_copies_what_the_wheel_is_built_of():
    text = read("launch_scripts/Dockerfile")
    project = read("pyproject.toml")
    (readme,) = re.findall(r'^readme = "(.*)"$', project, flags=re.MULTILINE)
    for name in (readme, "LICENSE", "pyproject.toml", "kernels", "slamfusion"):
        assert re.search(rf"^COPY .*\b{re.escape(name)}\b", text, flags=re.MULTILINE), name


def test_tests_replace_and_import_no_private_names():
    """What ruff's SLF001 does not see."""
    private = re.compile(
        r"""setattr\([^)]*["'](?:[\w.]+\.)?_(?!_)\w+["'] | import\ [^\n]*\b_(?!_)\w+""", re.VERBOSE
    )
    found = {
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / "tests").rglob("*.py")
        if private.search(path.read_text(encoding="utf-8"))
    }
    assert not found
