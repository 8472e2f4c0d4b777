/* Scoring of candidate poses: how well a scan's hits fall on the walls of a tiled map.
 *
 * The map gives each cell a wall value of 0 to 255 (the score field). A work item does one pose and
 * adds whole numbers, so that its NumPy twin finds the same sum; positions are float32 without
 * contraction, for the same reason. Loops have no branches: they turn into vector gathers.
 * Method: Olson, ICRA 2009 (score of a pose as the sum over the hits of a wall likelihood).
 */
#pragma OPENCL FP_CONTRACT OFF
#include "common.h"
#include "tiles.h"

/* Sum of the field under the hits at one pose, between cell centres bilinear in sixteenths. */
inline int smooth_sum(
    __global const uchar *field, __global const int *pages, const int width, const int height,
    __global const float2 *points, const int count, const int stride, const float4 pose) {
  int sum = 0;
  for (int i = 0; i < count; i += stride) {
    const float2 point = points[i];
    const float x = pose.x + (pose.z * point.x - pose.w * point.y) - 0.5f;
    const float y = pose.y + (pose.w * point.x + pose.z * point.y) - 0.5f;
    const int col = (int)x, row = (int)y;
    const int right = (int)((x - col) * 16.0f), up = (int)((y - row) * 16.0f);
    const int a = field[tile_cell(pages, width, height, col, row)];
    const int b = field[tile_cell(pages, width, height, col + 1, row)];
    const int c = field[tile_cell(pages, width, height, col, row + 1)];
    const int d = field[tile_cell(pages, width, height, col + 1, row + 1)];
    const int low = a * (16 - right) + b * right, high = c * (16 - right) + d * right;
    sum += (low * (16 - up) + high * up) >> 8;
  }
  return sum;
}

/* Scores of poses.
 *
 * field    uchar, TILE_CELLS per tile
 * pages    int, width x height
 * points   float2, cells, in the robot's frame
 * stride   every so many-th point counts
 * poses    float4: x, y in cells of the window, cos, sin
 * sums     int, one per pose
 */
__kernel void score_smooth(
    __global const uchar *field, __global const int *pages, const int width, const int height,
    __global const float2 *points, const int count, const int stride,
    __global const float4 *poses, const int n, __global int *sums) {
  const int item = get_global_id(0);
  if (item < n) {
    sums[item] =
        smooth_sum(field, pages, width, height, points, count, stride, poses[item]);
  }
}

/* Loss of a pose (x, y, yaw) that leaves all of some guesses: the least over the guesses of the
 * weighted squares of its distances plus the guess's own loss.
 *
 * guesses  float, seven per guess: x, y, yaw, weights of the squares of x, y and yaw, own loss */
inline float pose_loss(
    __global const float *guesses, const int count, const float x, const float y, const float yaw) {
  float least = INFINITY;
  for (int i = 0; i < count; i++) {
    __global const float *g = guesses + 7 * i;
    const float dx = x - g[0], dy = y - g[1], dyaw = yaw - g[2];
    const float loss = ((dx * dx * g[3] + dy * dy * g[4]) + dyaw * dyaw * g[5]) + g[6];
    least = loss < least ? loss : least;
  }
  return least;
}

/* Climb from some poses: each work-group takes one; in each round its items try a step each from
 * the group's best pose, and the best of them (the first of equals) is where the next round starts.
 *
 * starts   float, five per group: x, y in cells of the window, yaw, cos, sin
 * steps    float, five per round, group and item: dx, dy, dyaw, cos, sin of dyaw
 * scale    from a sum of the field to a score
 * found    float, six per group: x, y, yaw, cos, sin, score less loss
 *
 * Work-groups must have CLIMBERS items.
 */
#define CLIMBERS 16
__kernel __attribute__((reqd_work_group_size(CLIMBERS, 1, 1))) void climb(
    __global const uchar *field, __global const int *pages, const int width, const int height,
    __global const float2 *points, const int count, const int stride,
    __global const float *guesses, const int guess_count, __global const float *starts,
    __global const float *steps, const int rounds, const float scale, __global float *found) {
  const int item = get_local_id(0), group = get_group_id(0), groups = get_num_groups(0);
  __local float tried[CLIMBERS][5];
  __local float values[CLIMBERS];
  __local float best[6];
  if (item == 0) {
    for (int k = 0; k < 5; k++) {
      best[k] = starts[5 * group + k];
    }
  }
  barrier(CLK_LOCAL_MEM_FENCE);
  for (int round = 0; round < rounds; round++) {
    __global const float *step = steps + 5 * ((round * groups + group) * CLIMBERS + item);
    const float x = best[0] + step[0], y = best[1] + step[1], yaw = best[2] + step[2];
    const float cos = best[3] * step[3] - best[4] * step[4];
    const float sin = best[4] * step[3] + best[3] * step[4];
    const float4 pose = (float4)(x, y, cos, sin);
    const int sum = smooth_sum(field, pages, width, height, points, count, stride, pose);
    values[item] = (float)sum * scale - pose_loss(guesses, guess_count, x, y, yaw);
    tried[item][0] = x;
    tried[item][1] = y;
    tried[item][2] = yaw;
    tried[item][3] = cos;
    tried[item][4] = sin;
    barrier(CLK_LOCAL_MEM_FENCE);
    if (item == 0) {
      int winner = 0;
      for (int k = 1; k < CLIMBERS; k++) {
        winner = values[k] > values[winner] ? k : winner;
      }
      for (int k = 0; k < 5; k++) {
        best[k] = tried[winner][k];
      }
      best[5] = values[winner];
    }
    barrier(CLK_LOCAL_MEM_FENCE);
  }
  if (item == 0) {
    for (int k = 0; k < 6; k++) {
      found[6 * group + k] = best[k];
    }
  }
}

/* Sum of the greatest field value of five cells: the one under the hit and the four corners of a
 * square around it, `reach` cells away. A wide and cheap basin for the first look. */
__kernel void score_wide(
    __global const uchar *field, __global const int *pages, const int width, const int height,
    __global const float2 *points, const int count, const int stride,
    __global const float4 *poses, const int n, const int reach, __global int *sums) {
  const int item = get_global_id(0);
  if (item >= n) {
    return;
  }
  const float4 pose = poses[item];
  int sum = 0;
  for (int i = 0; i < count; i += stride) {
    const float2 point = points[i];
    const int col = (int)(pose.x + (pose.z * point.x - pose.w * point.y));
    const int row = (int)(pose.y + (pose.w * point.x + pose.z * point.y));
    const int a = field[tile_cell(pages, width, height, col, row)];
    const int b = field[tile_cell(pages, width, height, col - reach, row - reach)];
    const int c = field[tile_cell(pages, width, height, col + reach, row - reach)];
    const int d = field[tile_cell(pages, width, height, col - reach, row + reach)];
    const int e = field[tile_cell(pages, width, height, col + reach, row + reach)];
    const int low = b > c ? b : c, high = d > e ? d : e;
    const int corner = low > high ? low : high;
    sum += a > corner ? a : corner;
  }
  sums[item] = sum;
}
