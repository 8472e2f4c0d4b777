/* Score rigid motions: all shifts at once, given poses one by one, blocks of motions from above, and
 * fits of motions below a cell.
 *
 * Twin: slamfusion/compute/search.py, by the same names; exact, but for fit_motions (float32,
 * within 1e-4 of a step).
 */
#include "common.h"

/* Add to total what some points find at SHIFT_TILE rows of SHIFT_LANES shifts from (i, j) on, 16 shifts a
 * vector. Field values are 0..15, so SHIFT_POINTS = 16 of them add in one byte lane without a carry.
 * field at shift (i, j); offset (points) int: row * field_width + col of each point; span one int4 for
 * each SHIFT_POINTS points: first and last row, first and last column of the shifts at which any of them
 * reads something else than `base`; elsewhere none is read. */
INLINE void add_points(__global const uchar *field, const int field_width,
                       __global const int *offset, const int points, __global const int4 *span,
                       const int base, const int i, const int j, const int height, int16 *total) {
  const int r1 = LOWER(1, height - 1 - i) * field_width;
  const int r2 = LOWER(2, height - 1 - i) * field_width;
  const int r3 = LOWER(3, height - 1 - i) * field_width;
  int away = 0;
  for (int start = 0; start < points; start += SHIFT_POINTS, span++) {
    const int stop = LOWER(start + SHIFT_POINTS, points);
    const int4 live = *span;
    if (i + SHIFT_TILE <= live.x || i > live.y || j + SHIFT_LANES <= live.z || j > live.w) {
      away += stop - start;
      continue;
    }
    ulong4 w0 = 0, w1 = 0, w2 = 0, w3 = 0;
    for (int n = start; n < stop; n++) {
      __global const uchar *p = field + offset[n];
      w0 += LOAD32(p);
      w1 += LOAD32(p + r1);
      w2 += LOAD32(p + r2);
      w3 += LOAD32(p + r3);
    }
    total[0] += convert_int16(as_uchar16(w0.lo));
    total[1] += convert_int16(as_uchar16(w0.hi));
    total[2] += convert_int16(as_uchar16(w1.lo));
    total[3] += convert_int16(as_uchar16(w1.hi));
    total[4] += convert_int16(as_uchar16(w2.lo));
    total[5] += convert_int16(as_uchar16(w2.hi));
    total[6] += convert_int16(as_uchar16(w3.lo));
    total[7] += convert_int16(as_uchar16(w3.hi));
  }
  for (int k = 0; k < 2 * SHIFT_TILE; k++) total[k] += away * base;
}

/* The best of each tile of SHIFT_TILE x SHIFT_TILE whole-cell shifts, SHIFT_TILE being 4, by the sum
 * over the points n of both sides of fields[k, offset(k, n) + i * field_width + j].
 * Of each side: fields uchar planes, stride bytes from one k to the next (0: one plane for all);
 * offsets int, offset_stride ints from one k to the next; spans (count, ceil(points / SHIFT_POINTS))
 * int4; see add_points. Fields can be read at shifts up to a multiple of SHIFT_LANES along a row.
 * values, places (count, tiles_y, tiles_x) int; a place is i * width + j; the first of equal sums
 * wins: what is compared is the sum and, in four bits below it, how far the shift is from the tile's
 * last. Global: (ceil(width / SHIFT_LANES), tiles_y, count). */
