/* Scoring of candidate poses: how well a scan's hits fall on the walls of a tiled map.
 *
 * The map gives each cell a wall value of 0 to 255 (the score field). A work item does one pose and
 * adds whole numbers, so that its NumPy twin finds the same sum; positions are float32 without
 * contraction, for the same reason. Loops over the hits have no branches and no short vectors, and
 * hits lie side by side: so they turn into vector gathers.
 * Method: Olson, ICRA 2009 (score of a pose as the sum over the hits of a wall likelihood).
 * Twin: slamfusion/compute/scan_match.py; score_smooth is score_poses, look and climb are search.
 */
#pragma OPENCL FP_CONTRACT OFF
#include "common.h"
#include "tiles.h"

/* Hits of the vectors that hold `count` hits: the host appends zeros, as a loop's last hits, less than a
 * vector, would be read one by one and take a fifth of its time. */
#define WHOLE_LANES(count) (((count) + HIT_LANES - 1) & -HIT_LANES)
/* The last item of a work-group of climb_maps that tries a step. */
#define CORNERS 14

/* Four bytes from any place, the first the lowest: one word is one gather, and one byte is none. Of
 * TWO_BYTES the higher ones are anything. */
#ifdef UNALIGNED_WORDS
#define FOUR_BYTES(cells, at) (*(__global const uint *)((cells) + (at)))
#define TWO_BYTES FOUR_BYTES
#define ONE_BYTE(cells, at) ((uchar)FOUR_BYTES(cells, at))
#else
#define ONE_BYTE(cells, at) (cells)[at]
#define TWO_BYTES(cells, at) ((uint)(cells)[at] | (uint)(cells)[(at) + 1] << 8)
#define FOUR_BYTES(cells, at) (TWO_BYTES(cells, at) | TWO_BYTES(cells, (at) + 2) << 16)
#endif

/* Value between the centres of four cells, bilinear in sixteenths. In a word of their bytes the second is
 * a step along one axis from the first, the third and the fourth are a step along the other one from
 * these; both shares are in sixteenths. */
INLINE int blended(const uint cells, const int along, const int across) {
  const uint firsts = cells & EVEN_BYTES, seconds = cells >> 8 & EVEN_BYTES;
  const uint both = firsts * (SIXTEENTHS - along) + seconds * along;
  return ((ushort)both * (SIXTEENTHS - across) + (both >> 16) * across) >> SIXTEENTHS_SHIFT;
}

/* Field of a tiled map of pairs under a hit (px, py), between cell centres; a hit beyond it reads its
 * border, which is empty. */
INLINE int smooth_value(
    __global const uchar *field, __global const int *pages, const int width, const int height,
    const float px, const float py, const float4 pose) {
  const float x = pose.x + (pose.z * px - pose.w * py) - 0.5f;
  const float y = pose.y + (pose.w * px + pose.z * py) - 0.5f;
  const int col = (int)x, row = (int)y;
  const int own_col = LOWER(HIGHER(col, 0), (width << TILE_SHIFT) - 1);
  const int own_row = LOWER(HIGHER(row, 0), (height << TILE_SHIFT) - 1);
  const int tile = pages[(own_row >> TILE_SHIFT) * width + (own_col >> TILE_SHIFT)];
  const int line = tile * TILE + (own_row & TILE_MASK);
  const uint pairs = FOUR_BYTES(field, 2 * (line * PAIRS + (own_col & TILE_MASK)));
  return blended(pairs, (int)((y - row) * (float)SIXTEENTHS), (int)((x - col) * (float)SIXTEENTHS));
}

/* Sum of a tiled map's field under the hits at one pose. */
INLINE int smooth_sum(
    __global const uchar *field, __global const int *pages, const int width, const int height,
    __global const float *points, const int count, const float4 pose) {
  int sum = 0;
  IN_LANES
  for (int i = 0; i < WHOLE_LANES(count); i++) {
    const int value =
        smooth_value(field, pages, width, height, points[2 * i], points[2 * i + 1], pose);
    sum += i < count ? value : 0;
  }
  return sum;
}

/* -- a window of one map's field, dense: a quarter of the gathers ------------------------------- */

