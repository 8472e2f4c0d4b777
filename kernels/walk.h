/* The cells of a beam, shared by the map updates of the SLAMs. */
#ifndef SLAMFUSION_WALK_H
#define SLAMFUSION_WALK_H

/* A walk from a beam's end: x, y of the end and of one step in 1/2^20 cell, the length along the
 * longer axis in 1/1024 cell (at least 1), and how many steps lead to the laser. */
typedef struct {
  long x, y, step_x, step_y, longest, steps;
} walk;

/* Steps of one cell along the longer axis, from a beam's end to the laser, both in 1/1024 cell. */
INLINE walk walk_of(const int end_x, const int end_y, const int laser_x, const int laser_y) {
  const int dx = laser_x - end_x, dy = laser_y - end_y;
  const int wide = dx < 0 ? -dx : dx, high = dy < 0 ? -dy : dy;
  const int longest = wide > high ? wide : high;
  walk w;
  w.longest = longest > 0 ? longest : 1;
  w.x = (long)end_x << WALK_TO_BEAM_SHIFT;
  w.y = (long)end_y << WALK_TO_BEAM_SHIFT;
  w.step_x = (long)wide * (1 << WALK_SHIFT) / w.longest * (dx < 0 ? -1 : 1);
  w.step_y = (long)high * (1 << WALK_SHIFT) / w.longest * (dy < 0 ? -1 : 1);
  w.steps = w.longest >> BEAM_SHIFT;
  return w;
}

#endif
