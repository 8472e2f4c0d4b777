"""``slamfusion live``: speaks to a running fusion node, from pip alone."""

from __future__ import annotations

import contextlib
import importlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from slamfusion.cli import options
from slamfusion.cli.help import Choice, Group, Number
from slamfusion.cli.node import import_rclpy
from slamfusion.cli.output import Table, one_line, print_if_json, settings
from slamfusion.cli.paths import stem_of
from slamfusion.errors import SlamFusionError

if TYPE_CHECKING:
    from slamfusion.jobs.records import LiveAnswerDocument, LiveStatusDocument

# Of an input's figures, those that the table has.
SHOWN = ("score", "overlap", "age [s]", "rate [Hz]")


@click.group("live", cls=Group)
def command() -> None:
    """Query and control a running fusion node."""


def _node_options(function: Callable[..., None]) -> Callable[..., None]:
    """Give a command ``--node`` and ``--timeout``; it gets the ``LiveClient``."""
    node = click.option(
        "--node",
        default="fusion",
        metavar="NAME",
        help="Name of the fusion node, with its namespace: robot1/fusion. [default: fusion]",
    )
    timeout = click.option(
        "--timeout",
        "timeout_s",
        type=Number(float, 0.1, 3600.0),
        default=10.0,
        metavar="S",
        help="Time to wait for the node. [default: 10 s]",
    )

    def wrapper(node: str, timeout_s: float, **given: Any) -> None:
        import_rclpy()
        # By its name: rclpy is an extra.
        ros = importlib.import_module("slamfusion.ros.live_client")
        with ros.LiveClient(node, timeout_s) as client:
            function(client, **given)

    wrapper.__doc__ = function.__doc__
    return node(timeout(options.common(wrapper)))


@command.command("status")
@_node_options
def status_command(client: Any) -> None:
    """Show which inputs vote, and why others do not."""
    found: LiveStatusDocument = client.status()
    if print_if_json(found):
        return
    inputs = found["inputs"]
    rows = [
        [
            line["name"],
            "yes" if line["figures"].get("accepted") == "yes" else "NO",
            *(line["figures"].get(key, "-") for key in SHOWN),
        ]
        for line in inputs
    ]
    Table(
        ("input ", "votes ", *SHOWN),
        rows,
        notes=[line["message"] for line in inputs],
        title=f"{found['node']}: {found['fusion']['message']}",
    ).print()
    figures = found["fusion"]["figures"]
    print(", ".join(f"{key} {figures[key]}" for key in ("maps published", "map [cells]")))


@command.command("watch")
@_node_options
def watch_command(client: Any) -> None:
    """Print each change of a vote or warning until Ctrl-C; with --json one line each."""
    printed: dict[str, tuple[str, str]] = {}
    with contextlib.suppress(KeyboardInterrupt):
        while True:
            found = client.status()
            for line in (found["fusion"], *found["inputs"]):
                # Figures within the words change all the time.
                now = line["level"], "".join(c for c in line["message"] if not c.isdigit())
                if printed.get(line["name"]) != now:
                    printed[line["name"]] = now
                    mark = "" if line["level"] == "ok" else f"{line['level'].upper()} "
                    words = one_line(f"{line['name']}: {mark}{line['message']}")
                    print(json.dumps(line) if settings().as_json else words, flush=True)


@command.command("save")
@click.option(
    "--path", metavar="PATH", help="File name without an ending. [default: the node's save_path]"
)
@click.option("--format", "image_format", type=Choice(["pgm", "png", "bmp"]), help="Image format.")
@click.option("--mode", type=Choice(["trinary", "scale", "raw"]), help="Map value mode.")
@_node_options
def save_command(client: Any, path: str | None, image_format: str | None, mode: str | None) -> None:
    """Save the fused map to the node's save_path, or to --path in its folder."""
    stem = path if not path or path.endswith("/") else str(stem_of(Path(path)))
    rules = {"path": stem, "format": image_format, "mode": mode}
    given = {name: value for name, value in rules.items() if value is not None}
    _tell(client.save_as(**given) if given else client.call("save_map"))


@command.command("reset")
@_node_options
def reset_command(client: Any) -> None:
    """Start a new fused frame with the newest maps."""
    _tell(client.call("reset"))


@command.command("add")
@click.argument("name", metavar="NAME")
@click.option(
    "--topic",
    metavar="TOPIC",
    help="Topic of its maps, or file:PATH of a map on the node's machine. [default: NAME/map]",
)
@_node_options
def add_command(client: Any, name: str, topic: str | None) -> None:
    """Add the maps of another SLAM, which votes once they fit."""
    _tell(client.add(name, topic))


@command.command("remove")
@click.argument("name", metavar="NAME")
@_node_options
def remove_command(client: Any, name: str) -> None:
    """Remove an input and its vote."""
    _tell(client.remove(name))


# A value may be negative.
@command.command("set", context_settings={"ignore_unknown_options": True})
@click.argument("parameter", metavar="PARAMETER")
@click.argument("value", metavar="VALUE")
@_node_options
def set_command(client: Any, parameter: str, value: str) -> None:
    """Set a parameter of the running node, such as max_publish_rate_hz."""
    _tell(client.set(parameter, value))


def _tell(answer: LiveAnswerDocument) -> None:
    """Print an answer; a refusal is an error."""
    is_json = print_if_json(answer)
    if not answer["success"]:
        raise SlamFusionError(answer["message"])
    if not is_json:
        print(answer["message"])
