/* Score rigid motions: all shifts at once, given poses one by one, and the normal equations that
 * refine a pose below a cell.
 *
 * Twins: reference.correlate, reference.tile_peaks, reference.pose_counts (exact),
 * reference.refine_terms (float32, within 1e-3 of the sums).
 */
#include "common.h"

/* scores[k, i, j] = sum over points n of fields[k, offset(k, n) + i * field_width + j].
 * Field values are 0..15, so sixteen of them add in one byte lane without a carry.
 * fields: uchar planes, field_stride bytes from one k to the next (0: one plane for all);
 * offsets (count or 1, points) int: row * field_width + col of each point, offset_stride ints apart;
 * scores (count, shift_height, shift_width) int, shift_width a multiple of 32.
 * Global: (shift_width / 32, (shift_height + 1) / 2, count). */
__kernel void correlate(__global const uchar *fields, const int field_stride, const int field_width,
                        __global const int *offsets, const int offset_stride, const int points,
                        const int shift_height, const int shift_width, const int count,
                        __global int *scores) {
  const int j = get_global_id(0) * 32, i = get_global_id(1) * 2, k = get_global_id(2);
  if (j >= shift_width || i >= shift_height || k >= count) return;
  const int second = i + 1 < shift_height ? field_width : 0;
  __global const uchar *field = fields + (size_t)k * field_stride + (size_t)i * field_width + j;
  __global const int *offset = offsets + (size_t)k * offset_stride;
  int16 total0 = 0, total1 = 0, total2 = 0, total3 = 0;
  for (int start = 0; start < points; start += 16) {
    ulong4 low = 0, high = 0;
    const int stop = min(start + 16, points);
    for (int n = start; n < stop; n++) {
      __global const uchar *p = field + offset[n];
      low += LOAD32(p);
      high += LOAD32(p + second);
    }
    total0 += convert_int16(as_uchar16(low.lo));
    total1 += convert_int16(as_uchar16(low.hi));
    total2 += convert_int16(as_uchar16(high.lo));
    total3 += convert_int16(as_uchar16(high.hi));
  }
  __global int *out = scores + ((size_t)k * shift_height + i) * shift_width + j;
  STORE32(as_ulong4(total0.lo), out);
  STORE32(as_ulong4(total0.hi), out + 8);
  STORE32(as_ulong4(total1.lo), out + 16);
  STORE32(as_ulong4(total1.hi), out + 24);
  if (second) {
    out += shift_width;
    STORE32(as_ulong4(total2.lo), out);
    STORE32(as_ulong4(total2.hi), out + 8);
    STORE32(as_ulong4(total3.lo), out + 16);
    STORE32(as_ulong4(total3.hi), out + 24);
  }
}

/* Sum of a forward and a backward score surface, and the best of each tile x tile block of shifts.
 * forward (count, height, stride) int; backward the same, read at (height - 1 - i, width - 1 - j);
 * only columns below width count. values, places (count, tiles_y, tiles_x) int; a place is
 * i * width + j; the first of equal scores wins. Global: (tiles_x, tiles_y, count). */
__kernel void tile_peaks(__global const int *forward, __global const int *backward,
                         const int height, const int width, const int stride, const int count,
                         const int tile, const int tiles_y, const int tiles_x,
                         __global int *values, __global int *places) {
  const int tx = get_global_id(0), ty = get_global_id(1), k = get_global_id(2);
  if (tx >= tiles_x || ty >= tiles_y || k >= count) return;
  __global const int *f = forward + (size_t)k * height * stride;
  __global const int *b = backward + (size_t)k * height * stride;
  int best = INT_MIN, place = 0;
  for (int i = ty * tile; i < min((ty + 1) * tile, height); i++)
    for (int j = tx * tile; j < min((tx + 1) * tile, width); j++) {
      const int value = f[i * stride + j] + b[(height - 1 - i) * stride + (width - 1 - j)];
      if (value > best) {
        best = value;
        place = i * width + j;
      }
    }
  const int out = (k * tiles_y + ty) * tiles_x + tx;
  values[out] = best;
  places[out] = place;
}

/* What the points meet under each pose, summed over chunks of points:
 * partial[p, chunk] = (score, points within near2, points in free space beyond far2, points on the
 * field). Points off the field score `base`.
 * points (count, 2) int lattice positions; poses (n, 4) long Q30, points to field;
 * field, free_cell (height, width) uchar (free_cell 1 where free); distance2 (height, width) ushort;
 * partial (n, chunks, 4) int. Global: (chunks, n). */
