"""All colours of pictures and pages: (red, green, blue), 0 to 255, sRGB.

Each name has one colour everywhere (``colours_of``). Colours that must be distinguished are
distinct also with deuteranopia and protanopia, as a test checks.
"""

from __future__ import annotations

import colorsys
import itertools
from collections.abc import Iterable, Iterator, Mapping

Rgb = tuple[int, int, int]

UNKNOWN_RGB: Rgb = (205, 209, 214)
FREE_RGB: Rgb = (255, 255, 255)
WALL_RGB: Rgb = (18, 22, 28)

# Of paths, maps' walls, and other things of these names.
NAMED: Mapping[str, Rgb] = {
    "tinyslam": (0, 105, 175),
    "gmapping": (240, 135, 0),
    "graph": (120, 20, 90),
    "fused": WALL_RGB,
    "odometry": (133, 127, 143),
    "truth": (40, 144, 88),
}
# Of other names, in order.
OTHERS: tuple[Rgb, ...] = ((68, 195, 230), (100, 80, 235), (191, 183, 102), (246, 158, 156))

# Contradictions: cells with divided votes or an outvoted map, closures that do not hold, revisits.
DISAGREEMENT_RGB: Rgb = (195, 0, 30)
# Walls in the background: of both maps in a difference, of the lower map.
AGREED_WALL_RGB: Rgb = (140, 147, 156)
# A map against the truth.
EXTRA_FREE_RGB: Rgb = (190, 222, 255)
MISSING_FREE_RGB: Rgb = (255, 226, 158)
EXTRA_WALL_RGB: Rgb = (28, 110, 225)
MISSING_WALL_RGB: Rgb = (226, 45, 45)
# The ends of a path.
START_RGB: Rgb = (47, 158, 68)
END_RGB: Rgb = (110, 0, 60)
# Lettering on white, and lines of no map.
INK_RGB: Rgb = (62, 68, 76)

# Hues a golden section of the circle apart never coincide.
_GOLDEN = 0.618034


def colours_of(names: Iterable[str]) -> dict[str, Rgb]:
    """Return a different colour for each name.

    Args:
        names: all that are shown together, in order; a name outside ``NAMED`` has the colour of its
            place among the others, so that names may be added at the end.
    """
    others = _others()
    return {name: NAMED[name] if name in NAMED else next(others) for name in dict.fromkeys(names)}


def _others() -> Iterator[Rgb]:
    """Yield ``OTHERS``, and then endless colours that are harder to distinguish."""
    yield from OTHERS
    for number in itertools.count(1):
        shades = colorsys.hls_to_rgb(number * _GOLDEN % 1.0, (0.35, 0.55, 0.7)[number % 3], 0.5)
        red, green, blue = (round(255 * shade) for shade in shades)
        yield red, green, blue