/* Field of a window under a hit; a hit beyond it reads its border. */
INLINE int window_value(
    __global const uchar *cells, const int4 window, const float px, const float py,
    const float4 pose) {
  const float x = pose.x + (pose.z * px - pose.w * py) - 0.5f;
  const float y = pose.y + (pose.w * px + pose.z * py) - 0.5f;
  const int col = (int)x, row = (int)y;
  const int own_col = LOWER(HIGHER(col - window.x, 0), window.z - 2);
  const int own_row = LOWER(HIGHER(row - window.y, 0), window.w - 3);
  const int at = own_row * window.z + own_col;
  /* The window's last row is not looked at: only the higher bytes of its words reach it. */
  const uint low = TWO_BYTES(cells, at), high = TWO_BYTES(cells, at + window.z);
  const int right = (int)((x - col) * (float)SIXTEENTHS);
  return blended((ushort)low | high << 16, right, (int)((y - row) * (float)SIXTEENTHS));
}

INLINE int window_sum(
    __global const uchar *cells, const int4 window, __global const float *points, const int count,
    const float4 pose) {
  int sum = 0;
  IN_LANES
  for (int i = 0; i < WHOLE_LANES(count); i++) {
    const int value = window_value(cells, window, points[2 * i], points[2 * i + 1], pose);
    sum += i < count ? value : 0;
  }
  return sum;
}

/* Scores of poses: sums of what a table makes of the field under the hits.
 *
 * cells    uchar, width x height: a window whose first cell is (first_x, first_y)
 * points   float, two per hit: cells, in the robot's frame
 * poses    float4: x, y in cells of the pages, cos, sin
 * table    int, TABLE_LAST + 1
 * sums     int, one per pose
 */
__kernel void score_smooth(
    __global const uchar *cells, const int first_x, const int first_y, const int width,
    const int height, __global const float *points, const int count,
    __global const float4 *poses, const int n, __global const int *table, __global int *sums) {
  const int item = get_global_id(0);
  if (item >= n) {
    return;
  }
  const int4 window = (int4)(first_x, first_y, width, height);
  const float4 pose = poses[item];
  int sum = 0;
  IN_LANES
  for (int i = 0; i < WHOLE_LANES(count); i++) {
    const int value = window_value(cells, window, points[2 * i], points[2 * i + 1], pose);
    const int counted = table[value];
    sum += i < count ? counted : 0;
  }
  sums[item] = sum;
}

/* Loss of a pose (x, y, yaw) that leaves all of some hypotheses: the least over the hypotheses of the
 * weighted squares of its distances plus the hypothesis' own loss.
 *
 * hypotheses  float, HYPOTHESIS_FLOATS each: x, y, yaw, weights of the squares of x, y and yaw, own
 *             loss */
INLINE float pose_loss(
    __global const float *hypotheses, const int count, const float x, const float y,
    const float yaw) {
  float least = INFINITY;
  for (int i = 0; i < count; i++) {
    __global const float *g = hypotheses + HYPOTHESIS_FLOATS * i;
    const float dx = x - g[0], dy = y - g[1], dyaw = yaw - g[2];
    const float loss = ((dx * dx * g[3] + dy * dy * g[4]) + dyaw * dyaw * g[5]) + g[6];
    least = loss < least ? loss : least;
  }
  return least;
}

/* Look at poses on wide basins: a hit counts the greatest field value of five cells, the one under it and
 * the four corners of a square around it, `reach` cells away. A climb starts from the best of them.
 *
 * hypotheses  as for pose_loss
 * poses       float, START_FLOATS per pose: x, y in cells of the pages, yaw, cos, sin; the first are the
 *             hypotheses' own, which are not looked at
 * scale       from a sum of the field to a score
 * values      float, one per pose: score less loss
 */
__kernel void look(
    __global const uchar *cells, const int first_x, const int first_y, const int width,
    const int height, __global const float *points, const int count,
    __global const float *hypotheses, const int hypothesis_count, __global const float *poses,
    const int n, const int reach, const float scale, __global float *values) {
  const int item = get_global_id(0);
  if (item >= n) {
    return;
  }
  __global const float *own = poses + START_FLOATS * (hypothesis_count + item);
  const float4 pose = (float4)(own[0], own[1], own[3], own[4]);
  const int last_x = width - 1, last_y = height - 2;
  int sum = 0;
  IN_LANES
  for (int i = 0; i < WHOLE_LANES(count); i++) {
    const float px = points[2 * i], py = points[2 * i + 1];
    const int col = (int)(pose.x + (pose.z * px - pose.w * py)) - first_x;
    const int row = (int)(pose.y + (pose.w * px + pose.z * py)) - first_y;
    const int x = LOWER(HIGHER(col, 0), last_x), y = LOWER(HIGHER(row, 0), last_y) * width;
    const int left = LOWER(HIGHER(col - reach, 0), last_x);
    const int right = LOWER(HIGHER(col + reach, 0), last_x);
    const int below = LOWER(HIGHER(row - reach, 0), last_y) * width;
    const int above = LOWER(HIGHER(row + reach, 0), last_y) * width;
    const int a = ONE_BYTE(cells, y + x);
    const int b = ONE_BYTE(cells, below + left), c = ONE_BYTE(cells, below + right);
    const int d = ONE_BYTE(cells, above + left), e = ONE_BYTE(cells, above + right);
    const int low = b > c ? b : c, high = d > e ? d : e;
    const int corner = low > high ? low : high;
    sum += i < count ? (a > corner ? a : corner) : 0;
  }
  values[item] =
      (float)sum * scale - pose_loss(hypotheses, hypothesis_count, own[0], own[1], own[2]);
}

