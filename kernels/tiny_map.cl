/* Map update of tinySLAM [H16]: beams write what they saw, cells join it to what they know.
 *
 * Method: Steux and El Hamzaoui, ICARCV 2010 (a beam leaves a valley around its hit), with the cell
 * models of Huletski, Kartashov and Krinkin, 2016. A scan is one observation of a cell, however many
 * of its beams cross it: first every beam marks its cells, the strongest word about a cell wins
 * (atomic maximum, so the order does not matter), then whoever comes first folds that word into the
 * cell and clears it. So the result does not depend on the device's schedule,
 * and between two scans every word of the `observed` pool is 0.
 *
 * A word of the `observed` pool: hit (1 bit), value (12), in front of the hit (1).
 * A cell's state: mean value in 1/2^20 (20 bits), observations (12 bits).
 */
#include "common.h"
#include "tiles.h"
#include "walk.h"

#define HALF (1 << 19)
#define MOST_OBSERVATIONS 4095
#define MODEL_BASE 0

/* A beam: x, y of its hit and of the laser in 1/1024 cell, length likewise, value of a hit. */
INLINE walk beam_walk(__global const int *beam) {
  return walk_of(beam[0], beam[1], beam[2], beam[3]);
}

/* Length of a step of the beam's walk in 1/2^20 cell. */
INLINE long beam_step(__global const int *beam, const walk w) {
  return (long)beam[4] * (1 << 20) / w.longest;
}

/* Mark the cells of each beam.
 *
 * observed   uint pool
 * pages      int, width x height
 * beams      six ints per beam, see above; the last is the value at the ridge of the valley, 0 to 4095
 * half_blur  half width of the valley, 1/1024 cell
 * behind     least value that is written behind the hit
 * free       value of a cell that the beam passed, 0 to 4095
 * wanted     int: [0] whether a page was missing, [1 + page] which
 */
__kernel void tiny_mark(
    __global uint *observed, __global const int *pages, const int width, const int height,
    __global const int *beams, const int count, const int half_blur,
    const int behind, const int free, __global int *wanted) {
  const int item = get_global_id(0);
  if (item >= count) {
    return;
  }
  __global const int *beam = beams + 6 * item;
  const int rise = beam[5] > free ? beam[5] - free : 0;
  const walk w = beam_walk(beam);
  const long step = beam_step(beam, w);
  const long reach = step > 0 ? ((long)half_blur << 10) / step : 0;
  for (long i = -reach; i <= w.steps; i++) {
    const long away = ((i < 0 ? -i : i) * step) >> 10;
    int value = free;
    if (away < half_blur) {
      value = free + (int)(rise * (half_blur - away) / half_blur);
    }
    if (i < 0 && value < behind) {
      continue;
    }
    if (i == 0) {
      value = beam[5];
    }
    const int x = (int)((w.x + i * w.step_x) >> 20), y = (int)((w.y + i * w.step_y) >> 20);
    const uint word = (uint)((i == 0) << 13 | value << 1 | (i >= 0));
    mark_cell(observed, pages, width, wanted, x, y, word);
  }
}

/* Join an observation (0 to 4095) to a cell's state. */
INLINE uint joined(const uint state, const int value, const int quality, const int model) {
  const int mean = (int)(state >> 12), seen = (int)(state & MOST_OBSERVATIONS);
  const int told = value << 8;
  int next;
  if (model == MODEL_BASE) {
    next = mean + (int)(((long)(told - mean) * quality) >> 10);
  } else {
    const int pulled = HALF + (int)(((long)(told - HALF) * quality) >> 10);
    next = mean + (pulled - mean) / (seen + 1);
  }
  const int more = seen < MOST_OBSERVATIONS ? seen + 1 : seen;
  return (uint)next << 12 | (uint)more;
}

/* Fold what the scan marked into the cells.
 *
 * valley     uint pool of states: what the matcher sees, with the blur
 * map        uint pool of states: what is published; cells behind a hit learn nothing here
 * field      uchar pool: the score field of scan_match.cl, 0 where the valley is no wall
 * map_free   value of a free cell in `map`, 0 to 4095
 * quality    in 1/1024: 0 teaches nothing, 1024 everything
 * model      0 base, 1 mean
 * wall_floor mean up to which the score field is 0, 1/2^20
 * wall_gain  what a mean above it adds to the field
 */
__kernel void tiny_fold(
    __global uint *observed, __global uint *valley, __global uint *map, __global uchar *field,
    __global const int *pages, const int width, const int height, __global const int *beams,
    const int count, const int half_blur, const int map_free, const int quality, const int model,
    const int wall_floor, const int wall_gain) {
  const int item = get_global_id(0);
  if (item >= count) {
    return;
  }
  __global const int *beam = beams + 6 * item;
  const walk w = beam_walk(beam);
  const long step = beam_step(beam, w);
  const long reach = step > 0 ? ((long)half_blur << 10) / step : 0;
  for (long i = -reach; i <= w.steps; i++) {
    const int x = (int)((w.x + i * w.step_x) >> 20), y = (int)((w.y + i * w.step_y) >> 20);
    const int tile = pages[(y >> TILE_SHIFT) * width + (x >> TILE_SHIFT)];
    const int at = tile * TILE_CELLS + ((y & TILE_MASK) << TILE_SHIFT) + (x & TILE_MASK);
    const uint word = take_word(observed + at);
    if (word == 0u) {
      continue;
    }
    const int value = (int)(word >> 1 & 4095);
    const uint next = joined(valley[at], value, quality, model);
    const int wall = ((int)(next >> 12) - wall_floor) * wall_gain >> 20;
    valley[at] = next;
    field[at] = (uchar)(wall < 0 ? 0 : wall > 255 ? 255 : wall);
    if (word & 1u) {
      map[at] = joined(map[at], word >> 13 ? value : map_free, quality, model);
    }
  }
}
