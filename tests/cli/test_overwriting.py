"""No command writes over what it reads: refused at once, by names, with nothing touched."""

from __future__ import annotations

import gzip
import os
import shutil
from pathlib import Path

import click
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slamfusion.cli.paths import InputPath, OutputPath
from slamfusion.cli.program import cli, run_program
from slamfusion.errors import SlamFusionError
from slamfusion.io.files import refuse_overwriting
from tests.cli.command import SAMPLE, tree

Case = tuple[str, str, str]

LOG = "FLASER 4 1.0 1.1 1.2 1.3 0 0 0 0 0 0 1.0 robot 1.0\n"

SWEEP = "here/occupancy-estimator.csv"
# Words of the command, the input that it names, and the output.
CASES: dict[str, Case] = {
    "the picture of a map": ("fuse floor.yaml b.yaml c.yaml -o map", "map.pgm", "-o map"),
    "a packed picture by its name": ("fuse packed.yaml b.yaml -o grey", "grey.pgm", "-o grey"),
    "the agreement": ("fuse x_agreement.yaml b.yaml -o x", "x_agreement.yaml", "-o x"),
    "a further group": ("fuse x-2.yaml a.yaml b.yaml c.yaml -o x", "x-2.yaml", "-o x"),
    "the map of a folder": ("fuse run b.yaml -o run/fused", "run/fused.yaml", "-o run/fused"),
    "a truth": ("fuse a.yaml b.yaml --truth c.yaml -o c", "c.yaml", "-o c"),
    "a picture in the folder of the report": (
        "fuse 01-plan.yaml b.yaml -o x --report .",
        "01-plan.png",
        "--report .",
    ),
    "a map by its picture": ("fuse a.yaml b.yaml -o a.BMP", "a.yaml", "-o a.BMP"),
    "a map beside a store": ("fuse a.yaml b.yaml -o a.zarr", "a.yaml", "-o a.zarr"),
    "a table": ("fuse a.yaml b.yaml -o x --config t.csv --table t.csv", "t.csv", "--table t.csv"),
    "a map of a run": ("run d.log --inputs mine.yaml -o run", "run/fused.pgm", "-o run"),
    "a path of a run": ("run d.log --paths run/graph.tum -o run", "run/graph.tum", "-o run"),
    "a map of several runs": ("run d.log e.log --inputs run/d/fused.yaml -o run", "fused.yaml", ""),
    "a map of a failed run": (
        "run d.log e.log --inputs run/d/failed/graph.yaml -o run",
        "run/d/failed/graph.yaml",
        "-o run",
    ),
    "a log": ("slam graph drive.yaml -o drive", "drive.yaml", "-o drive"),
    "a bag": ("slam graph bag -o bag/metadata", "bag/metadata.yaml", "-o bag/metadata"),
    "the true map of a SLAM": ("slam graph d.log --truth-map floor.yaml -o map", "map.pgm", ""),
    "scan odometry": ("slam graph d.log --scan-odometry x.json -o x.yml", "x.json", "-o x"),
    "a state": ("slam gmapping d.log --resume s --save-state s -o x", "s", "--save-state s"),
    "a further table of a path": (
        "trajectory t-2.csv --truth p.tum --table t.csv",
        "t-2.csv",
        "--table t.csv",
    ),
    "the report of many paths": (
        "trajectory one/b.tum one/c.tum --truth one.tum --config r/report.html --report r",
        "report.html",
        "--report r",
    ),
    "a pose graph": ("graph optimize g.g2o -o sub/../g.g2o", "g.g2o", "-o sub/../g.g2o"),
    "two outputs": ("graph optimize g.g2o -o n --tum n", "a file of -o n", "--tum n"),
    "a plot": ("compare r.zip i.png --plot i.png", "i.png", "--plot i.png"),
    "a course": ("simulate here/course.yaml -o here", "here/course.yaml", "-o here"),
    "the map of a course": ("simulate here/my.yaml -o here", "here/truth.yaml", "-o here"),
    "the world": (
        "simulate here/../other.yaml --world here/truth.yaml -o here",
        "here/truth.yaml",
        "-o here",
    ),
    "the reference of an experiment": (
        f"experiment occupancy-estimator -o here --log d.log --reference {SWEEP}",
        SWEEP,
        "-o here",
    ),
    "the relations of an experiment": (
        "experiment cell-models-trajectories --log d.log:here/cell-models-trajectories.csv -o here",
        "here/cell-models-trajectories.csv",
        "-o here",
    ),
    "a map of an experiment": (
        "experiment real-logs --datasets data --inputs intel=here/plan.yaml -o here",
        "here/real-logs.png",
        "-o here",
    ),
    "what an experiment keeps": (
        "experiment failures --config here/trials/one.json -o here",
        "here/trials/one.json",
        "-o here",
    ),
}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make every input of the cases."""
    folder = tmp_path_factory.mktemp("made")
    for name in ("sub", "run/d/failed", "one", "bag", "here/trials", "r/one/b", "data"):
        (folder / name).mkdir(parents=True)

    def save(name: str, image: str, of: str = "map_a") -> None:
        path, text = folder / name, (SAMPLE / f"{of}.yaml").read_text(encoding="utf-8")
        path.write_text(text.replace(f"{of}.pgm", image), encoding="utf-8")
        (path.parent / image).write_bytes((SAMPLE / f"{of}.pgm").read_bytes())

    save("b.yaml", "b.pgm", "map_b")
    save("c.yaml", "c.pgm", "map_c")
    for name in ("a", "x_agreement", "x-2", "one/b", "here/truth"):
        save(f"{name}.yaml", f"{Path(name).name}.pgm")
    save("floor.yaml", "map.pgm")
    save("mine.yaml", "run/fused.pgm")
    save("run/fused.yaml", "fused.pgm")
    save("run/graph.yaml", "graph.pgm")
    save("run/d/fused.yaml", "fused.pgm")
    save("run/d/failed/graph.yaml", "graph.pgm")
    save("i.yaml", "i.png")
    save("01-plan.yaml", "01-plan.png")
    save("here/plan.yaml", "real-logs.png")
    save("packed.yaml", "grey.pgm")
    (folder / "grey.pgm.gz").write_bytes(gzip.compress((folder / "grey.pgm").read_bytes()))
    (folder / "grey.pgm").unlink()
    for name in ("d.log", "e.log", "drive.yaml", "bag/metadata.yaml", "bag/bag.db3"):
        (folder / name).write_text(LOG, encoding="utf-8")
    for name in ("x.json", "run/fused.json", "here/trials/one.json", "r/report.html"):
        (folder / name).write_text("{}", encoding="utf-8")
    (folder / "t.csv").write_text("{}", encoding="utf-8")
    poses = ["p.tum", "q.tum", "one.tum", "one/b.tum", "here/cell-models-trajectories.csv", SWEEP]
    poses += ["one/c.tum", "t-2.csv", "r.zip", "s", "g.g2o", "run/graph.tum", "run/fused.tum"]
    for name in poses:
        (folder / name).write_text("1 0 0 0 0 0 0 1\n", encoding="utf-8")
    courses = {"here/course.yaml": "office", "here/my.yaml": "truth.yaml", "other.yaml": "office"}
    for name, world in courses.items():
        (folder / name).write_text(f"world: {world}\n", encoding="utf-8")
    return folder


@pytest.fixture
def place(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a copy of the inputs, links beside them, as the working folder."""
    folder = tmp_path / "place"
    shutil.copytree(made, folder)
    (folder / "linked").symlink_to(".")
    (folder / "link.yaml").symlink_to("a.yaml")
    os.link(folder / "a.yaml", folder / "hard.yaml")
    monkeypatch.chdir(folder)
    return folder


