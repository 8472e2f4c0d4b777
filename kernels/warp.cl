/* Resample grids under rigid motions, and count how two trinary grids agree.
 *
 * Twins: reference.warp, reference.confusion. Integer arithmetic throughout: exact equality.
 */
#include "common.h"

/* Nearest-cell resampling: out[k, row, col] = in at the fixed pose k of the centre of the output
 * cell, fill outside. poses (count, 4) long Q30, output lattice to input lattice.
 * in (height, width) char; out (count, out_height, out_width) char.
 * A work item does RUN cells of a row: along it the position grows by a constant, two additions a
 * cell instead of four products. Global: (ceil(out_width / RUN), out_height, count). */
__kernel void warp(__global const char *in, const int height, const int width,
                   __global const long *poses, const int count, const int out_height,
                   const int out_width, const char fill, __global char *out) {
  const int first = get_global_id(0) * RUN, row = get_global_id(1), k = get_global_id(2);
  if (first >= out_width || row >= out_height || k >= count) return;
  const long4 pose = vload4(k, poses);
  const long x2 = 2 * first + 1, y2 = 2 * row + 1;
  long x = pose.x * x2 - pose.y * y2 + pose.z, y = pose.y * x2 + pose.x * y2 + pose.w;
  const long dx = 2 * pose.x, dy = 2 * pose.y;
  __global char *line = out + ((size_t)k * out_height + row) * out_width;
  const int stop = first + RUN < out_width ? first + RUN : out_width;
  for (int col = first; col < stop; col++) {
    const long c = x >> FIXED_TO_CELL_SHIFT, r = y >> FIXED_TO_CELL_SHIFT;
    const bool inside = c >= 0 && r >= 0 && c < width && r < height;
    line[col] = inside ? in[r * width + c] : fill;
    x += dx;
    y += dy;
  }
}

/* Joint counts of two trinary grids: partial[chunk, 3 (a + 1) + (b + 1)] over chunks of `chunk`
 * cells; the host adds the chunks. a, b (cells) char; partial (chunks, 9) int. Global: (chunks). */
__kernel void confusion(__global const char *a, __global const char *b, const int cells,
                        const int chunk, __global int *partial) {
  const int start = get_global_id(0) * chunk;
  if (start >= cells) return;
  int counts[9] = {0, 0, 0, 0, 0, 0, 0, 0, 0};
  for (int i = start; i < min(start + chunk, cells); i++) counts[3 * a[i] + b[i] + 4]++;
  for (int i = 0; i < 9; i++) partial[get_global_id(0) * 9 + i] = counts[i];
}

/* [F16] alignment error: partial[p, chunk] = sum of squared differences of the reference's cells and
 * the moving cells under pose p, over every stride-th row and column; off the moving grid counts as
 * unknown. a (height, width) char; b (b_height, b_width) char; poses (n, 4) long Q30, reference
 * lattice to moving lattice; partial (n, chunks) int, chunk strided rows a chunk.
 * Global: (chunks, n). */
__kernel void squared_error(__global const char *a, const int height, const int width,
                            __global const char *b, const int b_height, const int b_width,
                            __global const long *poses, const int n, const int stride,
                            const int chunk, const int chunks, __global int *partial) {
  const int c = get_global_id(0), p = get_global_id(1);
  if (c >= chunks || p >= n) return;
  const long4 pose = vload4(p, poses);
  int sum = 0;
  for (int k = c * chunk; k < (c + 1) * chunk; k++) {
    const int row = k * stride;
    if (row >= height) break;
    for (int col = 0; col < width; col += stride) {
      const int2 cell = fixed_cell(pose, 2 * col + 1, 2 * row + 1);
      const bool inside = cell.x >= 0 && cell.y >= 0 && cell.x < b_width && cell.y < b_height;
      const int other = inside ? b[(size_t)cell.y * b_width + cell.x] : UNKNOWN;
      const int difference = a[(size_t)row * width + col] - other;
      sum += difference * difference;
    }
  }
  partial[p * chunks + c] = sum;
}
