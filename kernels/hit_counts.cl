/* Map update of gmapping: cells count the beams that met something in them and all that came
 * by, sum where they met it, and keep the score field that follows from that.
 *
 * Method: Grisetti, Stachniss and Burgard, IEEE T-RO 2007; a cell is what it was most often seen to
 * be, and its wall stands at the mean of the hits. There are many maps (particles), each with a page
 * table of its own over one common window; a scan is written into each map at that map's pose.
 * Counts grow by atomic sums of whole numbers, and the field depends on nothing but the counts, so
 * the result does not depend on the device's schedule.
 *
 * A word of `counts`: hits (16 bits), visits (16); the visits include the hits. A word of `sums`:
 * over the hits, the sum of their offset in the cell in x (16 bits) and in y (16); an offset is 0 to
 * 15, in 1/16 cell, and stands for the middle of its sixteenth.
 * Twin: slamfusion/compute/hit_counts.py, by the same names; exact. Positions are float32
 * without contraction for that reason.
 */
#pragma OPENCL FP_CONTRACT OFF
#include "common.h"
#include "tiles.h"
#include "walk.h"

#define HIT (1u << HITS_SHIFT)
/* Bits of a count that is full. A scan has fewer beams than FULL_HITS, so that no half of a word of
 * `counts` or `sums` flows over. */
#define FULL ((uint)FULL_HITS << HITS_SHIFT | FULL_VISITS)
#define BLOCK (4 * MOST_REACH + 1)

/* What every kernel is told of a scan; work item = map * beams + beam.
 *
 * ends            float2 per beam, cells, in the robot's frame
 * laser_x, _y     cells, in the robot's frame
 * poses           float4 per map: x, y in cells of the window, cos, sin
 * width, height   pages of the window
 */
#define SCAN                                                                                  \
  __global const float2 *ends, const int beams, const float laser_x, const float laser_y,     \
      __global const float4 *poses, const int maps, const int width, const int height

/* A position in cells as 1/1024 cells inside the window; what is no number becomes 0. */
INLINE int fixed_place(const float cells, const int pages) {
  const int limit = pages << (TILE_SHIFT + BEAM_SHIFT);
  const float place = cells * (float)BEAM_ONE;
  const float above = place > 0.0f ? place : 0.0f;
  return above < (float)limit ? (int)above : limit - 1;
}

/* Place of a point of the robot's frame in the window. */
INLINE int2 placed(const float4 pose, const float2 point, const int width, const int height) {
  const float x = pose.x + (pose.z * point.x - pose.w * point.y);
  const float y = pose.y + (pose.w * point.x + pose.z * point.y);
  return (int2)(fixed_place(x, width), fixed_place(y, height));
}

/* A walk's next cells are looked up together before the first of them is used. Where the device is a
 * CPU they are fetched into its cache meanwhile: an atomic sum waits for its cell and lets nothing
 * else pass. */
#ifdef UNALIGNED_WORDS
#define AHEAD 64
#define FETCH(place) __builtin_prefetch((const void *)(size_t)(place), 1)
#else
#define AHEAD 8
#define FETCH(place)
#endif

/* Column and row of step i of a walk. */
INLINE int2 walked_cell(const walk w, const int i) {
  const int col = (int)((w.x + i * w.step_x) >> WALK_SHIFT);
  const int row = (int)((w.y + i * w.step_y) >> WALK_SHIFT);
  return (int2)(col, row);
}

/* Find the places in the pools of up to AHEAD cells of a walk, from step `first` on; return how many
 * there are. */
INLINE int look_ahead(
    const walk w, const int first, __global const int *pages, const int width,
    __global const uint *counts, int *places) {
  const int left = (int)w.steps + 1 - first, n = left < AHEAD ? left : AHEAD;
  for (int k = 0; k < n; k++) {
    const int2 cell = walked_cell(w, first + k);
    const int tile = pages[(cell.y >> TILE_SHIFT) * width + (cell.x >> TILE_SHIFT)];
    places[k] = tile * TILE_CELLS + ((cell.y & TILE_MASK) << TILE_SHIFT) + (cell.x & TILE_MASK);
    FETCH(counts + places[k]);
  }
  return n;
}

/* Page of a cell along one side of the window; beyond it, the last one. */
INLINE int kept_page(const int page, const int pages) {
  return page < 0 ? 0 : page < pages ? page : pages - 1;
}

/* Say which pages a scan will come near.
 *
 * reach    cells
 * touched  uchar, width x height per map, 0 before: becomes 1 where the page holds a corner of the
 *          square of `reach` cells around a walked cell
 */
