/* Map updates of SLAMs whose cells keep a mean of what scans told them.
 *
 * A scan is one observation of a cell, however many of its beams cross it: first every beam marks its
 * cells, the strongest word about a cell wins (atomic maximum, so the order does not matter), then the
 * words of the pages that were met are integrated into their cells and cleared. So the result does not
 * depend on the device's schedule, and between two scans every word of the `observed` pool is 0.
 *
 * tinySLAM [H16] (mark_scan, integrate_scan): Steux and El Hamzaoui, ICARCV 2010 (a beam leaves a
 * valley around its hit), with the cell models of Huletski, Kartashov and Krinkin, 2016.
 * The graph's submaps (mark_likelihood, update_likelihood): each cell averages how near the scans'
 * hits came to it (a wall likelihood as in Olson, ICRA 2009). A scan tells a cell how near its nearest
 * hit lies, or that a beam passed and nothing was near. So walls that were seen often are as sharp as
 * the scans agree, and do not grow.
 *
 * Words of the `observed` pools and the state of a cell: slamfusion/compute/layout.py.
 * Twin: slamfusion/compute/cell_means.py, by the same names; exact.
 */
#include "common.h"
#include "tiles.h"
#include "walk.h"

/* The cell models of `joined`; any other number is the mean. */
#define MODEL_BASE 0

/* The pages that a scan may have met, and the dense copy that follows the field; see integrate_scan. */
#define MET                                                                                        \
  __global const int *pages, const int width, __global int *met, const int left,                  \
      const int bottom, const int cols, const int rows, __global uchar *restrict cells,            \
      const int seen_left, const int seen_bottom, const int seen_cols, const int seen_rows
/* Of a work item: its page's column and row, its tile (0: not met), and whether the copy has it. */
#define MET_PAGE                                                                                   \
  const int item = get_global_id(0), x = left + item % cols, y = bottom + item / cols;             \
  const int tile = item < cols * rows ? met_tile(pages, met, y * width + x) : 0;                   \
  const int seen_x = x - seen_left, seen_y = y - seen_bottom;                                      \
  const int is_seen = seen_x >= 0 && seen_y >= 0 && seen_x < seen_cols && seen_y < seen_rows;      \
  if (tile == 0) {                                                                                 \
    return;                                                                                        \
  }

/* -- tinySLAM ----------------------------------------------------------------------------------- */

/* Mark the cells of each beam.
 *
 * observed   uint pool
 * pages      int, width x height
 * beams      VALLEY_BEAM_INTS ints per beam: x, y of its hit and of the laser in 1/1024 cell, length
 *            likewise, value at the ridge of the valley, 0 to VALUE_ONE
 * half_blur  half width of the valley, 1/1024 cell, at most 2^19
 * behind     least value that is written behind the hit
 * free       value of a cell that the beam passed, 0 to VALUE_ONE
 * met        int for each page, set to 1 where the beam has cells
 * missed     uchar for each beam: whether it met a page without a tile
 */
__kernel void mark_scan(
    __global uint *observed, __global const int *pages, const int width, const int height,
    __global const int *beams, const int count, const int half_blur,
    const int behind, const int free, __global int *met, __global uchar *missed) {
  const int item = get_global_id(0);
  if (item >= count) {
    return;
  }
  __global const int *beam = beams + VALLEY_BEAM_INTS * item;
  const int rise = beam[5] > free ? beam[5] - free : 0;
  const walk w = walk_of(beam[0], beam[1], beam[2], beam[3]);
  /* Length of a step of the walk in 1/2^20 cell. */
  const long step = (long)beam[4] * (1 << WALK_SHIFT) / w.longest;
  const long reach = step > 0 ? ((long)half_blur << WALK_TO_BEAM_SHIFT) / step : 0;
  int any = 0;
  for (long i = -reach; i <= w.steps; i++) {
    uint word = (uint)(free << VALUE_SHIFT | 1);
    if (i <= reach) {  /* beyond, the beam has passed: no division */
      const int away = (int)(((i < 0 ? -i : i) * step) >> WALK_TO_BEAM_SHIFT);
      int value = free;
      if (away < half_blur) {
        value = free + rise * (half_blur - away) / half_blur;
      }
      if (i < 0 && value < behind) {
        continue;
      }
      if (i == 0) {
        value = beam[5];
      }
      word = (uint)((i == 0) << HIT_SHIFT | value << VALUE_SHIFT | (i >= 0));
    }
    const int x = (int)((w.x + i * w.step_x) >> WALK_SHIFT);
    const int y = (int)((w.y + i * w.step_y) >> WALK_SHIFT);
    any |= mark_cell(observed, pages, width, met, x, y, word);
  }
  missed[item] = (uchar)any;
}

