"""Colours of maps, paths and inputs, on pages and pictures: (red, green, blue), 0 to 255, sRGB.

Those that must be told apart are, also with deuteranopia and protanopia; a test computes it.
"""

from __future__ import annotations

__all__ = ["DISAGREEMENT_RGB", "FREE_RGB", "INPUT_COLOURS", "UNKNOWN_RGB", "WALL_RGB", "Rgb"]

Rgb = tuple[int, int, int]

UNKNOWN_RGB: Rgb = (205, 209, 214)
FREE_RGB: Rgb = (255, 255, 255)
WALL_RGB: Rgb = (18, 22, 28)

# One for each input, of a path or of the walls of a map.
INPUT_COLOURS: tuple[Rgb, ...] = ((0, 105, 175), (240, 135, 0), (120, 20, 90), (70, 170, 120))

# Cells of the fused map on which the votes were divided, shown over maps of all these colours.
DISAGREEMENT_RGB: Rgb = (195, 0, 30)