__kernel void touch_pages(SCAN, const int reach, __global uchar *touched) {
  const int item = get_global_id(0);
  if (item >= maps * beams) {
    return;
  }
  const int map = item / beams;
  const int2 end = placed(poses[map], ends[item - map * beams], width, height);
  const int2 laser = placed(poses[map], (float2)(laser_x, laser_y), width, height);
  const walk w = walk_of(end.x, end.y, laser.x, laser.y);
  __global uchar *own = touched + map * width * height;
  /* Both sides of the square move the same way: where neither sum changes, no page does. */
  int across = INT_MIN, along = INT_MIN;
  for (int i = 0; i <= (int)w.steps; i++) {
    const int2 cell = walked_cell(w, i);
    const int west = (cell.x - reach) >> TILE_SHIFT, east = (cell.x + reach) >> TILE_SHIFT;
    const int south = (cell.y - reach) >> TILE_SHIFT, north = (cell.y + reach) >> TILE_SHIFT;
    if (west + east != across || south + north != along) {
      across = west + east;
      along = south + north;
      __global uchar *low = own + kept_page(south, height) * width;
      __global uchar *high = own + kept_page(north, height) * width;
      const int left = kept_page(west, width), right = kept_page(east, width);
      low[left] = 1;
      low[right] = 1;
      high[left] = 1;
      high[right] = 1;
    }
  }
}

/* Count a scan: all cells from the end to the laser are visited, the end is hit if something was.
 *
 * is_hit  uchar per beam
 * pages   int, width x height per map; cells of page 0 are left out
 * sign    1, or -1 to take back a scan that was counted at the same places
 * full    int: becomes 1 when a cell is FULL
 */
__kernel void count_beams(
    SCAN, __global const uchar *is_hit, __global const int *pages, __global uint *counts,
    __global uint *sums, const int sign, __global int *full) {
  const int item = get_global_id(0);
  if (item >= maps * beams) {
    return;
  }
  const int map = item / beams, beam = item - map * beams;
  const int2 end = placed(poses[map], ends[beam], width, height);
  const int2 laser = placed(poses[map], (float2)(laser_x, laser_y), width, height);
  const walk w = walk_of(end.x, end.y, laser.x, laser.y);
  __global const int *own = pages + map * width * height;
  uint seen = 0, more = (uint)sign;
  if (is_hit[beam]) {
    const int at = tile_cell(own, width, height, end.x >> BEAM_SHIFT, end.y >> BEAM_SHIFT);
    if (at >= TILE_CELLS) {
      const uint x = (uint)(end.x & BEAM_MASK) >> OFFSET_SHIFT;
      const uint y = (uint)(end.y & BEAM_MASK) >> OFFSET_SHIFT;
      atomic_add(sums + at, (uint)sign * (x << SUM_SHIFT | y));
    }
    more = (uint)sign * (HIT + 1);
  }
  int places[AHEAD];
  for (int first = 0; first <= (int)w.steps; first += AHEAD) {
    const int n = look_ahead(w, first, own, width, counts, places);
    for (int k = 0; k < n; k++) {
      if (places[k] >= TILE_CELLS) {
        seen |= atomic_add(counts + places[k], more) + more;
      }
      more = (uint)sign;
    }
  }
  if (seen & FULL) {
    full[0] = 1;
  }
}

/* Place in a pool of a cell of four tiles, counted from the corner of the first. */
INLINE int block_cell(int tiles[2][2], const int col, const int row) {
  const int tile = tiles[row >> TILE_SHIFT][col >> TILE_SHIFT];
  return tile * TILE_CELLS + ((row & TILE_MASK) << TILE_SHIFT) + (col & TILE_MASK);
}

/* Bits 0 to n - 1. */
INLINE ulong first_bits(const int n) { return (1ul << n) - 1ul; }

/* The bits, and those up to `reach` places away from them. */
INLINE ulong widened(ulong bits, const int reach) {
  for (int k = 0; k < reach; k++) {
    bits |= bits << 1 | bits >> 1;
  }
  return bits;
}

/* Renew the field around one cell: gather the occupied cells of the block that bears on it, then
 * look for the nearest of them to every cell of the inner square that nobody else has claimed. */