/* The pose of a rank by value, from 0, the first of equals ahead. */
INLINE int ranked(__global const float *values, const int n, const int rank) {
  int found = -1;
  float last = INFINITY;
  for (int k = 0; k <= rank; k++) {
    int best = -1;
    for (int i = 0; i < n; i++) {
      const int is_left = values[i] < last || (values[i] == last && i > found);
      best = is_left && (best < 0 || values[i] > values[best]) ? i : best;
    }
    found = best;
    last = values[best];
  }
  return found;
}

/* Climb over a window from the best of the poses that `look` has seen, and then from the hypotheses' own:
 * each work-group takes one; in each round its items try a step each from the group's best pose, and the
 * best of them (the first of equals) is where the next round starts.
 *
 * poses    as for `look`
 * values   of `look`, of n poses
 * steps    float, START_FLOATS per round, group and item: dx, dy, dyaw, cos, sin of dyaw
 * scale    from a sum of the field to a score
 * found    float, FOUND_FLOATS per group: x, y, yaw, cos, sin, score less loss
 *
 * Work-groups must have CLIMBERS items.
 */
__kernel __attribute__((reqd_work_group_size(CLIMBERS, 1, 1))) void climb(
    __global const uchar *cells, const int first_x, const int first_y, const int width,
    const int height, __global const float *points, const int count,
    __global const float *hypotheses, const int hypothesis_count, __global const float *poses,
    __global const float *values, const int n, __global const float *steps, const int rounds,
    const float scale, __global float *found) {
  const int item = get_local_id(0), group = get_group_id(0), groups = get_num_groups(0);
  const int4 window = (int4)(first_x, first_y, width, height);
  __local float tried[CLIMBERS][START_FLOATS];
  __local float told[CLIMBERS];
  __local float best[FOUND_FLOATS];
  if (item == 0) {
    const int looked = groups - hypothesis_count;
    const int start =
        group < looked ? hypothesis_count + ranked(values, n, group) : group - looked;
    for (int k = 0; k < START_FLOATS; k++) {
      best[k] = poses[START_FLOATS * start + k];
    }
  }
  barrier(CLK_LOCAL_MEM_FENCE);
  for (int round = 0; round < rounds; round++) {
    const int number = (round * groups + group) * CLIMBERS + item;
    __global const float *step = steps + START_FLOATS * number;
    const float x = best[0] + step[0], y = best[1] + step[1], yaw = best[2] + step[2];
    const float cos = best[3] * step[3] - best[4] * step[4];
    const float sin = best[4] * step[3] + best[3] * step[4];
    const float4 pose = (float4)(x, y, cos, sin);
    const int sum = window_sum(cells, window, points, count, pose);
    told[item] = (float)sum * scale - pose_loss(hypotheses, hypothesis_count, x, y, yaw);
    tried[item][0] = x;
    tried[item][1] = y;
    tried[item][2] = yaw;
    tried[item][3] = cos;
    tried[item][4] = sin;
    barrier(CLK_LOCAL_MEM_FENCE);
    if (item == 0) {
      int winner = 0;
      for (int k = 1; k < CLIMBERS; k++) {
        winner = told[k] > told[winner] ? k : winner;
      }
      for (int k = 0; k < START_FLOATS; k++) {
        best[k] = tried[winner][k];
      }
      best[START_FLOATS] = told[winner];
    }
    barrier(CLK_LOCAL_MEM_FENCE);
  }
  if (item == 0) {
    for (int k = 0; k < FOUND_FLOATS; k++) {
      found[FOUND_FLOATS * group + k] = best[k];
    }
  }
}

/* Climb on many maps at once, one work-group a map: its items try a step each along the axes and the
 * diagonals of (x, y, yaw) from the best pose; the best of them is where the next try starts, and
 * where none is better the step goes on to the next of its sizes.
 *
 * pages    int, width x height per map
 * hypotheses  float, HYPOTHESIS_FLOATS per map, as for pose_loss
 * starts   float, START_FLOATS per map: x, y in cells of the window, yaw, cos, sin
 * sizes    float, SIZE_FLOATS per size: cells, radians, cos and sin of them
 * tries    tries in all, at most
 * found    float, FOUND_FLOATS per map: x, y, yaw, cos, sin, score less loss
 *
 * Work-groups must have CLIMBERS items.
 */
