/* From trinary cells to what alignment looks at: surface walls, coarse grids, distance and score
 * fields, grids resampled under rigid motions.
 *
 * Twin: slamfusion/compute/fields.py, by the same names; distance_columns and distance_rows
 * are distance_squared, max_pair is an axis of max_ahead. All integer, so kernel and twin agree
 * exactly.
 * Work sizes: any local size; every kernel guards its global size.
 */
#include "common.h"

/* Free cells among the eight neighbours of a cell; cells outside are unknown. */
INLINE int free_neighbours(__global const char *cells, const int height, const int width,
                           const int row, const int col) {
  int count = 0;
  for (int r = HIGHER(row - 1, 0); r <= LOWER(row + 1, height - 1); r++)
    for (int c = HIGHER(col - 1, 0); c <= LOWER(col + 1, width - 1); c++)
      count += (r != row || c != col) && cells[r * width + c] == FREE;
  return count;
}

/* Cells of a row that are done together, a byte each of four words, where all their neighbours lie on
 * the map. */
#define WALL_LANES 32

/* Free cells among the neighbours of each: of -1, 0 and 1 only 0 has no lowest bit. */
INLINE ulong4 free_around(__global const char *at, const int width) {
  __global const char *above = at + width, *below = at - width;
  return (~LOAD32(below - 1) & EACH_LANE) + (~LOAD32(below) & EACH_LANE) +
         (~LOAD32(below + 1) & EACH_LANE) + (~LOAD32(at - 1) & EACH_LANE) +
         (~LOAD32(at + 1) & EACH_LANE) + (~LOAD32(above - 1) & EACH_LANE) +
         (~LOAD32(above) & EACH_LANE) + (~LOAD32(above + 1) & EACH_LANE);
}

/* 1 where a wall cell does not stand in free space alone, else 0. A speck of noise, or two side by
 * side, has seven or eight free neighbours: SPECK_FREE_CELLS.
 * cells (height, width) char trinary; out (height, width) uchar.
 * Global: (ceil(width / RUN), height). */
__kernel void solid_walls(__global const char *cells, const int height, const int width,
                          __global uchar *out) {
  const int first = get_global_id(0) * RUN, row = get_global_id(1);
  if (first >= width || row >= height) return;
  const int stop = LOWER(first + RUN, width);
  const bool is_inner = row > 0 && row + 1 < height;
  for (int col = first; col < stop; col++) {
    __global const char *at = cells + row * width + col;
    __global uchar *to = out + row * width + col;
    if (is_inner && col > 0 && col + WALL_LANES <= LOWER(stop, width - 1)) {
      const ulong4 own = LOAD32(at), seven = (free_around(at, width) + EACH_LANE) >> 3;
      STORE32(own & ~(own >> 1) & ~seven & EACH_LANE, to);
      col += WALL_LANES - 1;
    } else {
      *to = *at == OCCUPIED && free_neighbours(cells, height, width, row, col) < SPECK_FREE_CELLS;
    }
  }
}

/* 1 where a solid wall cell touches free space (8 neighbours), else 0.
 * cells (height, width) char trinary; solid, out (height, width) uchar.
 * Global: (ceil(width / RUN), height). */
__kernel void surface_walls(__global const char *cells, __global const uchar *solid,
                            const int height, const int width, __global uchar *out) {
  const int first = get_global_id(0) * RUN, row = get_global_id(1);
  if (first >= width || row >= height) return;
  const int stop = LOWER(first + RUN, width);
  const bool is_inner = row > 0 && row + 1 < height;
  for (int col = first; col < stop; col++) {
    const int at = row * width + col;
    if (is_inner && col > 0 && col + WALL_LANES <= LOWER(stop, width - 1)) {
      const ulong4 count = free_around(cells + at, width);
      STORE32(LOAD32(solid + at) & (count | count >> 1 | count >> 2 | count >> 3), out + at);
      col += WALL_LANES - 1;
    } else {
      out[at] = solid[at] && free_neighbours(cells, height, width, row, col) > 0;
    }
  }
}