__kernel void best_shifts(__global const uchar *ahead, const int ahead_stride, const int ahead_width,
                          __global const int *ahead_offsets, const int ahead_offset_stride,
                          const int ahead_points, __global const int4 *ahead_spans,
                          const int ahead_base, __global const uchar *back, const int back_stride,
                          const int back_width, __global const int *back_offsets,
                          const int back_offset_stride, const int back_points,
                          __global const int4 *back_spans, const int back_base, const int height,
                          const int width, const int tiles_y, const int tiles_x, const int count,
                          __global int *values, __global int *places) {
  const int j = get_global_id(0) * SHIFT_LANES, ty = get_global_id(1), k = get_global_id(2);
  const int i = ty * SHIFT_TILE, cells = SHIFT_TILE * SHIFT_TILE;
  if (j >= width || i >= height || k >= count) return;
  int16 total[2 * SHIFT_TILE];
  for (int n = 0; n < 2 * SHIFT_TILE; n++) total[n] = 0;
  add_points(ahead + (size_t)k * ahead_stride + (size_t)i * ahead_width + j, ahead_width,
             ahead_offsets + (size_t)k * ahead_offset_stride, ahead_points,
             ahead_spans + (size_t)k * ((ahead_points + SHIFT_POINTS - 1) / SHIFT_POINTS), ahead_base,
             i, j, height, total);
  add_points(back + (size_t)k * back_stride + (size_t)i * back_width + j, back_width,
             back_offsets + (size_t)k * back_offset_stride, back_points,
             back_spans + (size_t)k * ((back_points + SHIFT_POINTS - 1) / SHIFT_POINTS), back_base,
             i, j, height, total);
  const int16 column = (int16)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
  for (int side = 0; side < 2; side++) {
    const int first = j + 16 * side;
    const int16 place = cells - 1 - (column & (SHIFT_TILE - 1));
    int16 best = -1;
    for (int r = 0; r < SHIFT_TILE; r++) {
      const int16 ranked = total[2 * r + side] * cells + place - r * SHIFT_TILE;
      best = i + r < height ? HIGHER(best, ranked) : best;
    }
    best = first + column < width ? best : (int16)-1;
    const int8 pairs = HIGHER(best.even, best.odd);
    const int4 four = HIGHER(pairs.even, pairs.odd);
    const int ranks[4] = {four.x, four.y, four.z, four.w};
    for (int t = 0; t < 4 && first + t * SHIFT_TILE < width; t++) {
      const int out = (k * tiles_y + ty) * tiles_x + first / SHIFT_TILE + t;
      const int at = cells - 1 - ranks[t] % cells;
      values[out] = ranks[t] / cells;
      places[out] = (i + at / SHIFT_TILE) * width + first + t * SHIFT_TILE + at % SHIFT_TILE;
    }
  }
}

/* The sum of the two cells that a word of two ints names: words leave a vector in half the moves. */
#define AT_BOTH(word) (field[(uint)(word)] + field[(word) >> 32])

/* A number in Q30 in 32 bits: `drop` bits are rounded off. */
INLINE int narrowed(const long value, const int drop) { return (value + (1L << (drop - 1))) >> drop; }

/* The field where eight points meet it, summed; `minus_met` loses 1 in the lane of each that does. A
 * point off the field reads its first cell, which `with_rest` puts right. */
INLINE int eight_met(__global const uchar *field, const int height, const int width, const int8 col,
                     const int8 row, int8 *minus_met) {
  const int8 inside = (as_uint8(col) < (uint8)width) & (as_uint8(row) < (uint8)height);
  *minus_met += inside;
  const ulong4 two = as_ulong4(inside & (row * width + col));
  return (AT_BOTH(two.x) + AT_BOTH(two.y)) + (AT_BOTH(two.z) + AT_BOTH(two.w));
}

/* What points are worth in all, of which the first were summed in lanes: with those from `next` to
 * `stop`, less than eight, and `base` for each of `count` that is off the field. */
INLINE int with_rest(int sum, const int8 minus_met, __global const int *points, const int stride,
                     const int next, const int stop, const int count, const int cosine,
                     const int sine, const int tx, const int ty, const int shift,
                     __global const uchar *field, const int height, const int width,
                     const int base) {
  const int4 four = minus_met.lo + minus_met.hi;
  int met = -(four.x + four.y + four.z + four.w);
  for (int i = next; i < stop; i++) {
    const int x2 = points[i], y2 = points[stride + i];
    const int col = (cosine * x2 - sine * y2 + tx) >> shift;
    const int row = (sine * x2 + cosine * y2 + ty) >> shift;
    const int inside = ((uint)col < (uint)width) & ((uint)row < (uint)height);
    sum += field[inside ? row * width + col : 0];
    met += inside;
  }
  return sum + (count - met) * (base - (int)field[0]);
}