/* Quotient of whole numbers, cut to one: of at most 2^MEAN_BITS by at most MOST_OBSERVATIONS + 1. With half
 * more the quotient is far enough from whole numbers for float, which has a vector division. */
INLINE int quotient(const int a, const int b) {
  const int cut = (int)(((float)(a < 0 ? -a : a) + 0.5f) / (float)b);
  return a < 0 ? -cut : cut;
}

/* Join an observation (0 to VALUE_ONE) to a cell's state. */
INLINE uint joined(const uint state, const int value, const int quality, const int model) {
  const int mean = (int)(state >> MEAN_SHIFT), seen = (int)(state & MOST_OBSERVATIONS);
  const int told = value << VALUE_TO_MEAN_SHIFT;
  const int moved = ((told - mean) * quality) >> QUALITY_SHIFT;
  const int pulled = MEAN_HALF + (((told - MEAN_HALF) * quality) >> QUALITY_SHIFT);
  const int next = mean + (model == MODEL_BASE ? moved : quotient(pulled - mean, seen + 1));
  return (uint)next << MEAN_SHIFT | (uint)(seen < MOST_OBSERVATIONS ? seen + 1 : seen);
}

/* Whether a row of a page has marks. */
INLINE uint has_marks(__global const uint *words) {
  uint any = 0;
  IN_LANES
  for (int k = 0; k < TILE; k++) {
    any |= words[k];
  }
  return any;
}

/* Integrate what the scan marked into the cells; a work item does a page.
 *
 * valley     uint pool of states: what the matcher sees, with the blur
 * map        uint pool of states: what is published; cells behind a hit learn nothing here
 * field      uchar pool: the score field of scan_match.cl, 0 where the valley is no wall
 * met        of mark_scan; 0 afterwards
 * left, bottom, cols, rows  the pages that may have been met
 * cells      uchar: a dense copy of the field's pages seen_left, seen_bottom, seen_cols, seen_rows
 * map_free   value of a free cell in `map`, 0 to VALUE_ONE
 * quality    in 1/2^QUALITY_SHIFT: 0 teaches nothing, 1 everything
 * model      0 base, 1 mean
 * wall_floor mean up to which the score field is 0, 1/2^MEAN_BITS
 * wall_gain  what a mean above it adds to the field
 * Global: (cols * rows).
 */
__kernel void integrate_scan(
    __global uint *restrict observed, __global uint *restrict valley, __global uint *restrict map,
    __global uchar *restrict field, MET, const int map_free, const int quality,
    const int model, const int wall_floor, const int wall_gain) {
  MET_PAGE
  const int first = tile * TILE_CELLS;
  for (int row = first; row < first + TILE_CELLS; row += TILE) {
    if (has_marks(observed + row) == 0u) {
      continue;
    }
    IN_LANES
    for (int at = row; at < row + TILE; at++) {
      const uint word = observed[at], seen = valley[at], shown = map[at];
      const int value = (int)(word >> VALUE_SHIFT & VALUE_ONE);
      const uint next = joined(seen, value, quality, model);
      const uint shown_next = joined(shown, word >> HIT_SHIFT ? value : map_free, quality, model);
      const int wall = ((int)(next >> MEAN_SHIFT) - wall_floor) * wall_gain >> MEAN_BITS;
      const int kept = wall < 0 ? 0 : wall > FIELD_ONE ? FIELD_ONE : wall;
      observed[at] = 0u;
      valley[at] = word ? next : seen;
      field[at] = word ? (uchar)kept : field[at];
      map[at] = word & 1u ? shown_next : shown;
    }
  }
  if (is_seen) {
    copy_page(field, tile, cells, seen_x, seen_y, seen_cols);
  }
}

