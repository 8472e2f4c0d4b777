"""The small parts of the command line: names, JSON, options."""

from __future__ import annotations

import io
import sys
from pathlib import Path

import click
import pytest

from slamfusion.cli import slam
from slamfusion.cli.fuse import command as fuse_command
from slamfusion.cli.output import one_line, progress_bar
from slamfusion.cli.paths import FILE
from slamfusion.cli.program import COMMANDS, cli, run_program
from slamfusion.config import GMAPPING_PROFILES, RunConfig, config_fields
from slamfusion.errors import MapFileError
from slamfusion.jobs.inputs import check_writable, distinct_names, load_maps
from slamfusion.slam.registry import BUILT_IN, producer
from tests.cli.command import MAPS, ROOT


@pytest.mark.parametrize(
    ("paths", "names"),
    [
        (["x/a.yaml", "x/b.pgm.gz"], ["a", "b"]),
        (["a/map.yaml", "b/map.yaml"], ["a/map", "b/map"]),
        (["a/map.yaml", "b/map.yaml", "b/other.yaml"], ["a/map", "b/map", "other"]),
        (["a/x/map.yaml", "b/x/map.yaml"], ["a/x/map", "b/x/map"]),
        (["map.yaml", "map.yaml"], ["map", "map#2"]),
        (["one.two.yaml", ".yaml"], ["one.two", ".yaml"]),
    ],
)
def test_names_are_as_short_as_they_can_be(paths: list[str], names: list[str]) -> None:
    assert distinct_names([Path(path) for path in paths]) == names


def test_one_line_shows_what_cannot_be_printed() -> None:
    assert one_line("a\nb\tc\x1b[0m\x07") == "a b c\\x1b[0m\\x07"


def test_every_public_fusion_field_is_an_option_and_no_expert_one_is() -> None:
    offered = {name for parameter in fuse_command.params for name in parameter.opts}
    for field in config_fields(RunConfig):
        if field.section.split(".")[0] in {"fusion", "evaluate", "device", ""}:
            assert (field.flag in offered) == (field.info.level == "public"), field.key


def leaves(command: click.Command) -> list[click.Command]:
    """The commands of a group, or the command alone."""
    if not isinstance(command, click.Group):
        return [command]
    context = click.Context(command)
    found = [command.get_command(context, name) for name in command.list_commands(context)]
    return [leaf for leaf in found if leaf is not None]


def subcommands() -> list[click.Command]:
    """Every command that takes options."""
    return [leaf for command in leaves(cli) for leaf in leaves(command)]


def test_the_help_of_every_required_output_says_that_it_replaces_files() -> None:
    options = [option for command in subcommands() for option in command.params if option.required]
    outputs = [option for option in options if "-o" in option.opts]
    assert outputs
    for option in outputs:
        assert str(getattr(option, "help", "")).endswith("Existing files are replaced.")


