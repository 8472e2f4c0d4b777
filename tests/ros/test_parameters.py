from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import pytest

pytest.importorskip("rclpy", reason="rclpy is absent: install the extra ros, or source a ROS")

import rclpy
from rclpy.context import Context
from rclpy.parameter import Parameter

from slamfusion.config import GmappingConfig, TinySlamConfig
from slamfusion.config.core import Checked, option
from slamfusion.errors import ConfigError
from slamfusion.ros.parameters import TypedNode, declare, declare_starts, missed_sections

pytestmark = pytest.mark.ros

MakeNode = Callable[..., Any]


@dataclass(frozen=True)
class Inner(Checked):
    beams: int = option(10, "beams", low=1, high=100)


@dataclass(frozen=True)
class Drawn(Checked):
    """A section of every kind of field."""

    inner: Inner = Inner()
    period_s: float = option(1.0, "how often", unit="s", low=0.1, high=10.0)
    mode: Literal["fast", "slow"] = option("fast", "how")
    name: str | None = option(None, "what it is called")
    share: float | None = option(None, "how much", low=0.0, level="expert")
    is_on: bool = option(True, "whether")


@pytest.fixture
def make_node(domain: int) -> Iterator[MakeNode]:
    """Makes nodes with parameters given on the command line."""
    context = Context()
    rclpy.init(context=context, domain_id=domain)
    nodes = []

    def make(**parameters: str) -> Any:
        words = ["--ros-args"]
        for name, value in parameters.items():
            words += ["-p", f"{name.replace('__', '.')}:={value}"]
        node = TypedNode(f"drawn{len(nodes)}", context=context, cli_args=words)
        nodes.append(node)
        return node

    yield make
    for node in nodes:
        node.destroy_node()
    rclpy.shutdown(context=context)


def test_without_a_word_the_defaults_hold(make_node: MakeNode):
    assert declare(make_node(), Drawn()) == Drawn()
    assert declare(make_node(), TinySlamConfig(), "tinyslam") == TinySlamConfig()
    assert declare(make_node(), GmappingConfig(), "gmapping") == GmappingConfig()


def test_the_command_line_sets_fields_of_every_kind(make_node: MakeNode):
    node = make_node(
        a__inner__beams="20", a__period_s="3", a__name="box", a__share="0.25", a__is_on="false"
    )
    found = declare(node, Drawn(), "a")
    assert found == Drawn(Inner(20), 3.0, "fast", "box", 0.25, is_on=False)
    assert isinstance(found.period_s, float)


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("period_s", "20.0", r"must lie in \[0\.1, 10\] s, found 20"),
        ("period_s", "20", r"must lie in \[0\.1, 10\] s, found 20"),
        ("period_s", "often", "wanted float, found 'often'"),
        ("inner__beams", "0", r"must lie in \[1, 100\], found 0"),
        ("inner__beams", "2.5", "wanted int, found 2.5"),
        ("mode", "medium", "must be one of fast, slow, found 'medium'"),
        ("is_on", "1", "wanted bool, found 1"),
    ],
)
def test_a_value_that_cannot_be_is_refused_by_node_and_name(
    make_node: MakeNode, name: str, value: str, words: str
):
    # The whole name, with the section it stands in.
    whole = rf"a\.{name.replace('__', '.')}"
    with pytest.raises(ConfigError, match=rf"^node drawn0: {whole}.*{words}"):
        declare(make_node(**{f"a__{name}": value}), Drawn(), "a")


@pytest.mark.parametrize(
    ("value", "wanted"),
    [
        ("[1.0,-2.5,0.3]", (1.0, -2.5, 0.3)),
        ("[1,2,0]", (1.0, 2.0, 0.0)),
        ("1,-2.5,0,1,0.2", (1.0, -2.5, 0.0, 1.0, 0.2)),
        ("[1.0,2.0,0.0,0.0,0.0]", (1.0, 2.0, 0.0, 0.0, 0.0)),
    ],
)
def test_a_start_is_an_array_or_a_text(make_node: MakeNode, value: str, wanted: tuple[float, ...]):
    node = make_node(start__hall=value)
    assert declare_starts(node, ("lab", "hall", "robot1/slam")) == {"hall": wanted}
    told = node.describe_parameter("start.robot1/slam")
    assert told.read_only
    assert "x,y,yaw or x,y,yaw,metres,radians;" in told.description
    assert declare_starts(make_node(), ("lab",)) == {}


def test_tools_are_told_what_a_parameter_is(make_node: MakeNode):
    node = make_node()
    declare(node, Drawn(), "a", changeable=("a.mode",))
    period = node.describe_parameter("a.period_s")
    assert period.description == "how often [s] (public)"
    (limits,) = period.floating_point_range
    assert (limits.from_value, limits.to_value) == (0.1, 10.0)
    assert period.read_only
    mode = node.describe_parameter("a.mode")
    assert mode.additional_constraints == "one of: fast, slow"
    assert not mode.read_only
    (beams,) = node.describe_parameter("a.inner.beams").integer_range
    assert (beams.from_value, beams.to_value) == (1, 100)
    assert "(expert)" in node.describe_parameter("a.share").description


def test_a_change_is_checked_and_told(make_node: MakeNode):
    node = make_node()
    told: list[Drawn] = []
    declare(node, Drawn(), changeable=("mode", "inner.beams", "share"), on_change=told.append)

    def change(name: str, value: Any) -> Any:
        sent = Parameter(name, value=value).to_parameter_msg()
        return node.set_parameters([Parameter.from_parameter_msg(sent)])[0]

    assert change("inner.beams", 55).successful
    assert change("share", 1).successful
    assert told == [Drawn(Inner(55)), Drawn(Inner(55), share=1.0)]
    refused = change("mode", "medium")
    assert not refused.successful
    assert "must be one of fast, slow, found 'medium'" in refused.reason
    for wrong in (5, [1, 2]):
        assert f"wanted fast or slow, found {wrong}" in change("mode", wrong).reason
    assert "period_s: it is read-only; start the node with it" in change("period_s", 2.0).reason
    assert "mod: unknown parameter; the nearest known one is 'mode'" in change("mod", "slow").reason
    assert len(told) == 2
    assert node.get_parameter("mode").value == "fast"


@pytest.mark.parametrize(
    ("sections", "missed"),
    [
        ("draw", "'/draw'"),
        ("/robot1/drawn0", "'/robot1/drawn0'"),
        ("robot1: {drawn0", "'/robot1/drawn0'"),
        ("amcl", ""),
        ("draw: {}\ndraw", ""),
        ("drawn0", ""),
        ("/**", ""),
        ("/**/drawn0", ""),
        ("draw: {ros__parameters: {a: 1}}\n'**'", ""),
    ],
)
def test_a_file_with_nearly_the_name_of_the_node_is_named(
    make_node: MakeNode, tmp_path: Path, sections: str, missed: str
):
    path = tmp_path / "params.yaml"
    end = "}" * sections.count("robot1: {")
    path.write_text(f"{sections}: {{ros__parameters: {{a: 1}}}}{end}\n", encoding="utf-8")
    sentences = missed_sections(make_node(), ["--ros-args", "--params-file", str(path)])
    wanted = (
        f"{path}: nothing of it is used: this node is '/drawn0', and the file has sections for "
        f"{missed}; rename one to '/drawn0' or '/**'"
    )
    assert sentences == [wanted] * bool(missed)