/* Blocks of step x step cells: a coarse wall where any fine wall is, and the free share 0..255.
 * walls (height, width) uchar; cells (height, width) char; out_* (out_height, out_width) uchar.
 * Blocks that reach over the edge count the missing cells as unknown. A work item does the blocks
 * that RUN columns hold, adding whole rows in lanes, then columns; one block where it is wider.
 * Global: (ceil(out_width / max(1, RUN / step)), out_height). */
__kernel void shrink(__global const uchar *walls, __global const char *cells, const int height,
                     const int width, const int step, const int out_height, const int out_width,
                     __global uchar *out_wall, __global uchar *out_free) {
  const int blocks = HIGHER(1, RUN / step);
  const int first = get_global_id(0) * blocks, row = get_global_id(1);
  if (first >= out_width || row >= out_height) return;
  const int stop = LOWER(first + blocks, out_width);
  const int left = first * step, cols = LOWER(stop * step, width) - left;
  const int top = row * step, bottom = LOWER(top + step, height);
  if (step > RUN) {
    int wall = 0, free_cells = 0;
    for (int r = top; r < bottom; r++)
      for (int i = r * width + left; i < r * width + left + cols; i++) {
        wall |= walls[i];
        free_cells += cells[i] == FREE;
      }
    out_wall[row * out_width + first] = wall;
    out_free[row * out_width + first] = free_cells * FIELD_ONE / (step * step);
    return;
  }
  uchar wall_in[RUN], free_in[RUN];
  for (int i = 0; i < RUN; i++) wall_in[i] = free_in[i] = 0;
  for (int r = top; r < bottom; r++) {
    __global const uchar *wall_row = walls + r * width + left;
    __global const char *cell_row = cells + r * width + left;
    /* A whole run, of which the last columns may not count, is in lanes to its end. */
    if (left + RUN <= width) {
      for (int i = 0; i < RUN; i++) {
        wall_in[i] |= wall_row[i];
        free_in[i] += cell_row[i] == FREE;
      }
    } else {
      for (int i = 0; i < cols; i++) {
        wall_in[i] |= wall_row[i];
        free_in[i] += cell_row[i] == FREE;
      }
    }
  }
  /* A product with this, rounded up, is the quotient: a block has at most RUN * RUN cells. */
  const ulong share = ((1UL << 32) + step * step - 1) / (step * step);
  for (int col = first, from = 0; col < stop; col++, from += step) {
    int wall = 0, free_cells = 0;
    const int to = LOWER(from + step, cols);
    for (int i = from; i < to; i++) {
      wall |= wall_in[i];
      free_cells += free_in[i];
    }
    out_wall[row * out_width + col] = wall;
    out_free[row * out_width + col] = free_cells * FIELD_ONE * share >> 32;
  }
}

/* Columns on either side of the map that no wall is in, so that looking along a row needs no edge. */
#define DISTANCE_MARGIN DISTANCE_MAX

/* First pass of the exact Euclidean distance (Meijster, Roerdink and Hesselink 2000): squared distance
 * along the column to the nearest wall, capped at DISTANCE_MAX squared.
 * walls (height, width) uchar, width a multiple of DISTANCE_LANES; out (height, width + 2
 * DISTANCE_MARGIN) ushort. Global: ((width + 2 DISTANCE_MARGIN) / DISTANCE_LANES). */
__kernel void distance_columns(__global const uchar *walls, const int height, const int width,
                               __global ushort *out) {
  const int at = get_global_id(0) * DISTANCE_LANES, col = at - DISTANCE_MARGIN;
  const int stride = width + 2 * DISTANCE_MARGIN;
  if (at >= stride) return;
  ushort16 last = DISTANCE_MAX;
  if (col < 0 || col >= width) {
    for (int row = 0; row < height; row++) STORE32(as_ulong4(last * last), out + row * stride + at);
    return;
  }
  for (int row = 0; row < height; row++) {
    const ushort16 wall = convert_ushort16(LOAD16(walls + row * width + col));
    last = LOWER(last + (ushort16)1, (ushort16)DISTANCE_MAX);
    last *= (ushort16)1 - wall;
    STORE32(as_ulong4(last), out + row * stride + at);
  }
  last = DISTANCE_MAX;
  for (int row = height - 1; row >= 0; row--) {
    const ushort16 above = as_ushort16(LOAD32(out + row * stride + at));
    last = LOWER(last + (ushort16)1, above);
    STORE32(as_ulong4(last * last), out + row * stride + at);
  }
}