__kernel __attribute__((reqd_work_group_size(CLIMBERS, 1, 1))) void climb_maps(
    __global const uchar *field, __global const int *pages, const int width, const int height,
    __global const float *points, const int count,
    __global const float *hypotheses, __global const float *starts, __global const float *sizes,
    const int size_count, const int tries, const float scale, __global float *found) {
  const int item = get_local_id(0), group = get_group_id(0);
  /* Item 0 stays, where the value is known after the first try; 1 to 6 follow an axis, 7 to CORNERS a
   * diagonal of the cube, and the last one has no work. */
  const int axis = (item - 1) >> 1, sign = (item & 1) ? 1 : -1, corner = item - 7;
  const int is_axis = item >= 1 && item <= 6, is_corner = item >= 7 && item <= CORNERS;
  const int along_x = is_axis ? (axis == 0 ? sign : 0) : is_corner ? ((corner & 1) ? 1 : -1) : 0;
  const int along_y = is_axis ? (axis == 1 ? sign : 0) : is_corner ? ((corner & 2) ? 1 : -1) : 0;
  const int turn = is_axis ? (axis == 2 ? sign : 0) : is_corner ? ((corner & 4) ? 1 : -1) : 0;
  __global const int *own = pages + group * width * height;
  __global const float *hypothesis = hypotheses + HYPOTHESIS_FLOATS * group;
  __local float tried[CLIMBERS][START_FLOATS];
  __local float values[CLIMBERS];
  __local float best[FOUND_FLOATS];
  __local int at;
  if (item == 0) {
    for (int k = 0; k < START_FLOATS; k++) {
      best[k] = starts[START_FLOATS * group + k];
    }
    at = 0;
  }
  barrier(CLK_LOCAL_MEM_FENCE);
  for (int round = 0; round < tries; round++) {
    const int size = at;
    __global const float *step = sizes + SIZE_FLOATS * size;
    const float x = best[0] + along_x * step[0], y = best[1] + along_y * step[0];
    const float yaw = best[2] + turn * step[1];
    const float dcos = turn == 0 ? 1.0f : step[2], dsin = turn * step[3];
    const float cos = best[3] * dcos - best[4] * dsin;
    const float sin = best[4] * dcos + best[3] * dsin;
    const float4 pose = (float4)(x, y, cos, sin);
    if (item == 0 && round > 0) {
      values[item] = best[START_FLOATS];
    } else if (item <= CORNERS) {
      const int sum = smooth_sum(field, own, width, height, points, count, pose);
      values[item] = (float)sum * scale - pose_loss(hypothesis, 1, x, y, yaw);
    }
    tried[item][0] = x;
    tried[item][1] = y;
    tried[item][2] = yaw;
    tried[item][3] = cos;
    tried[item][4] = sin;
    barrier(CLK_LOCAL_MEM_FENCE);
    if (item == 0) {
      int winner = 0;
      for (int k = 1; k <= CORNERS; k++) {
        winner = values[k] > values[winner] ? k : winner;
      }
      for (int k = 0; k < START_FLOATS; k++) {
        best[k] = tried[winner][k];
      }
      best[START_FLOATS] = values[winner];
      at = winner == 0 ? size + 1 : size;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    if (at >= size_count) {
      break;
    }
  }
  if (item == 0) {
    for (int k = 0; k < FOUND_FLOATS; k++) {
      found[FOUND_FLOATS * group + k] = best[k];
    }
  }
}

/* Sums over the hits of what a table makes of the field, for some poses on each of many maps.
 *
 * poses    float4, each per map
 * table    int, TABLE_LAST + 1
 * sums     int, each per map
 */
__kernel void score_maps(
    __global const uchar *field, __global const int *pages, const int width, const int height,
    __global const float *points, const int count,
    __global const float4 *poses, const int maps, const int each, __global const int *table,
    __global int *sums) {
  const int item = get_global_id(0);
  if (item >= maps * each) {
    return;
  }
  __global const int *own = pages + (item / each) * width * height;
  const float4 pose = poses[item];
  int sum = 0;
  IN_LANES
  for (int i = 0; i < WHOLE_LANES(count); i++) {
    const int value =
        smooth_value(field, own, width, height, points[2 * i], points[2 * i + 1], pose);
    const int counted = table[value];
    sum += i < count ? counted : 0;
  }
  sums[item] = sum;
}
