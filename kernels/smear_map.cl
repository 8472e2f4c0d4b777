/* Map update of the graph SLAM's submaps: each cell averages how near the scans' hits came to it.
 *
 * A scan tells a cell one thing: how near its nearest hit lies (a wall likelihood as in Olson, ICRA
 * 2009), or that a beam passed and nothing was near. First every beam marks the cells on its way and
 * around its hit, the strongest word about a cell wins (atomic maximum, so the order does not
 * matter); then whoever comes first folds the word into the cell's mean and clears it. So walls that
 * were seen often are as sharp as the scans agree, and do not grow.
 *
 * A word of the `observed` pool: value 0 to 255 above 1 bit that says that there is one.
 * A cell's state: mean in 1/2^20 of 255 (20 bits), observations (12 bits). Twin: slam_reference.
 */
#include "common.h"
#include "tiles.h"
#include "walk.h"

/* Mark the cells of each beam.
 *
 * observed  uint pool
 * pages     int, width x height; every cell within `reach` of a beam lies in the window
 * beams     four ints per beam: x, y of its hit and of the laser, 1/1024 cell
 * table     uchar, 256: value by the squared distance from a cell's centre to the hit, in
 *           (1/1024 cell)^2, shifted right by `shift`; the last for all beyond
 * reach     cells around the hit's own that learn of it
 * wanted    int: [0] whether a page was missing, [1 + page] which
 */
__kernel void smear_mark(
    __global uint *observed, __global const int *pages, const int width, const int height,
    __global const int *beams, const int count, __global const uchar *table, const int shift,
    const int reach, __global int *wanted) {
  const int item = get_global_id(0);
  if (item >= count) {
    return;
  }
  __global const int *beam = beams + 4 * item;
  const walk w = walk_of(beam[0], beam[1], beam[2], beam[3]);
  for (long i = 1; i <= w.steps; i++) {
    const int x = (int)((w.x + i * w.step_x) >> 20), y = (int)((w.y + i * w.step_y) >> 20);
    mark_cell(observed, pages, width, wanted, x, y, 1u);
  }
  const int col = beam[0] >> 10, row = beam[1] >> 10;
  for (int y = row - reach; y <= row + reach; y++) {
    for (int x = col - reach; x <= col + reach; x++) {
      const long dx = beam[0] - (x << 10) - 512, dy = beam[1] - (y << 10) - 512;
      const long step = (dx * dx + dy * dy) >> shift;
      const uint value = table[step < 255 ? step : 255];
      mark_cell(observed, pages, width, wanted, x, y, value << 1 | 1u);
    }
  }
}

INLINE void fold_cell(
    __global uint *observed, __global uint *states, __global uchar *field,
    __global const int *pages, const int width, const int x, const int y, const int most) {
  const int tile = pages[(y >> TILE_SHIFT) * width + (x >> TILE_SHIFT)];
  const int at = tile * TILE_CELLS + ((y & TILE_MASK) << TILE_SHIFT) + (x & TILE_MASK);
  const uint word = take_word(observed + at);
  if (word == 0u) {
    return;
  }
  const uint state = states[at];
  const int mean = (int)(state >> 12), seen = (int)(state & 4095u);
  const int more = seen < most ? seen + 1 : most;
  const int next = mean + ((int)(word >> 1) * 4112 - mean) / more;
  states[at] = (uint)next << 12 | (uint)more;
  field[at] = (uchar)(next / 4112);
}

/* Fold what the scan marked into the cells.
 *
 * states  uint pool, see above
 * field   uchar pool: the score field of scan_match.cl, the mean itself
 * most    observations that a cell remembers, 1 to 4095: its mean forgets what is older
 */
__kernel void smear_fold(
    __global uint *observed, __global uint *states, __global uchar *field,
    __global const int *pages, const int width, const int height, __global const int *beams,
    const int count, const int reach, const int most) {
  const int item = get_global_id(0);
  if (item >= count) {
    return;
  }
  __global const int *beam = beams + 4 * item;
  const walk w = walk_of(beam[0], beam[1], beam[2], beam[3]);
  for (long i = 1; i <= w.steps; i++) {
    const int x = (int)((w.x + i * w.step_x) >> 20), y = (int)((w.y + i * w.step_y) >> 20);
    fold_cell(observed, states, field, pages, width, x, y, most);
  }
  const int col = beam[0] >> 10, row = beam[1] >> 10;
  for (int y = row - reach; y <= row + reach; y++) {
    for (int x = col - reach; x <= col + reach; x++) {
      fold_cell(observed, states, field, pages, width, x, y, most);
    }
  }
}
