/* Doubled walls: cells of a wall that has another one, parallel, close before or behind it.
 *
 * Method: drop specks; the structure tensor (Bigun and Granlund, ICCV 1987) gives each wall cell its
 * normal; a ray along it crosses its own wall and looks for the next one.
 * Twin: slamfusion/compute/doubled_walls/numpy.py, mark_doubled; exact, in whole numbers. Roots
 * begin with a float and end with whole numbers.
 * Layout: cells (height, width) uchar, both sides a multiple of NORMAL_BLOCK; a border of two blocks
 * or more, and wide enough for every ray, has no walls: no bounds are checked.
 */
#include "common.h"

#define BLUR_TAPS (2 * BLUR_RADIUS + 1)
#define WINDOW_TAPS (2 * WINDOW_RADIUS + 1)
/* Cells on a side of a block with all that its gradients depend on, and with these alone. */
#define AROUND (3 * NORMAL_BLOCK)
#define GRADIENTS (NORMAL_BLOCK + 2 * WINDOW_RADIUS)

/* Whether the NORMAL_BLOCK cells from here on are all 0. */
INLINE int no_wall(__global const uchar *cells) {
  uchar any = 0;
  for (int k = 0; k < NORMAL_BLOCK; k++) any |= cells[k];
  return any == 0;
}

/* Whether a wall cell is in a group of LEAST_GROUP cells or more: flood until there are so many. */
INLINE int is_in_group(__global const uchar *walls, const int width, const int cell) {
  int found[LEAST_GROUP];
  int count = 1;
  found[0] = cell;
  for (int n = 0; n < count; n++) {
    for (int k = 0; k < 9; k++) {
      const int next = found[n] + (k / 3 - 1) * width + k % 3 - 1;
      if (!walls[next]) continue;
      int is_known = 0;
      for (int m = 0; m < count; m++) is_known |= found[m] == next;
      if (is_known) continue;
      if (count + 1 == LEAST_GROUP) return 1;
      found[count++] = next;
    }
  }
  return 0;
}

/* Copy walls without groups of fewer than LEAST_GROUP connected cells (8 neighbours).
 * walls, kept (height, width) uchar, 0 or 1. Global: (width / NORMAL_BLOCK, height). */
__kernel void drop_specks(__global const uchar *walls, const int height, const int width,
                          __global uchar *kept) {
  const int first = get_global_id(0) * NORMAL_BLOCK, row = get_global_id(1);
  if (first >= width || row >= height) return;
  const int start = row * width + first;
  if (no_wall(walls + start)) {
    for (int k = 0; k < NORMAL_BLOCK; k++) kept[start + k] = 0;
    return;
  }
  for (int k = 0; k < NORMAL_BLOCK; k++)
    kept[start + k] = walls[start + k] && is_in_group(walls, width, start + k);
}

/* The whole part of a square root. */
INLINE long whole_root(const long value) {
  long root = (long)sqrt((float)value);
  while (root * root > value) root--;
  while ((root + 1) * (root + 1) <= value) root++;
  return root;
}

/* Unit normal of a structure tensor in 1/2^NORMAL_SHIFT, 0 where no direction prevails. */
INLINE short2 normal_of(const int jxx, const int jyy, const int jxy) {
  const long cosine = jxx - jyy, sine = 2 * (long)jxy, energy = jxx + jyy;
  const long squared = cosine * cosine + sine * sine;
  if (energy == 0 || COHERENCE_WHOLE * squared < COHERENCE_PART * energy * energy)
    return (short2)(0, 0);
  const long length = whole_root(squared);
  const long lean = cosine < 0 ? -cosine : cosine, slope = sine < 0 ? -sine : sine;
  const long greater = whole_root(((length + lean) << (2 * NORMAL_SHIFT - 1)) / length);
  const long least = (slope << (2 * NORMAL_SHIFT - 1)) / (length * greater);
  const long nx = cosine < 0 ? least : greater, ny = cosine < 0 ? greater : least;
  return (short2)((short)nx, (short)(sine < 0 ? -ny : ny));
}

/* Unit normals of the cells that are walls or touch one, of a block at a time.
 * kept (height, width) uchar; blur (BLUR_TAPS), window (WINDOW_TAPS) int, weights that add up to
 * 2^WEIGHT_SHIFT; normals (height, width) short2: x along columns and y along rows in
 * 1/2^NORMAL_SHIFT; not written at other cells, and in the outermost blocks.
 * Global: (width / NORMAL_BLOCK, height / NORMAL_BLOCK). */
