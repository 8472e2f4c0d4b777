/* What each piece of wall of one map meets on the other under a rigid motion.
 *
 * Twin: slamfusion/compute/wall_pieces/numpy.py; exact.
 */
#include "common.h"

/* What the points of each piece meet under each pose: sums[p, piece] = (the field less `base`, points
 * in seen cells); points off the field meet nothing.
 * points (count, 2) int lattice positions, a piece's one after the other; starts (pieces + 1) int, the
 * first point of each, and the count; poses (n, 4) long Q30, points to field; field, seen (height,
 * width) uchar, seen 0 or 1; sums (n, pieces, 2) int. Global: (pieces, n). */
__kernel void piece_sums(__global const int *points, __global const int *starts, const int pieces,
                         __global const long *poses, const int n, __global const uchar *field,
                         __global const uchar *seen, const int height, const int width,
                         const int base, __global int *sums) {
  const int piece = get_global_id(0), p = get_global_id(1);
  if (piece >= pieces || p >= n) return;
  const long4 pose = vload4(p, poses);
  int2 sum = 0;
  for (int i = starts[piece]; i < starts[piece + 1]; i++) {
    const int2 cell = fixed_cell(pose, points[2 * i], points[2 * i + 1]);
    if (cell.x < 0 || cell.y < 0 || cell.x >= width || cell.y >= height) continue;
    const size_t at = (size_t)cell.y * width + cell.x;
    sum += (int2)(field[at] - base, seen[at]);
  }
  vstore2(sum, p * pieces + piece, sums);
}
