/* Upper bounds of a lattice score over blocks of motions (branch and bound).
 *
 * Twins: reference.polyphase, reference.bound_blocks; exact. The argument for the bound stands in
 * slamfusion/fusion/proof.py.
 */
#include "common.h"

/* Rearrange a field so that reads `step` cells apart lie side by side, reaching beyond its edges.
 * Plane (a, b) of step x step planes holds the cells (row0 + a + step i, col0 + b + step j).
 * field (height, width) uchar, fill outside; out (step, step, rows, cols) uchar.
 * Global: (rows, step * step). */
__kernel void polyphase(__global const uchar *field, const int height, const int width,
                        const int row0, const int col0, const int step, const int rows,
                        const int cols, const uchar fill, __global uchar *out) {
  const int i = get_global_id(0), phase = get_global_id(1);
  if (i >= rows || phase >= step * step) return;
  const int row = row0 + phase / step + step * i, first = col0 + phase % step;
  __global uchar *line = out + ((size_t)phase * rows + i) * cols;
  /* Columns [from, to) lie on the field; a row off the field has none. */
  int from = first >= 0 ? 0 : (-first + step - 1) / step;
  int to = width > first ? (width - first + step - 1) / step : 0;
  from = from < cols ? from : cols;
  to = to < cols ? to : cols;
  if (row < 0 || row >= height || to < from) from = to = cols;
  for (int j = 0; j < from; j++) line[j] = fill;
  __global const uchar *source = field + (row < 0 || row >= height ? 0 : (size_t)row * width);
  for (int j = from; j < to; j++) line[j] = source[first + j * step];
  for (int j = to; j < cols; j++) line[j] = fill;
}

/* Points between two looks at whether a block can still be of use. */
#define POINTS_BETWEEN 16

/* bounds[b] = sum over points of the pooled field of the point's class at start + shift; -1 where
 * that is not above `least`, which is seen before all points are read.
 * blocks (count, 3) int: yaw group, row and column of the block's first shift;
 * starts (groups, 2, points) int: rows, then columns of the points' windows for shift 0;
 * classes (points) uchar: which pooled field a point reads; fields (classes, height, width) uchar,
 * fill outside; bounds (count) int. Global: (count). */
__kernel void bound_blocks(__global const int *blocks, const int count,
                           __global const int *starts, __global const uchar *classes,
                           const int points, __global const uchar *fields, const int height,
                           const int width, const uchar fill, const int least,
                           __global int *bounds) {
  const int b = get_global_id(0);
  if (b >= count) return;
  const int row0 = blocks[3 * b + 1], col0 = blocks[3 * b + 2];
  __global const int *rows = starts + (size_t)blocks[3 * b] * 2 * points, *cols = rows + points;
  const size_t plane = (size_t)height * width;
  int sum = 0;
  for (int n = 0; n < points && sum + 255 * (points - n) > least;) {
    const int end = LOWER(n + POINTS_BETWEEN, points);
    for (; n < end; n++) {
      const int row = rows[n] + row0, col = cols[n] + col0;
      const int inside = ((uint)row < (uint)height) & ((uint)col < (uint)width);
      const int value = fields[classes[n] * plane + (inside ? row * width + col : 0)];
      sum += inside ? value : fill;
    }
  }
  bounds[b] = sum > least ? sum : -1;
}
