/* Doubled walls: cells of a wall that has another one, parallel, close before or behind it.
 *
 * Method: drop specks; the structure tensor (Bigun and Granlund, ICCV 1987) gives each wall cell its
 * normal; a ray along it crosses its own wall and looks for the next one.
 * Twin: slamfusion/compute/doubled_walls.py, mark_doubled; exact, in whole numbers. Roots
 * begin with a float and end with whole numbers.
 * Layout: cells (height, width) uchar, both sides a multiple of NORMAL_BLOCK; a border of two blocks
 * or more, and wide enough for every ray, has no walls: no bounds are checked.
 */
#include "common.h"

#define BLUR_TAPS (2 * BLUR_RADIUS + 1)
#define WINDOW_TAPS (2 * WINDOW_RADIUS + 1)
/* Cells along a block with all that its gradients depend on, in vectors of a block's width; and with
 * the gradients alone. */
#define VECTORS 3
#define AROUND (VECTORS * NORMAL_BLOCK)
#define GRADIENTS (NORMAL_BLOCK + 2 * WINDOW_RADIUS)
/* The first cell of a row around a block that the first smoothed one depends on. */
#define BLUR_FIRST (NORMAL_BLOCK - WINDOW_RADIUS - 1 - BLUR_RADIUS)

/* NORMAL_BLOCK numbers, sixteen, from any one on in an array of vectors. */
typedef struct __attribute__((packed, aligned(4))) {
  int16 lanes;
} loose;
#define LANES(vectors, from) (((const loose *)((const int *)(vectors) + (from)))->lanes)

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

  /* Row r of the gradients is that of cells in row low - WINDOW_RADIUS + r, its first column left -
   * WINDOW_RADIUS. Those of columns beyond GRADIENTS are of no use. Rows far from walls are 0 and left
   * out: `level` counts the rows in turn that are smoothed to nothing. */
  int16 smooth[GRADIENTS + 2][VECTORS + 1], down[VECTORS + 1], sums[3][GRADIENTS];
  uchar is_level[GRADIENTS];
  const int rounding = 1 << (WEIGHT_SHIFT - 1);
  down[VECTORS] = 0;
  int level = 3;
  for (int r = -2; r < GRADIENTS; r++) {
    __global const uchar *line =
        kept + (low - WINDOW_RADIUS + r + 1 - BLUR_RADIUS) * width + left - NORMAL_BLOCK;
    int some = 0;
    IN_LANES
    for (int c = 0; c < AROUND; c++) {
      int sum = 0;
      _Pragma("unroll")
      for (int k = 0; k < BLUR_TAPS; k++) sum += blur[k] * line[k * width + c];
      ((int *)down)[c] = sum;
      some |= sum;
    }
    level = some ? 0 : level + 1;
    if (r >= 0) is_level[r] = level > 2;
    smooth[r + 2][VECTORS] = 0;
    for (int v = 0; v < VECTORS; v++) {
      int16 sum = rounding;
      if (some)
        for (int k = 0; k < BLUR_TAPS; k++)
          sum += blur[k] * LANES(down, v * NORMAL_BLOCK + k + BLUR_FIRST);
      smooth[r + 2][v] = sum >> WEIGHT_SHIFT;
    }
    if (r < 0 || level > 2) continue;
    int16 xx[VECTORS], yy[VECTORS], xy[VECTORS];
    for (int v = 0; v < VECTORS; v++) {
      const int c = v * NORMAL_BLOCK, middle = 1 << (PRODUCT_SHIFT - 1);
      const int16 a = smooth[r][v], b = LANES(smooth[r], c + 1), d = LANES(smooth[r], c + 2);
      const int16 e = smooth[r + 1][v], f = LANES(smooth[r + 1], c + 2);
      const int16 g = smooth[r + 2][v], h = LANES(smooth[r + 2], c + 1);
      const int16 i = LANES(smooth[r + 2], c + 2);
      const int16 gx = d - a + 2 * (f - e) + i - g;
      const int16 gy = g - a + 2 * (h - b) + i - d;
      xx[v] = (gx * gx + middle) >> PRODUCT_SHIFT;
      yy[v] = (gy * gy + middle) >> PRODUCT_SHIFT;
      xy[v] = (gx * gy + middle) >> PRODUCT_SHIFT;
    }
    int16 sum_xx = rounding, sum_yy = rounding, sum_xy = rounding;
    for (int k = 0; k < WINDOW_TAPS; k++) {
      sum_xx += window[k] * LANES(xx, k);
      sum_yy += window[k] * LANES(yy, k);
      sum_xy += window[k] * LANES(xy, k);
    }
    sums[0][r] = sum_xx >> WEIGHT_SHIFT;
    sums[1][r] = sum_yy >> WEIGHT_SHIFT;
    sums[2][r] = sum_xy >> WEIGHT_SHIFT;
  }

  for (int r = 0; r < NORMAL_BLOCK; r++) {
    if (is_level[r + WINDOW_RADIUS]) continue;
    __global const uchar *row = kept + (low + r) * width + left;
    int touched[NORMAL_BLOCK];
    int some = 0;
    IN_LANES
    for (int c = 0; c < NORMAL_BLOCK; c++) {
      touched[c] = row[c - width - 1] | row[c - width] | row[c - width + 1] | row[c - 1] | row[c] |
                   row[c + 1] | row[c + width - 1] | row[c + width] | row[c + width + 1];
      some |= touched[c];
    }
    if (!some) continue;
    int16 jxx = 1 << (TENSOR_SHIFT - 1), jyy = jxx, jxy = jxx;
    for (int k = 0; k < WINDOW_TAPS; k++) {
      if (is_level[r + k]) continue;
      jxx += window[k] * sums[0][r + k];
      jyy += window[k] * sums[1][r + k];
      jxy += window[k] * sums[2][r + k];
    }
    jxx >>= TENSOR_SHIFT;
    jyy >>= TENSOR_SHIFT;
    jxy >>= TENSOR_SHIFT;
    const int *each_xx = (const int *)&jxx, *each_yy = (const int *)&jyy;
    const int *each_xy = (const int *)&jxy;
    for (int c = 0; c < NORMAL_BLOCK; c++)
      if (touched[c])
        normals[(low + r) * width + left + c] = normal_of(each_xx[c], each_yy[c], each_xy[c]);
  }
}

