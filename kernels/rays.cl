/* Cast rays through a grid: cell by cell along each ray, none left out, none stepped over.
 *
 * Source: Amanatides and Woo, A fast voxel traversal algorithm for ray tracing, Eurographics 1987.
 * Unlike there the distance to the next edge is computed at each step and not added up, so
 * that it does not drift and equals the twin's bit for bit.
 * Twin: slamfusion/compute/rays.py; exact.
 */
#include "common.h"

/* hits[n] = distance to the first thing on ray n, its class, the cosine between the ray and the
 * normal of the cell edge it was met at, and the distance to the first wall, any glass passed.
 * Distances are in cells, INFINITY where nothing is within reach; off the grid is open.
 * cells (height, width) uchar: OPEN, WALL or GLASS;
 * rays (count, RAY_FLOATS) float: x, y in cells, cos, sin, 1 / cos, 1 / sin (INFINITY for a cosine
 * of 0);
 * hits (count, RAY_HIT_FLOATS) float. Global: (count). */
__kernel void cast_rays(__global const uchar *cells, const int height, const int width,
                        __global const float *rays, const int count, const float reach,
                        __global float *hits) {
  const int n = get_global_id(0);
  if (n >= count) return;
  __global const float *ray = rays + RAY_FLOATS * n;
  const float x = ray[0], y = ray[1], cosine = ray[2], sine = ray[3];
  const float per_x = ray[4], per_y = ray[5];
  const int step_x = (cosine > 0.0f) - (cosine < 0.0f), step_y = (sine > 0.0f) - (sine < 0.0f);
  const int ahead_x = step_x > 0, ahead_y = step_y > 0;
  const float face_x = step_x < 0 ? -cosine : cosine, face_y = step_y < 0 ? -sine : sine;
  int col = (int)x, row = (int)y;
  col -= x < (float)col;
  row -= y < (float)row;
  float edge_x = step_x ? ((float)(col + ahead_x) - x) * per_x : INFINITY;
  float edge_y = step_y ? ((float)(row + ahead_y) - y) * per_y : INFINITY;

  float t = 0.0f, face = 1.0f, first = INFINITY, first_face = 0.0f, behind = INFINITY;
  int met = OPEN;
  while (t <= reach) {
    if (col >= 0 && row >= 0 && col < width && row < height) {
      const int class = cells[(size_t)row * width + col];
      if (class != OPEN && met == OPEN) {
        met = class;
        first = t;
        first_face = face;
      }
      if (class == WALL) {
        behind = t;
        break;
      }
    } else if ((step_x <= 0 && col < 0) || (step_x >= 0 && col >= width) ||
               (step_y <= 0 && row < 0) || (step_y >= 0 && row >= height)) {
      break;
    }
    /* Through a corner the ray goes sideways first. */
    if (edge_x <= edge_y) {
      t = edge_x;
      face = face_x;
      col += step_x;
      edge_x = step_x ? ((float)(col + ahead_x) - x) * per_x : INFINITY;
    } else {
      t = edge_y;
      face = face_y;
      row += step_y;
      edge_y = step_y ? ((float)(row + ahead_y) - y) * per_y : INFINITY;
    }
  }
  __global float *hit = hits + RAY_HIT_FLOATS * n;
  hit[0] = first;
  hit[1] = (float)met;
  hit[2] = first_face;
  hit[3] = behind;
}
