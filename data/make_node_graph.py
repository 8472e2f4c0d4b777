"""Draw the ROS nodes and the topics between them: ``python data/make_node_graph.py``.

Writes ``data/nodes.svg``. The names are those of ``slamfusion.cli.ros_tables``; only where things
stand is said here.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import escape

from slamfusion.cli.ros_tables import PRODUCERS, SERVICES, TOPICS

PICTURE = Path(__file__).with_name("nodes.svg")
WIDTH, HEIGHT = 1000, 490
STYLE = """
  text { font: 14px system-ui, sans-serif; fill: #1a1a1a; }
  .small { font-size: 12px; fill: #444; }
  .node { fill: #e3edf7; stroke: #33658a; stroke-width: 1.5; }
  .other { fill: #f6f6f6; stroke: #888; stroke-width: 1.5; stroke-dasharray: 5 3; }
  .edge { fill: none; stroke: #555; stroke-width: 1.5; marker-end: url(#tip); }
  .paper { fill: #ffffff; }
"""


@dataclass(frozen=True)
class Box:
    """A node: centre and size in pixels."""

    x: float
    y: float
    title: str
    below: str = ""
    kind: str = "node"
    width: float = 150
    height: float = 54

    @property
    def left(self) -> tuple[float, float]:
        """Middle of the left side."""
        return self.x - self.width / 2, self.y

    @property
    def right(self) -> tuple[float, float]:
        """Middle of the right side."""
        return self.x + self.width / 2, self.y


def topic(name: str) -> str:
    """Return a topic's name after a look that it exists."""
    if name not in {item.name for item in TOPICS}:
        message = f"no topic {name!r} in slamfusion.cli.ros_tables"
        raise ValueError(message)
    return name


def main(path: Path = PICTURE) -> None:
    """Write the picture."""
    rows = {name: 70 + 95 * index for index, name in enumerate(PRODUCERS)}
    middle = rows[PRODUCERS[1]]
    source = Box(95, middle, "robot", "or player: a log or bag", kind="other")
    producers = {name: Box(385, rows[name], name) for name in PRODUCERS}
    foreign = Box(385, 70 + 95 * 3, "any other SLAM", "slam_toolbox, ...", kind="other")
    saved = Box(385, 70 + 95 * 4, "a saved map", "file:map.yaml", kind="other")
    services = ", ".join(item.name for item in SERVICES)
    fusion = Box(690, middle, "fusion", services, width=180, height=64)
    users = Box(915, middle, "navigation,", "RViz, Foxglove", kind="other", width=130)
    shapes = [f'<rect class="paper" width="{WIDTH}" height="{HEIGHT}"/>']

    for name, box in producers.items():
        shapes.append(edge(source.right, box.left))
        shapes.append(edge(box.right, fusion.left))
        # On the side that the arrow bends away from.
        below = 18 if box.y > fusion.y else -8
        label = topic("NAME/map").replace("NAME", name)
        shapes.append(text(box.right[0] + 50, box.y + below, label, "small"))
    shapes += [
        text(195, middle - 80, f"{topic('scan')}, {topic('odom')}", "small"),
        text(195, middle - 64, f"{topic('/tf')}, {topic('/clock')}", "small"),
        edge(foreign.right, fusion.left),
        text(foreign.right[0] + 50, foreign.y + 18, "its map", "small"),
        edge(saved.right, fusion.left),
        edge(fusion.right, users.left),
    ]
    written = [item.name for item in TOPICS if item.writers == ("fusion",)]
    written += [f"{topic('/tf')}: fused_map to NAME_map", "and, if asked for, to odom"]
    shapes += [text(800, middle + 62 + 18 * row, name, "small") for row, name in enumerate(written)]
    shapes.append(text(800, 70, f"every node: {topic('/diagnostics')}", "small"))
    shapes += [box_shape(box) for box in (source, *producers.values(), foreign, saved)]
    shapes += [box_shape(fusion), box_shape(users)]

    body = "\n".join(shapes)
    path.write_text(
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" '
        f'width="{WIDTH}" height="{HEIGHT}" role="img" aria-label="The ROS nodes of SLAMfusion">\n'
        f"<style>{STYLE}</style>\n"
        '<defs><marker id="tip" viewBox="0 0 8 8" refX="8" refY="4" markerWidth="8" '
        'markerHeight="8" orient="auto"><path d="M0,0 L8,4 L0,8 z" fill="#555"/></marker></defs>\n'
        f"{body}\n</svg>\n",
        encoding="utf-8",
    )


def box_shape(box: Box) -> str:
    """Return a box with its words."""
    x, y = box.x - box.width / 2, box.y - box.height / 2
    shape = (
        f'<rect class="{box.kind}" x="{x:g}" y="{y:g}" width="{box.width:g}" '
        f'height="{box.height:g}" rx="8"/>'
    )
    title_y = box.y - 4 if box.below else box.y + 5
    words = [text(box.x, title_y, box.title)]
    if box.below:
        words.append(text(box.x, box.y + 14, box.below, "small"))
    return "\n".join([shape, *words])


def text(x: float, y: float, words: str, kind: str = "") -> str:
    """Return centred words."""
    is_of = f' class="{kind}"' if kind else ""
    return f'<text{is_of} x="{x:g}" y="{y:g}" text-anchor="middle">{escape(words)}</text>'


def edge(start: tuple[float, float], end: tuple[float, float]) -> str:
    """Return an arrow from left to right."""
    (x0, y0), (x1, y1) = start, end
    x = (x0 + x1) / 2
    return f'<path class="edge" d="M{x0:g},{y0:g} C{x:g},{y0:g} {x:g},{y1:g} {x1:g},{y1:g}"/>'


if __name__ == "__main__":
    main()