INLINE void settle_cell(
    const int2 cell, __global const int *pages, const int width, const int height,
    __global const uint *counts, __global const uint *sums, __global uchar *field,
    __global uint *claimed, __global const uchar *table, const int shift, const int reach,
    const uint occupied, const uint least_hits) {
  /* The block lies in up to four tiles; its columns and rows count from the corner of the first. */
  const int west = (cell.x - 2 * reach) >> TILE_SHIFT, left = (cell.x - 2 * reach) & TILE_MASK;
  const int south = (cell.y - 2 * reach) >> TILE_SHIFT, low = (cell.y - 2 * reach) & TILE_MASK;
  int tiles[2][2];
  for (int k = 0; k < 4; k++) {
    const int col = west + (k & 1), row = south + (k >> 1);
    const int inside = col >= 0 && row >= 0 && col < width && row < height;
    tiles[k >> 1][k & 1] = inside ? pages[row * width + col] : 0;
  }

  /* Claim the cells of the inner square; a row of a tile is a word. */
  ulong mine[2 * MOST_REACH + 1];
  ulong cols = 0, rows = 0;
  const ulong square = first_bits(2 * reach + 1) << (left + reach);
  for (int k = 0; k <= 2 * reach; k++) {
    const int row = low + reach + k;
    mine[k] = 0;
    for (int side = 0; side < 2; side++) {
      const int tile = tiles[row >> TILE_SHIFT][side];
      const uint bits = (uint)(square >> (side * TILE));
      if (tile != 0 && bits != 0) {
        const uint before = atomic_or(claimed + tile * TILE + (row & TILE_MASK), bits);
        mine[k] |= (ulong)(bits & ~before) << (side * TILE);
      }
    }
    cols |= mine[k];
    rows |= (ulong)(mine[k] != 0) << row;
  }
  if (cols == 0) {
    return;
  }

  /* Gather the occupied cells near them: where their hits are on average, in 1/256 cell. */
  int wall_x[BLOCK * BLOCK], wall_y[BLOCK * BLOCK];
  int walls = 0;
  cols = widened(cols, reach);
  rows = widened(rows, reach);
  for (int row = low; row <= low + 4 * reach; row++) {
    if (!(rows >> row & 1)) {
      continue;
    }
    for (int col = left; col <= left + 4 * reach; col++) {
      const int at = block_cell(tiles, col, row);
      const uint count = counts[at], hits = count >> HITS_SHIFT, visits = count & VISITS_MASK;
      if (hits >= least_hits && (ulong)hits * SHARE_ONE > (ulong)occupied * visits &&
          (cols >> col & 1)) {
        const uint sum_x = sums[at] >> SUM_SHIFT, sum_y = sums[at] & SUM_MASK;
        wall_x[walls] = (col << CELL_SHIFT) + OFFSET_HALF + (int)(sum_x * OFFSET_ONE / hits);
        wall_y[walls] = (row << CELL_SHIFT) + OFFSET_HALF + (int)(sum_y * OFFSET_ONE / hits);
        walls++;
      }
    }
  }

  for (int k = 0; k <= 2 * reach; k++) {
    const int row = low + reach + k;
    for (int col = left + reach; col <= left + 3 * reach; col++) {
      if (!(mine[k] >> col & 1)) {
        continue;
      }
      /* No branches: this loop turns into vectors. */
      int least = INT_MAX;
      for (int n = 0; n < walls; n++) {
        const int across = (wall_x[n] >> CELL_SHIFT) - col, along = (wall_y[n] >> CELL_SHIFT) - row;
        const int is_far =
            (across > reach) | (across < -reach) | (along > reach) | (along < -reach);
        const int dx = wall_x[n] - (col << CELL_SHIFT) - CELL_HALF;
        const int dy = wall_y[n] - (row << CELL_SHIFT) - CELL_HALF;
        const int distance2 = is_far ? INT_MAX : dx * dx + dy * dy;
        least = distance2 < least ? distance2 : least;
      }
      const int step = least >> shift;
      field[block_cell(tiles, col, row)] =
          least == INT_MAX ? 0 : table[step < TABLE_LAST ? step : TABLE_LAST];
    }
  }
}

/* Renew the field around the walked cells that have hits.
 *
 * field       uchar pool: the best that the table gives an occupied cell within `reach` cells
 * claimed     uint, a word per row of a tile, 0 before: cells whose field somebody renews
 * table       uchar, TABLE_LAST + 1, never rising: of the squared distance, in 1/256 cell, from the
 *             cell's centre to the mean hit of the occupied cell, shifted right by `shift`; the last for
 *             all beyond
 * reach       cells, 0 to MOST_REACH
 * occupied    a cell is occupied with more hits than this share of its visits, in 1/65536,
 * least_hits  and at least this many, 1 or more
 */
__kernel void settle_field(
    SCAN, __global const int *pages, __global const uint *counts, __global const uint *sums,
    __global uchar *field, __global uint *claimed, __global const uchar *table, const int shift,
    const int reach, const uint occupied, const uint least_hits) {
  const int item = get_global_id(0);
  if (item >= maps * beams) {
    return;
  }
  const int map = item / beams;
  const int2 end = placed(poses[map], ends[item - map * beams], width, height);
  const int2 laser = placed(poses[map], (float2)(laser_x, laser_y), width, height);
  const walk w = walk_of(end.x, end.y, laser.x, laser.y);
  __global const int *own = pages + map * width * height;
  int places[AHEAD];
  for (int first = 0; first <= (int)w.steps; first += AHEAD) {
    const int n = look_ahead(w, first, own, width, counts, places);
    for (int k = 0; k < n; k++) {
      if (counts[places[k]] >= HIT) {
        settle_cell(
            walked_cell(w, first + k), own, width, height, counts, sums, field, claimed, table,
            shift, reach, occupied, least_hits);
      }
    }
  }
}