/* Which of a cell and the next ones along x, along y and along both are walls: bits 0 to 3.
 * kept, corners (height, width) uchar; corners of the last two rows,
 * in the border, are 0.
 * Global: (width / NORMAL_BLOCK, height). */
__kernel void wall_corners(__global const uchar *kept, const int height, const int width,
                           __global uchar *corners) {
  const int first = get_global_id(0) * NORMAL_BLOCK, row = get_global_id(1);
  if (first >= width || row >= height) return;
  __global const uchar *at = kept + row * width + first;
  __global uchar *out = corners + row * width + first;
  if (row + 2 >= height) {
    for (int c = 0; c < NORMAL_BLOCK; c++) out[c] = 0;
    return;
  }
  IN_LANES
  for (int c = 0; c < NORMAL_BLOCK; c++)
    out[c] = at[c] | at[c + 1] << 1 | at[c + width] << 2 | at[c + width + 1] << 3;
}

/* Whether walls interpolated between the corners of a cell, (u, v) in 1/2^RAY_SHIFT cell, count as
 * wall. */
INLINE int is_wall_between(const int corners, const int u, const int v) {
  const int one = 1 << RAY_SHIFT;
  const int lower = (one - u) * (corners & 1) + u * (corners >> 1 & 1);
  const int upper = (one - u) * (corners >> 2 & 1) + u * (corners >> 3);
  return (one - v) * lower + v * upper >= WALL_LEVEL;
}

/* Whether a ray from a wall cell, by (step_x, step_y) in 1/2^RAY_SHIFT cell each half cell, meets
 * another wall, parallel to its own. */
INLINE int meets_parallel(__global const uchar *corners, __global const short2 *normals,
                          const int width, const int cell, const int step_x, const int step_y,
                          const int total, const int own, const int other, const int gap,
                          const int thickness) {
  const int fraction = (1 << RAY_SHIFT) - 1;
  int own_end = 0;
  for (int n = 1; n <= total && n - 1 - own_end <= gap; n++) {
    const int x = n * step_x, y = n * step_y;
    const int around = corners[cell + (y >> RAY_SHIFT) * width + (x >> RAY_SHIFT)];
    if (!around || !is_wall_between(around, x & fraction, y & fraction)) continue;
    if (n - own_end <= own) {
      own_end = n;
      if (own_end > thickness) return 0;
    } else if (n - own_end <= other) {
      /* Half a cell further the ray is inside the other wall. */
      const int middle = 1 << (RAY_SHIFT - 1);
      const int right = ((n + 1) * step_x + middle) >> RAY_SHIFT;
      const int up = ((n + 1) * step_y + middle) >> RAY_SHIFT;
      const short2 normal = normals[cell + up * width + right];
      const int product = normal.x * step_x + normal.y * step_y;
      return product >= PARALLEL || product <= -PARALLEL;
    }
  }
  return 0;
}

/* Mark the cells asked about: 0 no wall, 1 a wall, 2 a wall that is doubled.
 * corners (height, width) uchar, see wall_corners; normals likewise short2, see wall_normals; total
 * to thickness: steps of rays, see RaySteps; marks (height, width) uchar, not 0 where a cell is asked
 * about.
 * Global: (width / NORMAL_BLOCK, height). */
__kernel void mark_doubled(__global const uchar *corners, __global const short2 *normals,
                           const int height, const int width, const int total, const int own,
                           const int other, const int gap, const int thickness,
                           __global uchar *marks) {
  const int first = get_global_id(0) * NORMAL_BLOCK, row = get_global_id(1);
  if (first >= width || row >= height) return;
  const int start = row * width + first;
  if (no_wall(marks + start)) return;
  for (int cell = start; cell < start + NORMAL_BLOCK; cell++) {
    if (!marks[cell]) continue;
    marks[cell] = corners[cell] & 1;
    if (!marks[cell]) continue;
    const short2 n = normals[cell];
    if (n.x == 0 && n.y == 0) continue;
    if (meets_parallel(corners, normals, width, cell, n.x, n.y, total, own, other, gap, thickness) ||
        meets_parallel(corners, normals, width, cell, -n.x, -n.y, total, own, other, gap, thickness))
      marks[cell] = 2;
  }
}