/* Whether any lane exceeds a value. */
INLINE bool any_above(const ushort16 lanes, const ushort value) {
  const short16 above = lanes > (ushort16)value;
  const ulong4 words = as_ulong4(above);
  return (words.x | words.y | words.z | words.w) != 0;
}

/* Second pass: squared distance, the minimum over the row of that along the column plus offset squared,
 * capped at reach squared; reach at most DISTANCE_MAX. Unrolled, so that squares of offsets are constants.
 * columns (height, width + 2 DISTANCE_MARGIN) ushort; out (height, width) ushort, width a multiple of
 * DISTANCE_LANES. Global: (width / DISTANCE_LANES, height). */
__kernel void distance_rows(__global const ushort *columns, const int height, const int width,
                            const int reach, __global ushort *out) {
  const int col = get_global_id(0) * DISTANCE_LANES, row = get_global_id(1);
  if (col >= width || row >= height) return;
  __global const ushort *own = columns + row * (width + 2 * DISTANCE_MARGIN) + DISTANCE_MARGIN + col;
  ushort16 best = as_ushort16(LOAD32(own));
  best = LOWER(best, (ushort16)(reach * reach));
  /* Nothing farther along the row can be nearer than the worst lane: look every eight steps. */
#pragma unroll
  for (int from = 1; from < DISTANCE_MAX; from += 8) {
    if (from >= reach || !any_above(best, (ushort)(from * from))) break;
#pragma unroll
    for (int k = from; k < from + 8; k++) {
      const ushort16 left = as_ushort16(LOAD32(own - k)), right = as_ushort16(LOAD32(own + k));
      const ushort16 through = LOWER(left, right) + (ushort16)(k * k);
      best = LOWER(best, through);
    }
  }
  STORE32(as_ulong4(best), out + row * width + col);
}

/* Distances in 1/256 cell from squared ones; DISTANCE_UNSEEN in cells without free space that are farther
 * than `most` from walls.
 * distance2, out (cells) ushort; free_share (cells) uchar; table ushort, one entry for every d2.
 * Global: (ceil(cells / RUN)). All gathers of a run come first, see score_field. */
__kernel void wall_distances(__global const ushort *distance2, __global const uchar *free_share,
                             __global const ushort *table, const int most, const int cells,
                             __global ushort *out) {
  const int first = get_global_id(0) * RUN, run = LOWER(RUN, cells - first);
  ushort distance[RUN];
  for (int i = 0; i < run; i++) distance[i] = table[distance2[first + i]];
  for (int i = 0; i < run; i++)
    out[first + i] = free_share[first + i] || distance[i] <= most ? distance[i] : DISTANCE_UNSEEN;
}

/* What a wall point of the other map is worth in each cell:
 * base + hit[d2] - free * miss[d2] / FIELD_ONE, rounded down, within 0..FIELD_ONE.
 * distance2 (cells) ushort; free_share (cells) uchar 0..255; worths one ushort for every d2: hit, and
 * miss above 8 bits, one gather for both; out (cells) uchar. Global: (ceil(cells / RUN)).
 * All gathers of a run come first: the arithmetic is in lanes then, and in one loop with them it is
 * not, and takes ten times as long on PoCL. */
__kernel void score_field(__global const ushort *distance2, __global const uchar *free_share,
                          __global const ushort *worths, const int base, const int cells,
                          __global uchar *out) {
  const int first = get_global_id(0) * RUN;
  const int stop = first + RUN < cells ? first + RUN : cells;
  const int run = stop - first;
  ushort worth[RUN];
  for (int i = 0; i < run; i++) worth[i] = worths[distance2[first + i]];
  for (int i = 0; i < run; i++) {
    const uint less = (free_share[first + i] * (uint)(worth[i] >> 8)) / FIELD_ONE;
    const int value = base + (uchar)worth[i] - (int)less;
    out[first + i] = (uchar)(value < 0 ? 0 : value > FIELD_ONE ? FIELD_ONE : value);
  }
}

