"""The picture of the nodes: who sends what to whom, as SVG."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape

from docs.generate.ros import node_arrows
from slamfusion.ros.interface import PRODUCERS, SERVICES

__all__ = ["node_picture"]

WIDTH, HEIGHT = 1080, 470
# Left, top, width, height of each box, in pixels.
BOXES = {
    "player": (20, 190, 150, 60),
    "producers": (290, 130, 170, 170),
    "fusion": (620, 170, 170, 90),
    "users": (900, 180, 160, 80),
    "other": (545, 30, 150, 34),
    "saved": (715, 30, 150, 34),
}
WORDS = {
    "player": ("player", "or the robot itself"),
    "producers": ("producers,", "each with its NAME", "", *PRODUCERS),
    "fusion": ("fusion", *(item.name for item in SERVICES)),
    "users": ("whoever listens:", "navigation, RViz,", "Foxglove"),
    "other": ("any other SLAM",),
    "saved": ("a saved map",),
}
LINE = 15
# Arrows that pass a box by: the height of their level part, above the boxes or below them.
AROUND = {("player", "fusion"): 345, ("player", "users"): 435, ("producers", "users"): 100}
STYLE = (
    "text{font:12px sans-serif;fill:#1b1b1b;text-anchor:middle}"
    ".box{fill:#eef3fa;stroke:#33557f;stroke-width:1.2}.line{fill:none;stroke:#33557f}"
    ".what{font-size:11px;fill:#33557f}"
)
HEAD = (
    '<marker id="head" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="8" markerHeight="8"'
    ' orient="auto"><path d="M0 0L8 4L0 8z" fill="#33557f"/></marker>'
)


def node_picture() -> str:
    """Return the picture: a box for each kind of node, an arrow for the topics between two."""
    size = f'viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}" height="{HEIGHT}"'
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" {size} role="img" aria-label="nodes and topics">',
        f"<style>{STYLE}</style><defs>{HEAD}</defs>",
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="#ffffff"/>',
    ]
    for name, (left, top, width, height) in BOXES.items():
        parts.append(
            f'<rect class="box" x="{left}" y="{top}" width="{width}" height="{height}" rx="6"/>'
        )
        parts.append(_text(left + width / 2, top + height / 2, WORDS[name]))
    arrows = {**node_arrows(), ("other", "fusion"): ["its map"], ("saved", "fusion"): ["file:PATH"]}
    parts += [_arrow(*pair, topics) for pair, topics in arrows.items()]
    return "\n".join([*parts, "</svg>", ""])


def _arrow(writer: str, reader: str, topics: list[str]) -> str:
    left, top, width, height = BOXES[writer]
    to_left, to_top, to_width, to_height = BOXES[reader]
    if level := AROUND.get((writer, reader)):
        is_below = level > top
        begin_x = left + width * (0.35 if (writer, reader) == ("player", "users") else 0.65)
        end_x = to_left + to_width / 2
        begin_y, end_y = (top + height, to_top + to_height) if is_below else (top, to_top)
        path = f"M{begin_x} {begin_y}V{level}H{end_x}V{end_y}"
        rows = [", ".join(topics)]
        middle = (begin_x + end_x) / 2 if is_below else begin_x + 130
        label = _text(middle, level - 9, rows, "what")
    elif writer in {"other", "saved"}:
        x = left + width / 2 + (40 if writer == "other" else -40)
        path = f"M{x} {top + height}V{to_top}"
        label = _text(x - 32, to_top - 30, topics, "what")
    else:
        y = top + height / 2
        path = f"M{left + width} {y}H{to_left}"
        middle = (left + width + to_left) / 2
        half = (len(topics) * LINE) / 2
        label = _text(middle, y - half - 4, topics, "what")
    return f'<path class="line" marker-end="url(#head)" d="{path}"/>{label}'


def _text(x: float, y: float, lines: Iterable[str], kind: str = "") -> str:
    """Return lines of text around a middle."""
    lines = list(lines)
    first = y - (len(lines) - 1) * LINE / 2 + 4
    named = f' class="{kind}"' if kind else ""
    return "".join(
        f'<text{named} x="{x:g}" y="{first + number * LINE:g}">{escape(line)}</text>'
        for number, line in enumerate(lines)
        if line
    )