/* What the points are worth under each pose, summed over chunks of points:
 * partial[chunk, p] = sum of the field in the cells that the points meet, `base` for those off it.
 * points (2, stride) int: x of all points about their middle, then y, stride and chunk multiples of 8;
 * motions (4, n) long Q30: cos, sin, x, y, points to field, of which `drop` bits are rounded off and
 * `shift` remain below a whole cell (see narrow_motions);
 * field (height, width) uchar; partial (chunks, n) int.
 * 32 bits, so that eight points move at once: three times as fast on PoCL as one by one in 64.
 * Work item c * n + p does chunk c under pose p: of two dimensions the groups are so wide that with
 * one chunk, as of most motions, fifteen of sixteen items would have nothing to do.
 * Global: (chunks * n). */
__kernel void pose_scores(__global const int *points, const int count, const int stride,
                          __global const long *motions, const int n, const int drop,
                          const int shift, __global const uchar *field, const int height,
                          const int width, const int base, const int chunk, const int chunks,
                          __global int *partial) {
  const int c = get_global_id(0) / n, p = get_global_id(0) % n;
  if (c >= chunks) return;
  const int cosine = narrowed(motions[p], drop), sine = narrowed(motions[n + p], drop);
  const int tx = narrowed(motions[2 * n + p], drop), ty = narrowed(motions[3 * n + p], drop);
  const int first = c * chunk, stop = LOWER(first + chunk, count);
  const int even = first + ((stop - first) & ~7);
  int sum = 0;
  int8 minus_met = 0;
  for (int i = first; i < even; i += 8) {
    const int8 x2 = *(__global const int8 *)(points + i);
    const int8 y2 = *(__global const int8 *)(points + stride + i);
    const int8 col = (cosine * x2 - sine * y2 + tx) >> shift;
    const int8 row = (sine * x2 + cosine * y2 + ty) >> shift;
    sum += eight_met(field, height, width, col, row, &minus_met);
  }
  partial[c * n + p] = with_rest(sum, minus_met, points, stride, even, stop, stop - first, cosine, sine,
                                 tx, ty, shift, field, height, width, base);
}

/* What the points are worth under each motion and its eight neighbours, shifted by a step along x, y
 * or both: partial[chunk, n, 3 i + j] = pose_scores of motion n shifted by i and j steps, of {0, -1,
 * 1}. The nine share a rotation, so the products of a point are made once.
 * All as of pose_scores, but motions (6, n): also a step along x in the field, a and b; one along y is
 * (-b, a) there; and partial (chunks, n, 9) int. Global: (chunks * n). */
__kernel void neighbour_scores(__global const int *points, const int count, const int stride,
                               __global const long *motions, const int n, const int drop,
                               const int shift, __global const uchar *field, const int height,
                               const int width, const int base, const int chunk, const int chunks,
                               __global int *partial) {
  const int c = get_global_id(0) / n, p = get_global_id(0) % n;
  if (c >= chunks) return;
  const int cosine = narrowed(motions[p], drop), sine = narrowed(motions[n + p], drop);
  const long x = motions[2 * n + p], y = motions[3 * n + p];
  const long a = motions[4 * n + p], b = motions[5 * n + p];
  int tx[NEIGHBOURS], ty[NEIGHBOURS], sum[NEIGHBOURS];
  int8 minus_met[NEIGHBOURS];
  for (int k = 0; k < NEIGHBOURS; k++) {
    const int i = k / 3 == 2 ? 1 : -(k / 3), j = k % 3 == 2 ? 1 : -(k % 3);
    tx[k] = narrowed(x + i * a - j * b, drop);
    ty[k] = narrowed(y + i * b + j * a, drop);
    sum[k] = 0;
    minus_met[k] = 0;
  }
  const int first = c * chunk, stop = LOWER(first + chunk, count);
  const int even = first + ((stop - first) & ~7);
  for (int i = first; i < even; i += 8) {
    const int8 x2 = *(__global const int8 *)(points + i);
    const int8 y2 = *(__global const int8 *)(points + stride + i);
    const int8 across = cosine * x2 - sine * y2, up = sine * x2 + cosine * y2;
#pragma unroll
    for (int k = 0; k < NEIGHBOURS; k++) {
      const int8 col = (across + tx[k]) >> shift, row = (up + ty[k]) >> shift;
      sum[k] += eight_met(field, height, width, col, row, &minus_met[k]);
    }
  }
  for (int k = 0; k < NEIGHBOURS; k++) {
    partial[(c * n + p) * NEIGHBOURS + k] =
        with_rest(sum[k], minus_met[k], points, stride, even, stop, stop - first, cosine, sine, tx[k],
                  ty[k], shift, field, height, width, base);
  }
}