__kernel void pose_counts(__global const int *points, const int count, __global const long *poses,
                          const int n, __global const uchar *field,
                          __global const ushort *distance2, __global const uchar *free_cell,
                          const int height, const int width, const int base, const int near2,
                          const int far2, const int chunk, const int chunks,
                          __global int *partial) {
  const int c = get_global_id(0), p = get_global_id(1);
  if (c >= chunks || p >= n) return;
  const long4 pose = vload4(p, poses);
  int4 sum = 0;
  for (int i = c * chunk; i < min((c + 1) * chunk, count); i++) {
    const int2 cell = fixed_cell(pose, points[2 * i], points[2 * i + 1]);
    if (cell.x < 0 || cell.y < 0 || cell.x >= width || cell.y >= height) {
      sum.x += base;
      continue;
    }
    const size_t at = (size_t)cell.y * width + cell.x;
    const int d2 = distance2[at];
    sum += (int4)(field[at], d2 <= near2, free_cell[at] && d2 > far2, 1);
  }
  vstore4(sum, p * chunks + c, partial);
}

/* Normal equations of a robust point-to-wall fit under a small motion (dx, dy, dyaw) of the
 * reference frame, applied after the pose, about the centre (cx, cy).
 *
 * Residual: the distance d at the mapped point, bilinear over cell centres, from a field in 1/256
 * cell. Weight: Geman-McClure,
 * 1 / (1 + (d / scale)^2)^2. Forward: points of the moving grid on the reference's field; the gradient is
 * used as it is, the arm is the mapped point. Backward: points of the reference on the moving field;
 * the gradient turns into the reference frame and changes sign, the arm is the point itself.
 * partial[p, chunk] = 10 floats: Hxx Hxy Hxt Hyy Hyt Htt, gx gy gt, sum of weights.
 * points (count, 2) float cells; poses (n, 4) float cos, sin, tx, ty in cells, points to field;
 * distance (height, width) ushort, 1/256 cell. Global: (chunks, n). */
__kernel void refine_terms(__global const float *points, const int count,
                           __global const float *poses, const int n,
                           __global const ushort *distance, const int height, const int width,
                           const float scale, const float cx, const float cy, const int backward,
                           const int chunk, const int chunks, __global float *partial) {
  const int c = get_global_id(0), p = get_global_id(1);
  if (c >= chunks || p >= n) return;
  const float cosine = poses[4 * p], sine = poses[4 * p + 1];
  const float tx = poses[4 * p + 2], ty = poses[4 * p + 3];
  float sum[10];
  for (int i = 0; i < 10; i++) sum[i] = 0.0f;
  for (int i = c * chunk; i < min((c + 1) * chunk, count); i++) {
    const float px = points[2 * i], py = points[2 * i + 1];
    const float qx = cosine * px - sine * py + tx, qy = sine * px + cosine * py + ty;
    if (!(qx >= 0.5f && qy >= 0.5f && qx < width && qy < height)) continue;
    const int col = (int)(qx - 0.5f), row = (int)(qy - 0.5f);
    if (col + 1 >= width || row + 1 >= height) continue;
    const float u = qx - 0.5f - col, v = qy - 0.5f - row;
    __global const ushort *at = distance + (size_t)row * width + col;
    const float d00 = at[0] * (1.0f / 256), d01 = at[1] * (1.0f / 256);
    const float d10 = at[width] * (1.0f / 256), d11 = at[width + 1] * (1.0f / 256);
    const float d = (1 - v) * ((1 - u) * d00 + u * d01) + v * ((1 - u) * d10 + u * d11);
    float gx = (1 - v) * (d01 - d00) + v * (d11 - d10);
    float gy = (1 - u) * (d10 - d00) + u * (d11 - d01);
    const float root = 1.0f + (d * d) / (scale * scale);
    const float weight = 1.0f / (root * root);
    float ax = qx - cx, ay = qy - cy;
    if (backward) {
      const float hx = -(cosine * gx + sine * gy), hy = -(cosine * gy - sine * gx);
      gx = hx;
      gy = hy;
      ax = px - cx;
      ay = py - cy;
    }
    const float gt = gy * ax - gx * ay;
    sum[0] += weight * gx * gx;
    sum[1] += weight * gx * gy;
    sum[2] += weight * gx * gt;
    sum[3] += weight * gy * gy;
    sum[4] += weight * gy * gt;
    sum[5] += weight * gt * gt;
    sum[6] += weight * gx * d;
    sum[7] += weight * gy * d;
    sum[8] += weight * gt * d;
    sum[9] += weight;
  }
  for (int i = 0; i < 10; i++) partial[(p * chunks + c) * 10 + i] = sum[i];
}
