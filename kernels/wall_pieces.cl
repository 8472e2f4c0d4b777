/* What each piece of wall of one map meets on the other under a rigid motion.
 *
 * Twin: slamfusion/compute/wall_pieces.py; exact.
 */
#include "common.h"

/* Whether two bytes say that walls were seen from opposite sides, the own one's turned by `turn`
 * parts. 0 says nothing. */
INLINE bool is_another(const int own, const int other, const int turn) {
  if (!own || !other) return false;
  const int apart = (own + turn - other) & (FACING_PARTS - 1);
  return apart >= OPPOSED_PARTS && apart <= FACING_PARTS - OPPOSED_PARTS;
}

/* What a wall of the other map meets in each cell, in one word, one look-up for all: the field's value,
 * above 8 bits whether the cell is seen, above 16 the most that the field less `base` could be, above
 * 24 what it faces. Seen are known cells and those within near2 of a wall; a known cell could be
 * worth `span`, another what it is.
 * field, facing (cells) uchar; distance2 (cells) ushort; grid (cells) char trinary; words (cells) uint.
 * Global: (ceil(cells / RUN)). */
__kernel void piece_words(__global const uchar *field, __global const ushort *distance2,
                          __global const char *grid, __global const uchar *facing, const int base,
                          const int span, const int near2, const int cells, __global uint *words) {
  const int first = get_global_id(0) * RUN;
  const int stop = first + RUN < cells ? first + RUN : cells;
  for (int i = first; i < stop; i++) {
    const uint value = field[i], known = grid[i] >= 0, seen = known | (distance2[i] <= near2);
    const uint could = (uchar)(known ? span : (int)value - base);
    words[i] = value | seen << 8 | could << 16 | (uint)facing[i] << 24;
  }
}

/* What the points of each piece meet under each pose: sums[0, p, piece] = the field less `base`,
 * sums[1, p, piece] the most it could be, sums[2, p, piece] points in seen cells. Points off the field
 * meet nothing, nor does, where `sided`, a wall that the field has and that was seen from another side.
 * points (count, 2) int lattice positions, a piece's one after the other; starts (pieces + 1) int, the
 * first point of each, and the count; sides (count) uchar, what each point faces; poses (n, 4) long
 * Q30, points to field; turns (n) int, how far they turn, in parts; words (height, width) of
 * piece_words; sums (3, n, pieces) int. Global: (n, pieces). */
__kernel void piece_sums(__global const int *points, __global const int *starts, const int pieces,
                         __global const uchar *sides, const int sided, __global const long *poses,
                         __global const int *turns, const int n, __global const uint *words,
                         const int height, const int width, const int base,
                         __global int *sums) {
  const int p = get_global_id(0), piece = get_global_id(1);
  if (piece >= pieces || p >= n) return;
  const int turn = turns[p];
  int values = 0, most = 0, seen = 0;
  const long4 pose = vload4(p, poses);
  const int stop = starts[piece + 1];
  for (int i = starts[piece]; i < stop; i++) {
    const int2 cell = fixed_cell(pose, points[2 * i], points[2 * i + 1]);
    const uint col = cell.x, row = cell.y;
    if (col >= (uint)width || row >= (uint)height) continue;
    const uint word = words[row * width + col];
    const int value = (int)(uchar)word - base;
    if (sided && value > 0 && is_another(sides[i], word >> 24, turn)) continue;
    values += value;
    most += (uchar)(word >> 16);
    seen += word >> 8 & 1;
  }
  const int out = p * pieces + piece, step = n * pieces;
  sums[out] = values;
  sums[step + out] = most;
  sums[2 * step + out] = seen;
}
