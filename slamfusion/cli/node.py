"""``slamfusion node``: the ROS 2 nodes."""

from __future__ import annotations

import importlib
import os
import sys
from pathlib import Path

import click

from slamfusion.cli.help import Command, unknown
from slamfusion.cli.slam import producer_summaries
from slamfusion.errors import SlamFusionError

# The nodes that are no producer's, and their modules, which have ``make_node(kind) -> NodeBase``.
NODES = {"fusion": "slamfusion.ros.fusion_node", "player": "slamfusion.ros.player_node"}
PRODUCER_NODE = "slamfusion.ros.producer_node"
# Set by the ROS wheels' start-up code when it has put their libraries on the path.
BOOTSTRAPPED = "_ROS_WHEELS_BOOTSTRAP_COMPLETE"
ABSENT = (
    "rclpy cannot be imported ({}); source a ROS 2 Jazzy, or without one "
    "pip install 'slamfusion[ros]'"
)


def _known(_: click.Context, __: click.Parameter, name: str) -> str:
    """Refuse the name of a node that there is none of."""
    from slamfusion.slam.registry import producer_names  # noqa: PLC0415  (loads slowly)

    names = (*producer_names(), *NODES)
    if name not in names:
        raise click.BadParameter(unknown(name, names))
    return name


class _Command(Command):
    """Lists the nodes in the help: the producers of the registry, then the others."""

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002
        """Write the names with a word on each; of a broken producer, what is wrong with it."""
        rows = producer_summaries()
        rows += [
            ("fusion", "fuses the maps of the others"),
            ("player", "publishes a log or bag"),
        ]
        with formatter.section("Nodes"):
            formatter.write_dl(rows)


@click.command(
    "node",
    cls=_Command,
    examples=["node graph", "node fusion --ros-args -p page:=true"],
    context_settings={"ignore_unknown_options": True, "allow_interspersed_args": False},
    options_metavar="",
)
@click.argument("name", callback=_known, metavar="NAME")
@click.argument("ros_arguments", nargs=-1, type=click.UNPROCESSED, metavar="[--ros-args ...]")
def command(name: str, ros_arguments: tuple[str, ...]) -> int:
    """Run a ROS 2 node.

    Parameters, names and remappings follow --ros-args as with `ros2 run`: -p rate:=2.0
    -r scan:=front/scan -r __ns:=/robot1 --params-file FILE.
    """
    if ros_arguments and "--ros-args" not in ros_arguments:
        message = f"{ros_arguments[0]!r}: a node's options stand after --ros-args"
        raise click.UsageError(message)
    import_rclpy()
    module = importlib.import_module(NODES.get(name, PRODUCER_NODE))
    base = importlib.import_module("slamfusion.ros.base")
    return int(base.run_node(lambda: module.make_node(name), ros_arguments))


def import_rclpy() -> None:
    """Import rclpy, or say how to get it.

    A sourced ROS brings its own environment, which is left alone. The wheels of the package index
    set the library path when Python starts, but not below a Python of another environment that has
    done so before; then this process starts once more.
    """
    try:
        importlib.import_module("rclpy")
    except ImportError as error:
        folder = str(Path(sys.prefix) / "lib")
        is_known = folder in os.environ.get("LD_LIBRARY_PATH", "").split(os.pathsep)
        if "ROS_DISTRO" not in os.environ and BOOTSTRAPPED in os.environ and not is_known:
            environment = {key: value for key, value in os.environ.items() if key != BOOTSTRAPPED}
            os.execve(sys.executable, sys.orig_argv, environment)  # noqa: S606  (itself again)
        raise SlamFusionError(ABSENT.format(error)) from error