def test_the_list_of_commands_says_what_their_help_says() -> None:
    for command, (name, (_, summary)) in zip(leaves(cli), COMMANDS.items(), strict=True):
        assert (command.name, str(command.help).split("\n")[0]) == (name, summary)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("rum a.log", "did you mean 'run'?; see slamfusion --help"),
        ("slam gmaping a.log -o out", "did you mean 'gmapping'?; see slamfusion slam --help"),
        ("fuse a.yaml b.yaml -o out --mode consenus", "'--mode': 'consenus' is not one of "),
        ("fuse a.yaml b.yaml -o out --mode consenus", "did you mean 'consensus'?"),
        ("node fussion", "did you mean 'fusion'?"),
        ("node tinyslam rate:=2", "a node's options stand after --ros-args"),
        ("fuse a.yaml b.yaml", "missing option '-o' / '--output'; see slamfusion fuse --help"),
        ("run --truth", "option '--truth' requires an argument; see slamfusion run --help"),
        ("run a.log --bogus", "did you mean '--verbose'?; see slamfusion run --help"),
        ("info", "missing argument 'LOG|BAG|MAP|RUN'; see slamfusion info --help"),
        ("fuse a b -o x --window-m foo", "'--window-m': wanted a number, found 'foo'"),
        ("fuse a b -o x --seed 1.5", "'--seed': wanted a whole number, found '1.5'"),
        ("fuse a b -o x --processes 65", "'--processes': must lie in [1, 64], found 65"),
        ("fuse a b -o x --occupied-percent 120", "'--occupied-percent': must lie in [0, 100] %, "),
        ("fuse a b -o x --window-m nan", "'--window-m': must lie in [0, inf] m, found nan"),
        ("fuse a b -o x --free-percent 80", "free_percent (80) must be below occupied_percent"),
        ("fuse a b -o .", "wanted a name, found a folder; write e.g. NAME"),
        ("fuse a b -o x/", "x/: wanted a name, found a folder; write e.g. x/NAME"),
        ("judge d.log a.tum --fused x/", "x/: wanted a name, found a folder"),
        ("fuse a b -o x --scheduler localhost:8786", "as a scheduler, found 'localhost:8786'"),
        ("fuse a b -o x --scheduler local --processes 2", "give one of them"),
        ("evaluate a.yaml --truth b.yaml --table x.xlsx", "x.xlsx: wanted a name that ends in"),
        ("evaluate a.yaml --truth b.yaml --table x.csv --json", "--table and --json exclude each"),
        ("evaluate a.yaml b.yaml", "give --truth MAP or --distances FILE; without both, fuse"),
        ("slam graph d.log -o map --resolution 0", "'--resolution': must lie in"),
        ("slam graph d.log -o map --odometry d.log", "needs --relations FILE"),
        ("run d.log -o out --odometry d.log", "needs --relations FILE"),
        ("run a.log -o out --seeds 3:5", "wanted seeds like 0-9 or 1,2,5"),
        ("slam graph a.log -o out --seeds 5-1", "wanted seeds like 0-9 or 1,2,5, found '5-1'"),
        ("run a.log -o out --seeds 0-999999999999", "at most 10000 seeds, found 1000000000000"),
        ("run a.log -o out --scheduler local", "--scheduler is for several logs"),
        ("run a.log -o out --producers grph", "'--producers': the SLAM 'grph' is not one of "),
        ("run a.log -o out --producers graph,graph", "each once, found graph, graph"),
        ("run a.log -o out --paths a.tum", "--paths needs --inputs MAP"),
        ("run a.log b.log -o out --truth x", "--truth belongs to one log"),
        ("run a.log b.log -o out --relations x", "--relations belongs to one log"),
        ("run a.log b.log -o out --odometry x", "--odometry belongs to one log"),
        ("judge d.log", "PATH"),
        ("judge d.log a.tum --odometry a.tum", "needs --relations FILE"),
        ("judge d.log a.tum --fused f.tum --log e.log", "with several (--log) call judge for each"),
        ("trajectory a.tum", "--relations FILE, --truth FILE, or both"),
        ("trajectory a.tum --odometry x --truth x", "needs --relations FILE"),
        ("trajectory a.tum --map x --truth x", "needs --report DIR"),
        ("trajectory a.tum --truth x --pictures svg", "--pictures needs --report DIR"),
        ("fuse a.yaml b.yaml -o x --pictures svg", "--pictures needs --report DIR"),
        ("align a b --scale 2:1", "wanted free, or metres per pixel as LOW:HIGH"),
        ("align a b --scale free --start 1,2,0", "--scale searches everywhere; leave --start out"),
        ("align a b -o placed", "-o and --scale belong together; give both or neither"),
        ("simulate f16 -o out --lidar sonar", "'--lidar': 'sonar' is not one of "),
        ("experiment occupancy-estimator -o out --relations x", "give --log"),
        ("experiment cell-models-trajectories -o out --floors 0", "nothing to run on"),
        ("experiment cell-models-trajectories -o out --log a.log", "wanted LOG:RELATIONS"),
        (
            "experiment occupancy-estimator -o out --resolutions 1..0.1",
            "'--resolutions': wanted a list of float, found '1..0.1'",
        ),
        ("experiment failures -o out --courses ,", "wanted some of corridor loop, glass"),
        ("experiment failures -o out --courses glas", "wanted some of corridor loop, glass"),
        (
            "experiment ground-obstacle -o out --repetitions 0",
            "'--repetitions': must lie in [1, 10000]",
        ),
        ("experiment no-such", "is not one of cell-models"),
    ],
)
def test_wrong_usage_is_one_line_with_the_nearest_name_and_writes_nothing(
    words: str,
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run_program(words.split()) == 2
    printed = capsys.readouterr()
    (line,) = printed.err.splitlines()
    assert line.startswith("slamfusion: error: ")
    assert said in line
    assert printed.out == ""
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("group", ["", "slam", "experiment", "node"])
def test_a_group_without_a_command_shows_its_help_as_wrong_usage(
    group: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_program(group.split()) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith(f"Usage: slamfusion {group}".rstrip())
    assert "\nCommands:\n" in printed.err


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_shell_gets_its_completion(
    shell: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("_SLAMFUSION_COMPLETE", f"{shell}_source")
    assert run_program([]) == 0
    assert f"_SLAMFUSION_COMPLETE={shell}_complete" in capsys.readouterr().out


def test_commands_slams_options_and_files_are_completed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("_SLAMFUSION_COMPLETE", "bash_complete")
    for line, word in (
        ("slamfusion tra", "plain,trajectory"),
        ("slamfusion slam gm", "plain,gmapping"),
        ("slamfusion fuse --mode maj", "plain,majority"),
        ("slamfusion run --tru", "plain,--truth-trajectory"),
        ("slamfusion run dri", "file,dri"),
    ):
        monkeypatch.setenv("COMP_WORDS", line)
        monkeypatch.setenv("COMP_CWORD", str(len(line.split()) - 1))
        assert run_program([]) == 0
        assert word in capsys.readouterr().out.splitlines()


def test_long_help_shows_the_basic_options_alone(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_program(["run", "--help"]) == 0
    text = capsys.readouterr().out
    assert run_program(["run", "--help-all"]) == 0
    whole = capsys.readouterr().out
    assert "--sweep-s" not in text
    assert "more options: slamfusion run --help-all" in text
    assert "--sweep-s" in whole
    for name in ("Examples:", "Input:", "Output:", "Ground truth:", "Vote:"):
        assert f"\n{name}\n" in text


@pytest.mark.parametrize("command", subcommands(), ids=lambda command: str(command.name))
def test_option_names_are_unique(command: click.Command) -> None:
    names = [
        name
        for parameter in command.params
        for name in (*parameter.opts, *parameter.secondary_opts)
    ]
    assert names
    assert len(names) == len(set(names))


def gmapping_help() -> dict[str, str]:
    """The help of every option of ``slam gmapping``, by name."""
    command = slam.command.get_command(click.Context(slam.command), "gmapping")
    options = [item for item in command.params if isinstance(item, click.Option)]
    return {name: item.help or "" for item in options for name in item.opts}


def test_gmapping_has_every_public_setting_under_its_published_name() -> None:
    offered = gmapping_help()
    for name in GMAPPING_PROFILES["published"]:
        assert "_" in name or f"--{name}" in offered
    for field in config_fields(RunConfig):
        if field.section == "gmapping":
            assert (field.flag in offered) == (field.info.level == "public"), field.key
    for name in ("--str", "--occ_thresh", "--map_update_interval", "--particles", "--delta"):
        assert name in offered
    # One that says where raw odometry is, and one that says whether it is used.
    assert {"--odometry", "--use-odometry"} <= offered.keys()


def test_only_producers_that_can_go_on_have_the_options_for_it() -> None:
    wanted = {"--save-state", "--resume", "--stop-after"}
    context = click.Context(slam.command)
    for name in BUILT_IN:
        command = slam.command.get_command(context, name)
        offered = {option for parameter in command.params for option in parameter.opts}
        able = producer(name).load is not None
        assert wanted & offered == (wanted if able else set())


def test_check_writable_makes_nothing(tmp_path: Path) -> None:
    check_writable(tmp_path / "new" / "deeper")
    assert not list(tmp_path.iterdir())
    (tmp_path / "file").write_text("", encoding="utf-8")
    with pytest.raises(MapFileError, match="not a folder"):
        check_writable(tmp_path / "file" / "below")


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(
    "words",
    [
        "align a.yaml plan.png --scale free -o out",
        "compare a.zip b.zip --plot plot.png",
        "evaluate a.yaml --truth b.yaml --report out",
        "fuse a.yaml b.yaml -o out/fused --report out",
        "judge a.log a.tum --report out",
        "run a.log -o out",
        "run a.log b.log -o out",
        "slam graph a.log -o out/graph --report out",
        "trajectory a.tum --truth b.tum --report out",
    ],
)
def test_without_matplotlib_what_draws_is_refused_before_any_file_is_read(
    words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """None in ``sys.modules`` is how Python says that a module is not there."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.delitem(sys.modules, "slamfusion.report", raising=False)
    assert run_program(words.split()) == 1
    assert capsys.readouterr().err == (
        "slamfusion: error: the report needs matplotlib; pip install 'slamfusion[report]'\n"
    )


def test_an_interrupt_while_matplotlib_loads_is_no_missing_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """pybind11, which its extensions are made with, makes an ImportError of all that they raise."""
    monkeypatch.syspath_prepend(tmp_path)
    for name in ("matplotlib", "slamfusion.report"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    words = ["trajectory", "a.tum", "--truth", "b.tum", "--report", str(tmp_path / "out")]
    source = tmp_path / "matplotlib.py"
    source.write_text("raise ImportError('it failed') from KeyboardInterrupt", encoding="utf-8")
    assert run_program(words) == 130
    assert capsys.readouterr().err == "slamfusion: interrupted\n"
    source.write_text("raise ImportError('wrong version')", encoding="utf-8")
    with pytest.raises(ImportError, match="wrong version"):
        run_program(words)


def test_maps_are_aligned_without_matplotlib(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [*sys.modules]:
        if name.split(".")[0] == "matplotlib" or name.startswith("slamfusion.report"):
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert run_program(["align", *MAPS[:2]]) == 0


def test_progress_is_drawn_on_a_terminal_only(monkeypatch: pytest.MonkeyPatch) -> None:
    for stream, drawn in ((Terminal(), True), (io.StringIO(), False)):
        monkeypatch.setattr("sys.stderr", stream)
        with progress_bar() as progress:
            progress("align", 1, 3)
            progress("align", 3, 3)
        assert bool(stream.getvalue()) == drawn


def test_progress_of_long_work_is_told_in_lines_where_nobody_watches(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stream, now = io.StringIO(), iter((0.0, 1.0, 11.0, 12.0, 22.0))
    monkeypatch.setattr("sys.stderr", stream)
    monkeypatch.setattr("slamfusion.cli.output.time.monotonic", lambda: next(now))
    with progress_bar() as progress:
        for done in range(1, 5):
            progress("graph", done, 4)
    assert stream.getvalue() == (
        "slamfusion: graph: 50 %, 10 s, about 10 s left\nslamfusion: graph: 100 %, 21 s\n"
    )


def test_a_path_may_begin_with_the_home_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/robot")
    assert FILE.convert("~/map.yaml", None, None) == Path("/home/robot/map.yaml")
    assert FILE.convert("a~b/~", None, None) == Path("a~b/~")
    assert FILE.convert("~nobody-at-all/x", None, None) == Path("~nobody-at-all/x")


def test_the_map_of_a_folder_is_the_fused_or_the_only_one(tmp_path: Path) -> None:
    sample = ROOT / "data" / "sample"
    with pytest.raises(MapFileError, match=r"map_a\.yaml, map_b\.yaml, .*; name a map in it"):
        load_maps([sample], RunConfig())
    for name in ("map_a.yaml", "map_a.pgm"):
        (tmp_path / name).write_bytes((sample / name).read_bytes())
    assert load_maps([tmp_path], RunConfig())[0].name == "map_a"
    fused = (tmp_path / "map_a.yaml").read_text(encoding="utf-8")
    (tmp_path / "fused.yaml").write_text(fused, encoding="utf-8")
    assert load_maps([tmp_path], RunConfig())[0].name == "fused"
