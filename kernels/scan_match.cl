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

/* Sum of the field under the hits, between cell centres bilinear in sixteenths.
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
  if (item >= n) {
    return;
  }
  const float4 pose = poses[item];
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
  sums[item] = sum;
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