/* How much of the known cells lies at each squared distance to a wall, over chunks of cells:
 * partial[chunk, d2] = the sum of FIELD_ONE for each wall and the free share of other cells.
 * distance2 (cells) ushort; wall (cells) uchar 0 or 1; free_share (cells) uchar 0..255;
 * partial (chunks, DISTANCE2_MAX + 1) int. Global: (1, chunks, 1). */
__kernel void known_by_distance(__global const ushort *distance2, __global const uchar *wall,
                                __global const uchar *free_share, const int cells,
                                const int chunk, const int chunks, __global int *partial) {
  const int c = get_global_id(1);
  if (c >= chunks) return;
  __global int *sums = partial + (size_t)c * (DISTANCE2_MAX + 1);
  for (int d2 = 0; d2 <= DISTANCE2_MAX; d2++) sums[d2] = 0;
  const int stop = LOWER((c + 1) * chunk, cells), even = c * chunk + ((stop - c * chunk) & ~15);
  for (int i = c * chunk; i < even; i += 16) {
    const uchar16 is_wall = as_uchar16(LOAD16(wall + i) != (uchar16)0);
    const ulong2 known = as_ulong2(is_wall | LOAD16(free_share + i));
    if ((known.x | known.y) == 0) continue;
#pragma unroll
    for (int k = 0; k < 8; k++) {
      sums[distance2[i + k]] += known.x >> 8 * k & FIELD_ONE;
      sums[distance2[i + 8 + k]] += known.y >> 8 * k & FIELD_ONE;
    }
  }
  for (int i = even; i < stop; i++) sums[distance2[i]] += wall[i] ? FIELD_ONE : free_share[i];
}

/* One doubling of a window maximum: the larger of each cell and the cell `shift` farther along the
 * row or the column; cells outside count as 0.
 * field, out (height, width) uchar, not the same buffer.
 * Global: (ceil(width / WINDOW_LANES), height). */
__kernel void max_pair(__global const uchar *field, const int height, const int width,
                       const int shift, const int along_rows, __global uchar *out) {
  const int col = get_global_id(0) * WINDOW_LANES, row = get_global_id(1);
  if (col >= width || row >= height) return;
  const size_t index = (size_t)row * width + col;
  const int step = along_rows ? shift : shift * width;
  const int reach = col + WINDOW_LANES + (along_rows ? shift : 0);
  if (reach <= width && (along_rows || row + shift < height)) {
    const ulong4 own = LOAD32(field + index), other = LOAD32(field + index + step);
    const uchar16 a = as_uchar16(own.lo), b = as_uchar16(other.lo);
    const uchar16 c = as_uchar16(own.hi), d = as_uchar16(other.hi);
    const ulong2 low = as_ulong2(HIGHER(a, b)), high = as_ulong2(HIGHER(c, d));
    STORE32((ulong4)(low, high), out + index);
    return;
  }
  for (int i = 0; i < WINDOW_LANES && col + i < width; i++) {
    const bool inside = along_rows ? col + i + shift < width : row + shift < height;
    const uchar other = inside ? field[index + i + step] : 0;
    const uchar own = field[index + i];
    out[index + i] = own > other ? own : other;
  }
}

/* Cells that are looked at together: mostly all on the input, or all off it. */
#define WARP_CELLS 32

/* The cells of `in` at the fixed pose of the centres of `count` cells of a row, every stride-th from one
 * on; fill outside. Along a row the position grows by a constant, two additions a cell instead of four
 * products. */