__kernel void wall_normals(__global const uchar *kept, const int height, const int width,
                           __global const int *blur, __global const int *window,
                           __global short2 *normals) {
  const int left = get_global_id(0) * NORMAL_BLOCK, low = get_global_id(1) * NORMAL_BLOCK;
  if (left < NORMAL_BLOCK || low < NORMAL_BLOCK || left + 2 * NORMAL_BLOCK > width ||
      low + 2 * NORMAL_BLOCK > height)
    return;
  uchar any = 0;
  for (int r = -1; r <= NORMAL_BLOCK; r++)
    for (int c = -1; c <= NORMAL_BLOCK; c++) any |= kept[(low + r) * width + left + c];
  if (!any) return;

  int blurs[BLUR_TAPS], windows[WINDOW_TAPS];
  for (int k = 0; k < BLUR_TAPS; k++) blurs[k] = blur[k];
  for (int k = 0; k < WINDOW_TAPS; k++) windows[k] = window[k];

  /* Row r of the gradients is that of cells in row low - WINDOW_RADIUS + r, its first column left -
   * WINDOW_RADIUS. Of the smoothed walls three rows are needed at once. Rows far from walls are 0
   * and left out: `level` counts the rows in turn that have been smoothed to something. */
  int sums[3][GRADIENTS][NORMAL_BLOCK];
  uchar is_level[GRADIENTS];
  int smooth[3][AROUND];
  for (int k = 0; k < 3; k++)
    for (int c = 0; c < AROUND; c++) smooth[k][c] = 0;
  int level = 3;
  for (int r = -2; r < GRADIENTS; r++) {
    __global const uchar *line =
        kept + (low - WINDOW_RADIUS + r + 1 - BLUR_RADIUS) * width + left - NORMAL_BLOCK;
    int down[AROUND];
    int some = 0;
    IN_LANES
    for (int c = 0; c < AROUND; c++) {
      int sum = 0;
      _Pragma("unroll")
      for (int k = 0; k < BLUR_TAPS; k++) sum += blurs[k] * line[k * width + c];
      down[c] = sum;
      some |= sum;
    }
    level = some ? 0 : level + 1;
    if (r >= 0) is_level[r] = level > 2;
    int *above = smooth[(r + 3) % 3], *here = smooth[(r + 2) % 3], *below = smooth[(r + 1) % 3];
    if (some) {
      IN_LANES
      for (int c = 0; c < GRADIENTS + 2; c++) {
        int sum = 1 << (WEIGHT_SHIFT - 1);
        _Pragma("unroll")
        for (int k = 0; k < BLUR_TAPS; k++)
          sum += blurs[k] * down[c + k + NORMAL_BLOCK - WINDOW_RADIUS - 1 - BLUR_RADIUS];
        above[c] = sum >> WEIGHT_SHIFT;
      }
    } else {
      for (int c = 0; c < GRADIENTS + 2; c++) above[c] = 0;
    }
    if (r < 0 || level > 2) continue;
    int xx[AROUND], yy[AROUND], xy[AROUND];
    IN_LANES
    for (int c = 0; c < GRADIENTS; c++) {
      const int gx = below[c + 2] - below[c] + 2 * (here[c + 2] - here[c]) + above[c + 2] - above[c];
      const int gy = above[c] - below[c] + 2 * (above[c + 1] - below[c + 1]) + above[c + 2] -
                     below[c + 2];
      const int middle = 1 << (PRODUCT_SHIFT - 1);
      xx[c] = (gx * gx + middle) >> PRODUCT_SHIFT;
      yy[c] = (gy * gy + middle) >> PRODUCT_SHIFT;
      xy[c] = (gx * gy + middle) >> PRODUCT_SHIFT;
    }
    IN_LANES
    for (int c = 0; c < NORMAL_BLOCK; c++) {
      int sum_xx = 1 << (WEIGHT_SHIFT - 1), sum_yy = sum_xx, sum_xy = sum_xx;
      _Pragma("unroll")
      for (int k = 0; k < WINDOW_TAPS; k++) {
        sum_xx += windows[k] * xx[c + k];
        sum_yy += windows[k] * yy[c + k];
        sum_xy += windows[k] * xy[c + k];
      }
      sums[0][r][c] = sum_xx >> WEIGHT_SHIFT;
      sums[1][r][c] = sum_yy >> WEIGHT_SHIFT;
      sums[2][r][c] = sum_xy >> WEIGHT_SHIFT;
    }
  }

  for (int r = 0; r < NORMAL_BLOCK; r++) {
    __global const uchar *row = kept + (low + r) * width + left;
    uchar touched[NORMAL_BLOCK];
    int some = 0;
    IN_LANES
    for (int c = 0; c < NORMAL_BLOCK; c++) {
      touched[c] = row[c - width - 1] | row[c - width] | row[c - width + 1] | row[c - 1] | row[c] |
                   row[c + 1] | row[c + width - 1] | row[c + width] | row[c + width + 1];
      some |= touched[c];
    }
    if (!some) continue;
    int tensor[3][NORMAL_BLOCK];
    for (int n = 0; n < 3; n++) {
      int total[NORMAL_BLOCK];
      for (int c = 0; c < NORMAL_BLOCK; c++) total[c] = 1 << (TENSOR_SHIFT - 1);
      for (int k = 0; k < WINDOW_TAPS; k++) {
        if (is_level[r + k]) continue;
        const int weight = windows[k];
        IN_LANES
        for (int c = 0; c < NORMAL_BLOCK; c++) total[c] += weight * sums[n][r + k][c];
      }
      for (int c = 0; c < NORMAL_BLOCK; c++) tensor[n][c] = total[c] >> TENSOR_SHIFT;
    }
    for (int c = 0; c < NORMAL_BLOCK; c++)
      if (touched[c])
        normals[(low + r) * width + left + c] = normal_of(tensor[0][c], tensor[1][c], tensor[2][c]);
  }
}

