/* What each piece of wall of one map meets on the other under a rigid motion.
 *
 * Twin: slamfusion/compute/wall_pieces.py; exact.
 */
#include "common.h"

/* Whether two bytes say that walls were seen from opposite sides, the own one's turned by `turn`
 * parts. 0 says nothing. */
inline bool is_another(const int own, const int other, const int turn) {
  if (!own || !other) return false;
  const int apart = (own + turn - other) & (FACING_PARTS - 1);
  return apart >= OPPOSED_PARTS && apart <= FACING_PARTS - OPPOSED_PARTS;
}

/* What the points of each piece meet under each pose: sums[p, piece] = (the field less `base`, the
 * most it could be, points in seen cells). Points off the field meet nothing, nor does a wall that
 * the field speaks for and that was seen from another side.
 * points (count, 2) int lattice positions, a piece's one after the other; starts (pieces + 1) int, the
 * first point of each, and the count; sides (count) uchar, what each point faces; poses (n, 4) long
 * Q30, points to field; turns (n) int, how far they turn, in parts; field, most, seen, facing
 * (height, width) uchar, seen 0 or 1; sums (n, pieces, 3) int. Global: (pieces, n). */
__kernel void piece_sums(__global const int *points, __global const int *starts, const int pieces,
                         __global const uchar *sides, __global const long *poses,
                         __global const int *turns, const int n, __global const uchar *field,
                         __global const uchar *most, __global const uchar *seen,
                         __global const uchar *facing,
                         const int height, const int width, const int base,
                         __global int *sums) {
  const int piece = get_global_id(0), p = get_global_id(1);
  if (piece >= pieces || p >= n) return;
  const long4 pose = vload4(p, poses);
  int3 sum = 0;
  for (int i = starts[piece]; i < starts[piece + 1]; i++) {
    const int2 cell = fixed_cell(pose, points[2 * i], points[2 * i + 1]);
    if (cell.x < 0 || cell.y < 0 || cell.x >= width || cell.y >= height) continue;
    const size_t at = (size_t)cell.y * width + cell.x;
    const int value = field[at] - base;
    if (value > 0 && is_another(sides[i], facing[at], turns[p])) continue;
    sum += (int3)(value, most[at], seen[at]);
  }
  vstore3(sum, p * pieces + piece, sums);
}
