/* What each piece of wall of one map meets on the other under a rigid motion.
 *
 * Twin: slamfusion/compute/wall_pieces.py; exact.
 */
#include "common.h"

#define WORD_AT(two) words[(uint)(two)], words[(two) >> 32]

INLINE int all_lanes(const int8 lanes) {
  const int4 four = lanes.lo + lanes.hi;
  return four.x + four.y + four.z + four.w;
}

/* What a wall of the other map meets in each cell, in one word, one look-up for all: its worth as of
 * score_field, above 8 bits whether the cell is seen, above 16 the most that the worth less `base` could
 * be, above 24 what the cell faces. Seen are known cells and those within near2 of a wall; a known cell
 * could be worth `span`, another what it is.
 * distance2 (cells) ushort; grid (cells) char trinary; facing (cells) uchar; worths as of score_field;
 * words (cells) uint. Global: (ceil(cells / RUN)). All gathers of a run come first, see score_field. */
__kernel void piece_words(__global const ushort *distance2, __global const char *grid,
                          __global const uchar *facing, __global const ushort *worths, const int base,
                          const int span, const int near2, const int cells, __global uint *words) {
  const int first = get_global_id(0) * RUN, run = LOWER(RUN, cells - first);
  ushort worth[RUN];
  for (int i = 0; i < run; i++) worth[i] = worths[distance2[first + i]];
  for (int i = 0; i < run; i++) {
    const int at = first + i, is_known = grid[at] >= 0, is_free = grid[at] == FREE;
    const int sum = base + (uchar)worth[i] - is_free * (worth[i] >> 8);
    const uint value = sum < 0 ? 0 : LOWER(sum, FIELD_ONE);
    const uint seen = is_known | (distance2[at] <= near2);
    const uint could = (uchar)(is_known ? span : (int)value - base);
    words[at] = value | seen << 8 | could << 16 | (uint)facing[at] << 24;
  }
}

/* What the points of each piece meet under each pose: sums[0, p, piece] = the field less `base`,
 * sums[1, p, piece] the most it could be, sums[2, p, piece] points in seen cells. Points off the field
 * meet nothing, nor does, where `sided`, a wall that the field has and that was seen from another side.
 * points (3, stride) int: x and y, lattice positions, and what each point faces, a piece's one after
 * the other, and PIECE_LANES = 8 more, which are read and do not count; starts (pieces + 1) int, the
 * first point of each, and the count; poses (n, 4) long Q30, points to field, cos and sin less than 2;
 * turns (n) int, how far they turn, in parts; words (height, width) of piece_words;
 * sums (3, n, pieces) int. Global: (n, pieces). */
__kernel void piece_sums(__global const int *points, const int stride, __global const int *starts,
                         const int pieces, const int sided, __global const long *poses,
                         __global const int *turns, const int n, __global const uint *words,
                         const int height, const int width, const int base,
                         __global int *sums) {
  const int p = get_global_id(0), piece = get_global_id(1);
  if (piece >= pieces || p >= n) return;
  const int turn = turns[p];
  const int8 lane = (int8)(0, 1, 2, 3, 4, 5, 6, 7);
  const long8 cosine = (int)poses[4 * p], sine = (int)poses[4 * p + 1];
  const long8 tx = poses[4 * p + 2], ty = poses[4 * p + 3];
  int8 values = 0, most = 0, seen = 0;
  const int stop = starts[piece + 1];
  for (int i = starts[piece]; i < stop; i += PIECE_LANES) {
    const long8 x2 = CONVERT(long8, as_int8(LOAD32(points + i)));
    const long8 y2 = CONVERT(long8, as_int8(LOAD32(points + stride + i)));
    const int8 own = as_int8(LOAD32(points + 2 * stride + i));
    /* The sign is cut off, so it need not be kept. */
    const int8 col = CONVERT(int8, as_ulong8(cosine * x2 - sine * y2 + tx) >> FIXED_TO_CELL_SHIFT);
    const int8 row = CONVERT(int8, as_ulong8(sine * x2 + cosine * y2 + ty) >> FIXED_TO_CELL_SHIFT);
    const int8 on = (lane < stop - i) & (as_uint8(col) < (uint8)width) & (as_uint8(row) < (uint8)height);
    const ulong4 at = as_ulong4(on & (row * width + col));
    const int8 there = (int8)(WORD_AT(at.x), WORD_AT(at.y), WORD_AT(at.z), WORD_AT(at.w));
    const uint8 word = as_uint8(on ? there : (int8)base);
    const int8 value = as_int8(word << 24 >> 24) - base, other = as_int8(word >> 24);
    const int8 apart = (own + turn - other) & (FACING_PARTS - 1);
    const int8 is_another = (own != 0) & (other != 0) & (apart >= OPPOSED_PARTS) &
                            (apart <= FACING_PARTS - OPPOSED_PARTS);
    const int8 counts = ~(is_another & (value > 0) & -sided);
    values += value & counts;
    most += as_int8(word << 8 >> 24) & counts;
    seen += as_int8(word << 23 >> 31) & counts;
  }
  const int out = p * pieces + piece, step = n * pieces;
  sums[out] = all_lanes(values);
  sums[step + out] = all_lanes(most);
  sums[2 * step + out] = all_lanes(seen);
}