/* What the points meet under each pose, summed over chunks of points: partial[p, chunk] = the score,
 * points on known cells, for each limit points no farther than that from a wall, and for each limit
 * points in free space that are farther. A point scores what score_field gives there, or `base` off
 * the map. points (count, 2) int lattice positions; poses (n, 4) long Q30, points to cells;
 * grid (height, width) char trinary; distance2 (height, width) ushort; worths as of score_field;
 * limits2 (limits) int, squared cells, at most LIMITS_MAX; partial (n, chunks, 2 + 2 limits) int.
 * Global: (chunks, n). */
__kernel void pose_counts(__global const int *points, const int count, __global const long *poses,
                          const int n, __global const char *grid,
                          __global const ushort *distance2, const int height, const int width,
                          __global const ushort *worths, const int base, __global const int *limits2,
                          const int limits, const int chunk, const int chunks, __global int *partial) {
  const int c = get_global_id(0), p = get_global_id(1);
  if (c >= chunks || p >= n) return;
  const long4 pose = vload4(p, poses);
  int score = 0, known = 0, limit[LIMITS_MAX], near[LIMITS_MAX], beyond[LIMITS_MAX];
  for (int l = 0; l < LIMITS_MAX; l++) {
    limit[l] = l < limits ? limits2[l] : 0;
    near[l] = beyond[l] = 0;
  }
  const int stop = LOWER((c + 1) * chunk, count);
  for (int i = c * chunk; i < stop; i++) {
    const int2 cell = fixed_cell(pose, points[2 * i], points[2 * i + 1]);
    if (cell.x < 0 || cell.y < 0 || cell.x >= width || cell.y >= height) {
      score += base;
      continue;
    }
    const size_t at = (size_t)cell.y * width + cell.x;
    const int d2 = distance2[at], is_free = grid[at] == FREE;
    const int worth = base + (uchar)worths[d2] - is_free * (worths[d2] >> 8);
    score += worth < 0 ? 0 : LOWER(worth, FIELD_ONE);
    known += grid[at] != UNKNOWN;
    /* Of all limits, so that the counts are kept in registers. */
#pragma unroll
    for (int l = 0; l < LIMITS_MAX; l++) {
      const int is_near = d2 <= limit[l];
      near[l] += is_near;
      beyond[l] += is_free & !is_near;
    }
  }
  __global int *out = partial + (p * chunks + c) * (2 + 2 * limits);
  out[0] = score;
  out[1] = known;
  for (int l = 0; l < limits; l++) {
    out[2 + l] = near[l];
    out[2 + limits + l] = beyond[l];
  }
}

/* Fit motions to the nearest best fit of walls on walls: damped Gauss-Newton steps.
 *
 * The unknown of a step is a small motion (dx, dy, reach * dyaw) of the reference frame, applied after
 * the motion, about the centre (cx, cy). Residual: the distance d at the mapped point, bilinear over
 * cell centres, from a field in 1/256 cell. Weight: Geman-McClure, 1 / (1 + (d / scale)^2)^2.
 * Forward: points of the moving grid on the reference's field; the gradient is used as it is, the arm
 * is the mapped point. Backward: points of the reference on the moving field;
 * the gradient turns into the reference frame and changes sign, the arm is the point itself.
 * A step is no longer than the scale; one of less than `settled` cells ends a round. `damping` times
 * the sum of weights is added to the matrix.
 * *_points (count, 2) float cells; *_distance (height, width) ushort, 1/256 cell; DISTANCE_UNSEEN
 * where a point counts for nothing; motions (4, n) float: cos, sin, tx, ty in cells, moving points to
 * the reference; scales (rounds, n) float, cells; moved (n, 3) float: dx and dy in cells, and dyaw of
 * all steps. One work-group a motion, its items share the points.
 * FIT_LANES = 8 points are done at once; what lies off the map, or is not seen, weighs nothing. */
