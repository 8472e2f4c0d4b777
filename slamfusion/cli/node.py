"""``slamfusion node``: the ROS 2 nodes."""

from __future__ import annotations

import importlib
import os
import sys
from pathlib import Path

import click

from slamfusion.cli.help import Command, ProducerGroup
from slamfusion.errors import SlamFusionError
from slamfusion.io.files import use_one_arena

# The nodes that are no producer's: the class of ``slamfusion.ros.NAME_node``, and a summary.
NODES = {
    "fusion": ("FusionNode", "fuses the maps of the others"),
    "player": ("PlayerNode", "publishes a log or bag"),
}
# Set by the ROS wheels' start-up code when it has put their libraries on the path.
BOOTSTRAPPED = "_ROS_WHEELS_BOOTSTRAP_COMPLETE"
ABSENT = (
    "rclpy cannot be imported ({}); source a ROS 2 Jazzy, or without one "
    "pip install 'slamfusion[ros]'"
)


class _Node(Command):
    """Lists topics, services and parameters in the help."""

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002
        """Write the interface of the node."""
        name = self.name or ""
        ros = importlib.import_module("slamfusion.ros.interface")
        kind = name if name in NODES else "producers"
        topics = [item for item in ros.TOPICS if item.needs_tf2 is not False]
        sections = {
            "Publishes": [item for item in topics if kind in item.writers],
            "Subscribes": [item for item in topics if kind in item.readers],
            "Services": [item for item in ros.SERVICES if kind == item.node],
        }
        for title, items in sections.items():
            rows = [(item.name, f"{item.type}: {item.text}") for item in items]
            if name not in NODES:
                rows = [
                    (own.replace("NAME", name), text.replace("NAME", name)) for own, text in rows
                ]
            if rows:
                with formatter.section(title):
                    formatter.write_dl(rows)
        rows = [(item.name, item.text) for item in ros.NAME_LISTS.get(name, ())]
        for option in ros.node_parameters(name):
            if option.info.level == "public":
                default = option.shown_default()
                text = f"{option.info.help} [default: {default}]" if default else option.info.help
                rows.append((option.key, text))
        with formatter.section("Parameters"):
            formatter.write_dl(rows, col_max=26)


def _make_command(name: str) -> click.Command:
    @click.command(
        name,
        cls=_Node,
        examples=[f"node {name} --ros-args -p use_sim_time:=true"],
        context_settings={"ignore_unknown_options": True, "allow_interspersed_args": False},
        options_metavar="",
    )
    @click.argument("ros_arguments", nargs=-1, type=click.UNPROCESSED, metavar="[--ros-args ...]")
    def run(ros_arguments: tuple[str, ...]) -> int:
        if ros_arguments and "--ros-args" not in ros_arguments:
            raise click.UsageError(f"{ros_arguments[0]!r}: a node's options stand after --ros-args")
        use_one_arena()  # before there are threads
        import_rclpy()
        module = importlib.import_module(
            f"slamfusion.ros.{name if name in NODES else 'producer'}_node"
        )
        node = getattr(module, NODES[name][0] if name in NODES else "ProducerNode")
        base = importlib.import_module("slamfusion.ros.base")
        return int(base.run_node(lambda: node(name), ros_arguments))

    run.help = f"Run the ROS 2 node {name}."
    return run


@click.group(
    "node",
    cls=ProducerGroup,
    make=_make_command,
    others={name: text for name, (_, text) in NODES.items()},
    examples=["node graph", "node fusion --ros-args -p page:=true"],
    subcommand_metavar="NAME [--ros-args ...]",
)
def command() -> None:
    """Run a ROS 2 node.

    Parameters, names and remappings follow --ros-args as with `ros2 run`: -p rate:=2.0
    -r scan:=front/scan -r __ns:=/robot1 --params-file FILE. `node NAME --help` lists the topics and
    parameters of a node.
    """


def import_rclpy() -> None:
    """Import rclpy, or say how to get it.

    A sourced ROS is left as it is. The wheels of the package index set the library path when Python
    starts, but not in a child of another environment's Python; then this process restarts.
    """
    # Messages import the generator of their packages: a parser and templates, 6 MB.
    sys.modules.setdefault("rosidl_generator_py.generate_py_impl", None)  # type: ignore[arg-type]
    try:
        importlib.import_module("rclpy")
    except ImportError as error:
        folder = str(Path(sys.prefix) / "lib")
        is_known = folder in os.environ.get("LD_LIBRARY_PATH", "").split(os.pathsep)
        if "ROS_DISTRO" not in os.environ and BOOTSTRAPPED in os.environ and not is_known:
            environment = {key: value for key, value in os.environ.items() if key != BOOTSTRAPPED}
            os.execve(sys.executable, sys.orig_argv, environment)  # noqa: S606  (itself again)
        raise SlamFusionError(ABSENT.format(error)) from error
