"""What kernels and host must agree on: constants and the layout of records, each written once.

The kernels get these numbers as ``-D`` options (``kernel_options``), the NumPy twins and the host
import them. A number that one kernel alone knows, without a twin, stays in that kernel.

Records that travel between host and kernels, by field:

====================  ==========================================================================
lattice position      x, y int32 in half cells: the centre of cell (row, col) is
                      (2 col + 1, 2 row + 1)
fixed pose            cos, sin, x, y int64 in Q30; x and y in half cells
ray                   x, y in cells, cos, sin, 1 / cos, 1 / sin, float32
ray hit               distance, class, cosine to the edge's normal, distance to the first wall
pose on tiles         x, y in cells of the window, cos, sin, float32
pose hypothesis       x, y, yaw, weights of the squares of these, own loss, float32
climb start           x, y in cells of the window, yaw, cos, sin, float32; a step likewise
climb size            cells, radians, cos and sin of them, float32
climb found           x, y, yaw, cos, sin, score less loss, float32
beam with a valley    x, y of the hit and of the laser, length, in 1/1024 cell; value of the ridge
beam                  x, y of the hit and of the laser in 1/1024 cell
block of motions      yaw group, row and column of the first shift, int32
observed word         a hit (1 bit), value (12 bits), in front of the hit (1 bit), uint32
likelihood word       value (8 bits) above 1 bit that says that there is one, uint32
cell mean             mean (20 bits) above observations (12 bits), uint32
hit count             hits (16 bits) above visits (16 bits), hits included, uint32
hit sum               sum of the hits' offsets in the cell in x (16 bits) above that in y, uint32
pair of a field       value of the cell above (8 bits) above the cell's own (8 bits), uint16
chunk mark            one bit for each of up to 32 chunks of a drive, uint32
====================  ==========================================================================
"""

from __future__ import annotations

from typing import Final

import numpy as np

# -- cells and the lattice -------------------------------------------------------------------------

# Trinary cells.
UNKNOWN: Final = -1
FREE: Final = 0
OCCUPIED: Final = 1
# One in the fixed point of poses, which is Q30.
FIXED_ONE: Final = 1 << 30
# From Q30 half cells to whole cells: drop the fraction's bits and the half.
FIXED_TO_CELL_SHIFT: Final = 31

# -- fields ----------------------------------------------------------------------------------------

# Farthest distance to a wall that a field keeps, in cells, and its square.
DISTANCE_MAX: Final = 64
DISTANCE2_MAX: Final = DISTANCE_MAX**2
# A cell in the unit of distance fields: they count in 1/256 cell.
DISTANCE_ONE: Final = 256
# In a field of distances: so far into the unknown that nothing is to be said.
DISTANCE_UNSEEN: Final = 65535
# Distance in 1/256 cell by squared distance in cells.
DISTANCE_TABLE: Final = np.rint(DISTANCE_ONE * np.sqrt(np.arange(DISTANCE2_MAX + 1))).astype(
    np.uint16
)
# The greatest value of a score field, and a free share of 1.
FIELD_ONE: Final = 255
# A wall cell with this many free cells among its eight neighbours is a speck, not a wall.
SPECK_FREE_CELLS: Final = 7
# Cells that one work item does, one after the other, where a cell is little work.
RUN: Final = 64
# Cells of a row that the distance passes do at once: 16 of 2 bytes fill a vector of 32 bytes.
DISTANCE_LANES: Final = 16
# Cells of a row that a window maximum does at once: 32 of a byte.
WINDOW_LANES: Final = 32

# -- search ----------------------------------------------------------------------------------------

# Shifts along a row that one work item of ``best_shifts`` does at once.
SHIFT_LANES: Final = 32
# Points that ``best_shifts`` adds in a byte: field values of at most 15.
SHIFT_POINTS: Final = 16
# Shifts a side of which ``best_shifts`` keeps the best.
SHIFT_TILE: Final = 4
# A motion and the eight that are shifted by a step along x, y or both.
NEIGHBOURS: Final = 9
# The most distances to which ``pose_counts`` counts.
LIMITS_MAX: Final = 5

# -- votes -----------------------------------------------------------------------------------------

# Grids that can vote: each is an argument of the kernel.
MOST_INPUTS: Final = 32
# Cells that the majority decides at once: four words of eight cells, a byte each. Planes of dissent
# are this many cells apart, or a multiple.
BLOCK_CELLS: Final = 32
# Spreads a byte over the eight lanes of a word.
EACH_LANE: Final = np.uint64(0x0101010101010101)
# Bits of what a map shows at a cell: a wall, free, a wall within the tolerance, the face of a wall;
# from WALL_SIDES on the four ways that walls face (``vote.walls``).
WALL_OCCUPIED: Final = 1
WALL_FREE: Final = 2
WALL_NEAR: Final = 4
WALL_FACE: Final = 8
WALL_SIDES: Final = 4
# Of these four: the two along a row, and the two along a column.
ALONG_ROW: Final = np.uint8(0b0011)
ALONG_COL: Final = np.uint8(0b1100)
# The greatest weight of a vote.
VOTE_ONE: Final = 255

# -- rays ------------------------------------------------------------------------------------------

# Classes of cells.
OPEN: Final = 0
WALL: Final = 1
GLASS: Final = 2
RAY_FLOATS: Final = 6
RAY_HIT_FLOATS: Final = 4

# -- tiles -----------------------------------------------------------------------------------------