/* Whether a ray from a wall cell, by (step_x, step_y) in 1/2^RAY_SHIFT cell each half cell, meets
 * another wall, parallel to its own. */
INLINE int meets_parallel(__global const uchar *kept, __global const short2 *normals,
                          const int width, const int cell, const int step_x, const int step_y,
                          const int total, const int own, const int other, const int gap,
                          const int thickness) {
  const int one = 1 << RAY_SHIFT;
  int own_end = 0;
  for (int n = 1; n <= total; n++) {
    const int x = n * step_x, y = n * step_y;
    __global const uchar *at = kept + cell + (y >> RAY_SHIFT) * width + (x >> RAY_SHIFT);
    const int count = at[0] + at[1] + at[width] + at[width + 1];
    int on_wall = count == 4;
    if (count && !on_wall) {
      const int u = x & (one - 1), v = y & (one - 1);
      const int lower = (one - u) * at[0] + u * at[1];
      const int upper = (one - u) * at[width] + u * at[width + 1];
      on_wall = (one - v) * lower + v * upper >= WALL_LEVEL;
    }
    if (on_wall && n - own_end <= own) {
      own_end = n;
    } else if (on_wall && n - own_end <= other) {
      /* Half a cell further the ray is inside the other wall. */
      const int middle = 1 << (RAY_SHIFT - 1);
      const int right = ((n + 1) * step_x + middle) >> RAY_SHIFT;
      const int up = ((n + 1) * step_y + middle) >> RAY_SHIFT;
      const short2 normal = normals[cell + up * width + right];
      const int product = normal.x * step_x + normal.y * step_y;
      return product >= PARALLEL || product <= -PARALLEL;
    }
    if (n - own_end > gap || own_end > thickness) break;
  }
  return 0;
}

/* Mark the cells asked about: 0 no wall, 1 a wall, 2 a wall that is doubled.
 * kept (height, width) uchar; normals likewise short2, see wall_normals; total to thickness: steps
 * of rays, see RaySteps; marks (height, width) uchar, not 0 where a cell is asked about.
 * Global: (width / NORMAL_BLOCK, height). */
__kernel void mark_doubled(__global const uchar *kept, __global const short2 *normals,
                           const int height, const int width, const int total, const int own,
                           const int other, const int gap, const int thickness,
                           __global uchar *marks) {
  const int first = get_global_id(0) * NORMAL_BLOCK, row = get_global_id(1);
  if (first >= width || row >= height) return;
  const int start = row * width + first;
  if (no_wall(marks + start)) return;
  for (int cell = start; cell < start + NORMAL_BLOCK; cell++) {
    if (!marks[cell]) continue;
    marks[cell] = kept[cell];
    if (!kept[cell]) continue;
    const short2 n = normals[cell];
    if (n.x == 0 && n.y == 0) continue;
    if (meets_parallel(kept, normals, width, cell, n.x, n.y, total, own, other, gap, thickness) ||
        meets_parallel(kept, normals, width, cell, -n.x, -n.y, total, own, other, gap, thickness))
      marks[cell] = 2;
  }
}