#define FIT_LANES 8
#define GATHERED(n) (uint8)(n[0], n[1], n[2], n[3], n[4], n[5], n[6], n[7])
/* A cell and the next of its row in one word. */
#ifdef UNALIGNED_WORDS
#define BOTH_CELLS(at) (*(__global const uint *)(at))
#else
#define BOTH_CELLS(at) ((at)[0] | (uint)(at)[1] << 16)
#endif

INLINE float lanes_sum(const float8 lanes) {
  const float4 four = lanes.lo + lanes.hi;
  const float2 two = four.lo + four.hi;
  return two.x + two.y;
}

/* Matrix, gradient and sum of weights: Hxx Hxy Hxt Hyy Hyt Htt, gx gy gt, w. */
#define FIT_TERMS 10

/* Find the terms of an item's part of one side's points, and add them to `sum`. */
INLINE void add_terms(__global const float *points, const int count, __global const ushort *distance,
                      const int height, const int width, const float4 pose, const float scale,
                      const float3 pivot, const bool backward, float *sum) {
  const float cosine = pose.x, sine = pose.y, narrow = 1.0f / (scale * scale), arm = 1.0f / pivot.z;
  float8 xx = 0.0f, xy = 0.0f, xt = 0.0f, yy = 0.0f, yt = 0.0f, tt = 0.0f;
  float8 x = 0.0f, y = 0.0f, t = 0.0f, all = 0.0f;
  for (int i = get_local_id(0) * FIT_LANES; i < count && width > 1 && height > 1;
       i += FIT_LANES * CLIMBERS) {
    float8 ox, oy;
    if (i + FIT_LANES <= count) {
      const float8 near = as_float8(LOAD32(points + 2 * i)), far = as_float8(LOAD32(points + 2 * i + 8));
      ox = (float8)(near.even, far.even);
      oy = (float8)(near.odd, far.odd);
    } else {
      float px[FIT_LANES], py[FIT_LANES];
      for (int lane = 0; lane < FIT_LANES; lane++) {
        const int at = LOWER(i + lane, count - 1);
        px[lane] = points[2 * at];
        py[lane] = points[2 * at + 1];
      }
      ox = (float8)(px[0], px[1], px[2], px[3], px[4], px[5], px[6], px[7]);
      oy = (float8)(py[0], py[1], py[2], py[3], py[4], py[5], py[6], py[7]);
    }
    const float8 qx = cosine * ox - sine * oy + pose.z, qy = sine * ox + cosine * oy + pose.w;
    /* Cells of the corner below; a point that has none on the map looks at the first ones. */
    const int8 on = ((int8)(0, 1, 2, 3, 4, 5, 6, 7) < count - i) & (qx >= 0.5f) & (qy >= 0.5f) &
                    (qx < width - 0.5f) & (qy < height - 0.5f);
    const float8 fx = on ? qx - 0.5f : (float8)0.0f, fy = on ? qy - 0.5f : (float8)0.0f;
    const int8 col = CONVERT(int8, fx), row = CONVERT(int8, fy);
    const int8 cell = row * width + col;
    const int cells[FIT_LANES] = {cell.s0, cell.s1, cell.s2, cell.s3,
                                  cell.s4, cell.s5, cell.s6, cell.s7};
    uint low[FIT_LANES], high[FIT_LANES];
    for (int lane = 0; lane < FIT_LANES; lane++) {
      low[lane] = BOTH_CELLS(distance + cells[lane]);
      high[lane] = BOTH_CELLS(distance + cells[lane] + width);
    }
    const uint8 row0 = GATHERED(low), row1 = GATHERED(high);
    const float8 r00 = CONVERT(float8, as_int8(row0 << 16 >> 16)), r01 = CONVERT(float8, as_int8(row0 >> 16));
    const float8 r10 = CONVERT(float8, as_int8(row1 << 16 >> 16)), r11 = CONVERT(float8, as_int8(row1 >> 16));
    const float unseen = DISTANCE_UNSEEN;
    const int8 counts = on & (r00 < unseen) & (r01 < unseen) & (r10 < unseen) & (r11 < unseen);
    const float8 u = fx - CONVERT(float8, col), v = fy - CONVERT(float8, row);
    const float8 d00 = r00 * (1.0f / DISTANCE_ONE), d01 = r01 * (1.0f / DISTANCE_ONE);
    const float8 d10 = r10 * (1.0f / DISTANCE_ONE), d11 = r11 * (1.0f / DISTANCE_ONE);
    const float8 d = (1 - v) * ((1 - u) * d00 + u * d01) + v * ((1 - u) * d10 + u * d11);
    float8 gx = (1 - v) * (d01 - d00) + v * (d11 - d10);
    float8 gy = (1 - u) * (d10 - d00) + u * (d11 - d01);
    const float8 root = 1.0f + d * d * narrow;
    const float8 weight = counts ? 1.0f / (root * root) : (float8)0.0f;
    float8 ax = (qx - pivot.x) * arm, ay = (qy - pivot.y) * arm;
    if (backward) {
      const float8 hx = -(cosine * gx + sine * gy), hy = -(cosine * gy - sine * gx);
      gx = hx;
      gy = hy;
      ax = (ox - pivot.x) * arm;
      ay = (oy - pivot.y) * arm;
    }
    const float8 gt = gy * ax - gx * ay;
    const float8 wx = weight * gx, wy = weight * gy, wt = weight * gt;
    xx += wx * gx;
    xy += wx * gy;
    xt += wx * gt;
    yy += wy * gy;
    yt += wy * gt;
    tt += wt * gt;
    x += wx * d;
    y += wy * d;
    t += wt * d;
    all += weight;
  }
  const float found[FIT_TERMS] = {
      lanes_sum(xx), lanes_sum(xy), lanes_sum(xt), lanes_sum(yy), lanes_sum(yt),
      lanes_sum(tt), lanes_sum(x),  lanes_sum(y),  lanes_sum(t),  lanes_sum(all)};
  for (int k = 0; k < FIT_TERMS; k++) sum[k] += found[k];
}