# A tile is a square of 32 x 32 cells.
TILE_SHIFT: Final = 5
TILE: Final = 1 << TILE_SHIFT
TILE_MASK: Final = TILE - 1
TILE_CELLS: Final = TILE * TILE
# Pairs in a row of a field's tile: one for each cell, and the first of the tile behind it.
PAIRS: Final = TILE + 1
# Tiles are copied, and fetched, in words of this many bytes.
COPIED_BYTES: Final = 32
TAKEN_BYTES: Final = 8

# -- beams -----------------------------------------------------------------------------------------

# Positions and lengths of beams count in 1/1024 cell.
BEAM_SHIFT: Final = 10
BEAM_ONE: Final = 1 << BEAM_SHIFT
BEAM_MASK: Final = BEAM_ONE - 1
BEAM_HALF: Final = BEAM_ONE // 2
# A walk's positions and steps count in 1/2^20 cell; from there to 1/1024 cell.
WALK_SHIFT: Final = 20
WALK_TO_BEAM_SHIFT: Final = WALK_SHIFT - BEAM_SHIFT
# The place in a tile of a walk's position.
TILE_PLACE_MASK: Final = (TILE << WALK_SHIFT) - 1

# -- scan matching ---------------------------------------------------------------------------------

# Items of a work-group of one dimension: poses that a climber tries in a round, or shares of the
# points of a fit or of the beams of a map.
CLIMBERS: Final = 16
# Hits that a kernel may read together: their number on the device is rounded up to this.
HIT_LANES: Final = 16
# Between cell centres a field is interpolated in sixteenths; a value then has their square's bits.
SIXTEENTHS: Final = 16
SIXTEENTHS_SHIFT: Final = 8
# The first and the third byte of a word.
EVEN_BYTES: Final = 0x00FF00FF
HYPOTHESIS_FLOATS: Final = 7
START_FLOATS: Final = 5
SIZE_FLOATS: Final = 4
FOUND_FLOATS: Final = 6

# -- cell means ------------------------------------------------------------------------------------

# The last entry of a table by squared distance; it counts for all beyond.
TABLE_LAST: Final = 255
# A cell's state: mean in 1/2^20 above 12 bits of observations.
MEAN_SHIFT: Final = 12
MOST_OBSERVATIONS: Final = (1 << MEAN_SHIFT) - 1
MEAN_BITS: Final = 20
MEAN_HALF: Final = 1 << (MEAN_BITS - 1)
UNSEEN: Final = MEAN_HALF << MEAN_SHIFT
# Values that beams tell cells count in 1/4095; from there to a mean.
VALUE_ONE: Final = 4095
VALUE_TO_MEAN_SHIFT: Final = 8
# How much a scan is believed counts in 1/1024.
QUALITY_SHIFT: Final = 10
# A word of tinySLAM's observed pool: hit, value, in front of the hit; 0 is no word.
HIT_SHIFT: Final = 13
VALUE_SHIFT: Final = 1
# A word of the likelihood field's observed pool: value above the bit of there being one.
LIKELIHOOD_SHIFT: Final = 1
# One step of a likelihood (0 to 255) in a cell's mean.
LIKELIHOOD_ONE: Final = 4112
VALLEY_BEAM_INTS: Final = 6
BEAM_INTS: Final = 4

# -- hit counts ------------------------------------------------------------------------------------

HITS_SHIFT: Final = 16
VISITS_MASK: Final = 0xFFFF
SUM_SHIFT: Final = 16
SUM_MASK: Final = 0xFFFF
# Whoever counts must halve all counts when a cell has been visited, or hit, this often: a bit of
# the word each, so that no half of a word flows over.
FULL_VISITS: Final = 0x8000
FULL_HITS: Final = 2048
# Beams of a scan that is counted.
MOST_BEAMS: Final = FULL_HITS - 1
# The field looks at most this many cells around.
MOST_REACH: Final = 3
# Offsets of hits in their cell: from 1/1024 cell to sixteenths.
OFFSET_SHIFT: Final = 6
# Distances count in 1/256 cell.
CELL_ONE: Final = 256
CELL_HALF: Final = CELL_ONE // 2
# A sixteenth of a cell, and its middle, in 1/256 cell.
OFFSET_ONE: Final = 16
OFFSET_HALF: Final = 8
# Shares of visits count in 1/65536.
SHARE_ONE: Final = 1 << 16

# -- chunk marks -----------------------------------------------------------------------------------

# Directions that a hit surface faces, and of how many a hit is looked for: all but those that face
# away. The other face of a thin wall is no sign of this one.
FACINGS: Final = 8
FACINGS_ALIKE: Final = 5

# -- pieces of wall --------------------------------------------------------------------------------

# The byte of a cell from which free space lies on one side: this, and in which direction, in parts
# of a turn. 0: on none, or on several.
FACES: Final = 128
FACING_PARTS: Final = 128
# Points of a piece of wall that are looked up together.
PIECE_LANES: Final = 8
# Walls whose free sides lie this number of parts apart, or more, were seen from opposite sides:
# 112.5 degrees. At a corner, and where a wall is ragged, faces of one wall differ by up to a right
# angle.
OPPOSED_PARTS: Final = 40

# -- what the kernels get --------------------------------------------------------------------------

# By name, what stands in the kernels under the same name.
KERNEL_CONSTANTS: Final[dict[str, int]] = {
    name: int(value)
    for name, value in tuple(globals().items())
    if name.isupper() and not isinstance(value, np.ndarray)
}
INT_MAX: Final = 2**31 - 1


def kernel_options() -> tuple[str, ...]:
    """Return the constants as options of the kernels' compiler, ``-DNAME=value`` each.

    Those that an int does not hold are given as ulong.
    """
    return tuple(
        f"-D{name}={value}{'ul' if value > INT_MAX else ''}"
        for name, value in KERNEL_CONSTANTS.items()
    )