@pytest.mark.parametrize("case", CASES)
def test_an_output_over_an_input_is_refused_before_any_work(
    case: str, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words, named, asked = CASES[case]
    before = tree(place)
    assert run_program(words.split()) == 2
    out, error = capsys.readouterr()
    (line,) = error.splitlines()
    assert "would replace" in line
    assert named in line
    assert asked in line
    assert out == ""
    assert tree(place) == before


def test_the_line_names_the_input_that_was_given_and_its_file(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    del place
    assert run_program(["fuse", "floor.yaml", "b.yaml", "c.yaml", "-o", "sub/../map"]) == 2
    assert capsys.readouterr().err == (
        "slamfusion: error: -o sub/../map would replace the input map.pgm (of "
        "floor.yaml) with sub/../map.pgm; choose another name\n"
    )
    assert run_program(["slam", "gmapping", "d.log", "--save-state", "sub", "-o", "x"]) == 2
    assert "sub: wanted a name, found a folder; write e.g. sub/NAME" in capsys.readouterr().err


@pytest.mark.usefixtures("place")
@pytest.mark.parametrize(
    "words",
    [
        "fuse run b.yaml c.yaml -o run/other --table run/other.csv",
        "graph optimize linked/cube.g2o -o cube.tum",
    ],
)
def test_a_command_may_be_given_again_and_write_beside_its_inputs(words: str) -> None:
    Path("cube.g2o").write_text(
        "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n", encoding="utf-8"
    )
    for _ in range(2):
        assert run_program(words.split()) == 0


def test_files_of_an_earlier_command_that_stay_are_named(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("x.png", "x-2_agreement.yaml"):
        (place / name).touch()
    assert run_program(["fuse", "a.yaml", "b.yaml", "-o", "x"]) == 0
    _, named = capsys.readouterr().err.split("not from this command, though named like its results")
    assert named == ": x.png, x-2.yaml, x-2.pgm, x-2_agreement.yaml\n"


def test_every_command_says_of_its_paths_what_they_are_for() -> None:
    """An option that names an output cannot be an input by oversight: its name tells."""

    def options(command: click.Command) -> list[tuple[str, click.Parameter]]:
        context = click.Context(command)
        own = [(command.name or "", option) for option in command.params]
        if not isinstance(command, click.Group):
            return own
        below = [command.get_command(context, name) for name in command.list_commands(context)]
        return own + [item for found in below if found is not None for item in options(found)]

    outputs = {
        *("--output", "--report", "--table", "--plot", "--save-results"),
        *("--save-state", "--fused", "--tum"),
    }
    for command, option in options(cli):
        is_path = isinstance(option.type, (InputPath, OutputPath))
        is_output = bool(outputs & {*option.opts})
        assert isinstance(option.type, OutputPath) == is_output, (command, option.opts)
        assert is_path or "FILE" not in (option.metavar or ""), (command, option.opts)


# Ways round that lead back to the same folder.
ROUNDS = st.lists(st.sampled_from(["sub/..", ".", "linked", "linked/sub/.."]), max_size=4)


@given(ROUNDS, ROUNDS, st.sampled_from(["a", "link", "hard", "b", "new"]))
def test_files_are_the_same_however_their_paths_are_written(
    tmp_path_factory: pytest.TempPathFactory, read: list[str], written: list[str], name: str
) -> None:
    folder = tmp_path_factory.mktemp("paths")
    (folder / "sub").mkdir()
    (folder / "linked").symlink_to(".")
    for file in "ab":
        (folder / file).touch()
    (folder / "link").symlink_to("a")
    os.link(folder / "a", folder / "hard")
    source = Path(folder, *read, "a")
    reads, writes = [(source, source)], [("-o x", Path(folder, *written, name))]
    if name in {"b", "new"}:
        refuse_overwriting(reads, writes)
    else:
        with pytest.raises(SlamFusionError, match="-o x would replace the input"):
            refuse_overwriting(reads, writes)