__kernel __attribute__((reqd_work_group_size(CLIMBERS, 1, 1))) void fit_motions(
    __global const float *forward_points, const int forward_count,
    __global const ushort *forward_distance, const int forward_height, const int forward_width,
    __global const float *backward_points, const int backward_count,
    __global const ushort *backward_distance, const int backward_height, const int backward_width,
    const int n, __global const float *motions, __global const float *scales, const int rounds,
    const int iterations, const float cx, const float cy, const float reach, const float damping,
    const float settled, __global float *moved) {
  const int item = get_local_id(0), p = get_group_id(0), last = rounds * iterations;
  const float3 pivot = (float3)(cx, cy, reach);
  __local float sums[CLIMBERS][FIT_TERMS];
  __local float pose[4], all[3];
  __local int at;
  if (item == 0) {
    for (int k = 0; k < 4; k++) pose[k] = motions[k * n + p];
    all[0] = all[1] = all[2] = 0.0f;
    at = 0;
  }
  barrier(CLK_LOCAL_MEM_FENCE);
  for (int step = 0; step < last; step++) {
    const float scale = scales[at / iterations * n + p];
    const float4 there = (float4)(pose[0], pose[1], pose[2], pose[3]);
    const float4 back = (float4)(there.x, -there.y, -(there.x * there.z + there.y * there.w),
                                 there.y * there.z - there.x * there.w);
    float sum[FIT_TERMS] = {0};
    add_terms(forward_points, forward_count, forward_distance, forward_height, forward_width, there,
              scale, pivot, false, sum);
    add_terms(backward_points, backward_count, backward_distance, backward_height, backward_width,
              back, scale, pivot, true, sum);
    for (int k = 0; k < FIT_TERMS; k++) sums[item][k] = sum[k];
    barrier(CLK_LOCAL_MEM_FENCE);
    if (item == 0) {
      float h[FIT_TERMS] = {0};
      for (int i = 0; i < CLIMBERS; i++) {
        for (int k = 0; k < FIT_TERMS; k++) h[k] += sums[i][k];
      }
      /* The damped matrix as L D L^T. */
      const float damped = damping * HIGHER(h[9], 1.0f);
      const float d0 = h[0] + damped, l10 = h[1] / d0, l20 = h[2] / d0;
      const float d1 = h[3] + damped - l10 * h[1], rest = h[4] - l10 * h[2], l21 = rest / d1;
      const float d2 = h[5] + damped - l20 * h[2] - l21 * rest;
      const float y = h[7] - l10 * h[6], turned = (h[8] - l20 * h[6] - l21 * y) / d2;
      const float up = y / d1 - l21 * turned, along = h[6] / d0 - l10 * up - l20 * turned;
      const float length = (sqrt(along * along + up * up) + fabs(turned)) / scale;
      const float part = -1.0f / HIGHER(1.0f, length);
      const float dx = part * along, dy = part * up, arc = part * turned;
      const float c = cos(arc / reach), s = sin(arc / reach), x = all[0];
      all[0] = c * x - s * all[1] + dx;
      all[1] = s * x + c * all[1] + dy;
      all[2] += arc / reach;
      const float c0 = motions[p], s0 = motions[n + p];
      const float x0 = motions[2 * n + p] - cx, y0 = motions[3 * n + p] - cy;
      const float ca = cos(all[2]), sa = sin(all[2]);
      pose[0] = ca * c0 - sa * s0;
      pose[1] = sa * c0 + ca * s0;
      pose[2] = ca * x0 - sa * y0 + cx + all[0];
      pose[3] = sa * x0 + ca * y0 + cy + all[1];
      const bool still = fabs(dx) < settled && fabs(dy) < settled && fabs(arc) < settled;
      at = still ? (at / iterations + 1) * iterations : at + 1;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    if (at >= last) break;
  }
  if (item == 0) {
    for (int k = 0; k < 3; k++) moved[3 * p + k] = all[k];
  }
}

/* Points between two looks at whether a block can still be of use. */
#define POINTS_BETWEEN 16

/* Upper bounds of a lattice score over blocks of motions (branch and bound).
 * bounds[b] = sum over points of the pooled field at start + shift; -1 where that is not above
 * `least`, which is seen before all points are read.
 * blocks (count, 3) int: yaw group, row and column of the block's first shift;
 * starts (groups, 2, points) int: rows, then columns of the points' windows for shift 0;
 * field (height, width) uchar, 0 outside; bounds (count) int. Global: (count). */
__kernel void bound_blocks(__global const int *blocks, const int count,
                           __global const int *starts, const int points,
                           __global const uchar *field, const int height, const int width,
                           const int least, __global int *bounds) {
  const int b = get_global_id(0);
  if (b >= count) return;
  const int row0 = blocks[3 * b + 1], col0 = blocks[3 * b + 2];
  __global const int *rows = starts + (size_t)blocks[3 * b] * 2 * points, *cols = rows + points;
  int sum = 0;
  for (int n = 0; n < points && sum + FIELD_ONE * (points - n) > least;) {
    const int end = LOWER(n + POINTS_BETWEEN, points);
    for (; n < end; n++) {
      const int row = rows[n] + row0, col = cols[n] + col0;
      const int inside = ((uint)row < (uint)height) & ((uint)col < (uint)width);
      const int value = field[inside ? row * width + col : 0];
      sum += inside ? value : 0;
    }
  }
  bounds[b] = sum > least ? sum : -1;
}