/* -- the likelihood field of a submap ----------------------------------------------------------- */

/* Mark the cells of each beam.
 *
 * observed  uint pool
 * pages     int, width x height; every cell within `reach` of a beam lies in the window
 * beams     BEAM_INTS ints per beam: x, y of its hit and of the laser, 1/1024 cell
 * table     uchar, TABLE_LAST + 1: value by the squared distance from a cell's centre to the hit, in
 *           (1/1024 cell)^2, shifted right by `shift`; the last for all beyond
 * reach     cells around the hit's own that learn of it
 * met       int for each page, set to 1 where the beam has cells
 * missed    uchar for each beam: whether it met a page without a tile
 */
__kernel void mark_likelihood(
    __global uint *observed, __global const int *pages, const int width, const int height,
    __global const int *beams, const int count, __global const uchar *table, const int shift,
    const int reach, __global int *met, __global uchar *missed) {
  const int item = get_global_id(0);
  if (item >= count) {
    return;
  }
  __global const int *beam = beams + BEAM_INTS * item;
  const walk w = walk_of(beam[0], beam[1], beam[2], beam[3]);
  int any = 0;
  for (long i = 1; i <= w.steps; i++) {
    const int x = (int)((w.x + i * w.step_x) >> WALK_SHIFT);
    const int y = (int)((w.y + i * w.step_y) >> WALK_SHIFT);
    any |= mark_cell(observed, pages, width, met, x, y, 1u);
  }
  const int col = beam[0] >> BEAM_SHIFT, row = beam[1] >> BEAM_SHIFT;
  for (int y = row - reach; y <= row + reach; y++) {
    for (int x = col - reach; x <= col + reach; x++) {
      const long dx = beam[0] - (x << BEAM_SHIFT) - BEAM_HALF;
      const long dy = beam[1] - (y << BEAM_SHIFT) - BEAM_HALF;
      const long step = (dx * dx + dy * dy) >> shift;
      const uint value = table[step < TABLE_LAST ? step : TABLE_LAST];
      any |= mark_cell(observed, pages, width, met, x, y, value << LIKELIHOOD_SHIFT | 1u);
    }
  }
  missed[item] = (uchar)any;
}

/* Update the likelihood field by what the scan marked; a work item does a page.
 *
 * states  uint pool: mean likelihood and observations
 * field   uchar pool: the score field of scan_match.cl, the mean itself
 * met     of mark_likelihood; 0 afterwards
 * left, bottom, cols, rows  the pages that may have been met
 * cells   uchar: a dense copy of the field's pages seen_left, seen_bottom, seen_cols, seen_rows
 * most    observations that a cell remembers, 1 to MOST_OBSERVATIONS: its mean forgets what is older
 * Global: (cols * rows).
 */
__kernel void update_likelihood(
    __global uint *observed, __global uint *states, __global uchar *field, MET, const int most) {
  MET_PAGE
  const int first = tile * TILE_CELLS;
  for (int at = first; at < first + TILE_CELLS; at++) {
    const uint word = observed[at];
    if (word == 0u) {
      continue;
    }
    observed[at] = 0u;
    const uint state = states[at];
    const int mean = (int)(state >> MEAN_SHIFT), seen = (int)(state & MOST_OBSERVATIONS);
    const int more = seen < most ? seen + 1 : most;
    const int told = (int)(word >> LIKELIHOOD_SHIFT) * LIKELIHOOD_ONE;
    const int next = mean + (told - mean) / more;
    states[at] = (uint)next << MEAN_SHIFT | (uint)more;
    field[at] = (uchar)(next / LIKELIHOOD_ONE);
  }
  if (is_seen) {
    copy_page(field, tile, cells, seen_x, seen_y, seen_cols);
  }
}