INLINE void warped_run(__global const char *in, const int height, const int width, const long4 pose,
                       const int row, const int first, const int stride, const int count,
                       const char fill, char *run) {
  const long x2 = 2 * first + 1, y2 = 2 * row + 1, dx = 2 * stride * pose.x, dy = 2 * stride * pose.y;
  long x = pose.x * x2 - pose.y * y2 + pose.z, y = pose.y * x2 + pose.x * y2 + pose.w;
  for (int begin = 0; begin < count; begin += WARP_CELLS) {
    const int end = LOWER(begin + WARP_CELLS, count);
    const long far_x = x + dx * (end - 1 - begin), far_y = y + dy * (end - 1 - begin);
    const long low_x = LOWER(x, far_x) >> FIXED_TO_CELL_SHIFT, low_y = LOWER(y, far_y) >> FIXED_TO_CELL_SHIFT;
    const long high_x = HIGHER(x, far_x) >> FIXED_TO_CELL_SHIFT, high_y = HIGHER(y, far_y) >> FIXED_TO_CELL_SHIFT;
    /* On, or off to one side, at both ends: so between them too. */
    if (low_x >= 0 && low_y >= 0 && high_x < width && high_y < height) {
      for (int i = begin; i < end; i++, x += dx, y += dy) {
        run[i] = in[(int)(y >> FIXED_TO_CELL_SHIFT) * width + (int)(x >> FIXED_TO_CELL_SHIFT)];
      }
    } else if (low_x >= width || low_y >= height || high_x < 0 || high_y < 0) {
      for (int i = begin; i < end; i++) run[i] = fill;
      x = far_x + dx;
      y = far_y + dy;
    } else {
      for (int i = begin; i < end; i++, x += dx, y += dy) {
        const long c = x >> FIXED_TO_CELL_SHIFT, r = y >> FIXED_TO_CELL_SHIFT;
        const bool inside = c >= 0 && r >= 0 && c < width && r < height;
        run[i] = inside ? in[r * width + c] : fill;
      }
    }
  }
}

/* Nearest-cell resampling: out[k, row, col] = in at the fixed pose k of the centre of the output
 * cell, fill outside. poses (count, 4) long Q30, output lattice to input lattice.
 * in (height, width) char; out (count, out_height, out_width) char. A work item does RUN cells of a
 * row. Global: (ceil(out_width / RUN), out_height, count). */
__kernel void warp(__global const char *in, const int height, const int width,
                   __global const long *poses, const int count, const int out_height,
                   const int out_width, const char fill, __global char *out) {
  const int first = get_global_id(0) * RUN, row = get_global_id(1), k = get_global_id(2);
  if (first >= out_width || row >= out_height || k >= count) return;
  const int stop = LOWER(first + RUN, out_width);
  __global char *line = out + ((size_t)k * out_height + row) * out_width + first;
  char run[RUN];
  warped_run(in, height, width, vload4(k, poses), row, first, 1, stop - first, fill, run);
  for (int i = 0; i < stop - first; i++) line[i] = run[i];
}

/* How a trinary grid and another under each pose agree, over chunks of `chunk` rows, at most 63, of every
 * stride-th row and column; the other is unknown outside. partial[p, chunk] = the sum of squared
 * differences of the cells, which is the error of [F16], and the cells that both know.
 * a (height, width), b (b_height, b_width) char; poses (n, 4) long Q30, lattice of a to that of b;
 * partial (n, chunks, 2) int. Global: (chunks, n). */
__kernel void grid_error(__global const char *a, const int height, const int width,
                         __global const char *b, const int b_height, const int b_width,
                         __global const long *poses, const int n, const int stride, const int chunk,
                         const int chunks, __global int *partial) {
  const int c = get_global_id(0), p = get_global_id(1);
  if (c >= chunks || p >= n) return;
  const int start = c * chunk * stride, stop = LOWER(start + chunk * stride, height);
  int error = 0, known = 0;
  for (int first = 0; first < width; first += RUN * stride) {
    const int run = LOWER(RUN, (width - first + stride - 1) / stride);
    /* Column by column: one sum would wait for itself. */
    uchar errors[RUN], knowns[RUN];
    for (int i = 0; i < RUN; i++) errors[i] = knowns[i] = 0;
    for (int row = start; row < stop; row += stride) {
      __global const char *own = a + (size_t)row * width + first;
      char other[RUN];
      warped_run(b, b_height, b_width, vload4(p, poses), row, first, stride, run, UNKNOWN, other);
      for (int i = 0; i < run; i++) {
        const char difference = own[i * stride] - other[i];
        errors[i] += difference * difference;
        knowns[i] += (own[i * stride] | other[i]) >= 0;
      }
    }
    for (int i = 0; i < RUN; i++) {
      error += errors[i];
      known += knowns[i];
    }
  }
  partial[2 * (p * chunks + c)] = error;
  partial[2 * (p * chunks + c) + 1] = known;
}
