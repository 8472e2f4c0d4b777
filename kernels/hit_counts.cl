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
/* Cells of a row that are updated together for a wall: all that it reaches, rounded up. And the columns
 * of a tile and its edge, with room for them on both sides, in whole vectors. */
#define BLOCK 8
#define COLUMNS ((2 * MOST_REACH + PAIRS + 2 * BLOCK - 1) & -BLOCK)
/* A squared distance, in (1/256 cell)^2, from which on there is no wall within reach. */
#define FARTHEST (1 << 27)
/* Bits of a count that is full. A scan has fewer beams than FULL_HITS, so that no half of a word of
 * `counts` or `sums` flows over. */
#define FULL ((uint)FULL_HITS << HITS_SHIFT | FULL_VISITS)

/* Arguments of a scan that all kernels take.
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

/* Steps of a walk along one axis, from a place on, both in 1/2^20 cell, until the tile `reach` cells ahead
 * or behind is another one; at least 1. */
INLINE int steps_inside(const long place, const int reach, const int step) {
  const int high = (int)(place + ((long)reach << WALK_SHIFT)) & TILE_PLACE_MASK;
  const int low = (int)(place - ((long)reach << WALK_SHIFT)) & TILE_PLACE_MASK;
  const int way = step < 0 ? LOWER(high, low) : TILE_PLACE_MASK - HIGHER(high, low);
  return 1 + way / (step < 0 ? -step : HIGHER(step, 1));
}

/* Say which pages a scan will come near; a work item is map * beams + beam.
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
  const int step_x = (int)w.step_x, step_y = (int)w.step_y;
  long x = w.x, y = w.y;
  for (int left = (int)w.steps + 1; left > 0;) {
    const int col = (int)(x >> WALK_SHIFT), row = (int)(y >> WALK_SHIFT);
    __global uchar *low = own + kept_page((row - reach) >> TILE_SHIFT, height) * width;
    __global uchar *high = own + kept_page((row + reach) >> TILE_SHIFT, height) * width;
    const int west = kept_page((col - reach) >> TILE_SHIFT, width);
    const int east = kept_page((col + reach) >> TILE_SHIFT, width);
    low[west] = 1;
    low[east] = 1;
    high[west] = 1;
    high[east] = 1;
    const int run = LOWER(steps_inside(x, reach, step_x), steps_inside(y, reach, step_y));
    left -= run;
    x += (long)run * step_x;
    y += (long)run * step_y;
  }
}

/* Whether a cell with this word of `counts` is occupied: more hits than a share `occupied` of its
 * visits, in 1/65536, and at least `least_hits` of them, 1 or more. */
INLINE bool is_wall(const uint count, const uint occupied, const uint least_hits) {
  const uint hits = count >> HITS_SHIFT, visits = count & VISITS_MASK;
  return (hits >= least_hits) & (hits * SHARE_ONE > occupied * visits);
}

/* Words of a map whose beams are all counted by one work-group. Where a group is one thread they need no
 * atomics; `volatile` keeps the order of its items. */
#ifdef ONE_THREAD_A_GROUP
INLINE uint add_to_own(volatile __global uint *word, const uint more) {
  const uint before = *word;
  *word = before + more;
  return before;
}
INLINE void join_own(volatile __global uint *word, const uint bits) { *word |= bits; }
#else
INLINE uint add_to_own(__global uint *word, const uint more) { return atomic_add(word, more); }
INLINE void join_own(__global uint *word, const uint bits) { atomic_or(word, bits); }
#endif

/* Count a scan: all cells from the end to the laser are visited, the end is hit if something was.
 *
 * each     items of a map, which share its beams: those of one work-group where it is one thread
 * is_hit   uchar per beam
 * pages    int, width x height per map; cells of page 0 are left out
 * full     int: becomes 1 when a cell is FULL
 * changed  uint, a word per row of a tile, 0 before: cells that are hit, or whether they are occupied
 *          changes; see is_wall
 * Global: (maps * each).
 */
__kernel void count_beams(
    SCAN, const int each, __global const uchar *is_hit, __global const int *pages,
    __global uint *counts, __global uint *sums, __global int *full, __global uint *changed,
    const uint occupied, const uint least_hits) {
  const int item = get_global_id(0), map = item / each, share = (beams + each - 1) / each;
  if (map >= maps) {
    return;
  }
  const float4 pose = poses[map];
  const int2 laser = placed(pose, (float2)(laser_x, laser_y), width, height);
  __global const int *own = pages + map * width * height;
  uint seen = 0;
  const int first = (item - map * each) * share, end = LOWER(first + share, beams);
  for (int beam = first; beam < end; beam++) {
    const int2 hit = placed(pose, ends[beam], width, height);
    const walk w = walk_of(hit.x, hit.y, laser.x, laser.y);
    const int step_x = (int)w.step_x, step_y = (int)w.step_y;
    int left = (int)w.steps + 1;
    bool is_end = is_hit[beam];
    for (long x = w.x, y = w.y; left > 0;) {
      /* The cells of a tile. */
      const int col = (int)(x >> WALK_SHIFT), row = (int)(y >> WALK_SHIFT);
      const int tile = own[(row >> TILE_SHIFT) * width + (col >> TILE_SHIFT)];
      int east = (int)x & TILE_PLACE_MASK, north = (int)y & TILE_PLACE_MASK;
      const int inside = LOWER(steps_inside(x, 0, step_x), steps_inside(y, 0, step_y));
      const int run = LOWER(inside, left);
      left -= run;
      x += (long)run * step_x;
      y += (long)run * step_y;
      if (tile == 0) {
        is_end = false;
        continue;
      }
      uint more = 1;
      __global uint *cells = counts + tile * TILE_CELLS;
      if (is_end) {
        const uint sum_x = (uint)(hit.x & BEAM_MASK) >> OFFSET_SHIFT;
        const uint sum_y = (uint)(hit.y & BEAM_MASK) >> OFFSET_SHIFT;
        const int at = north >> WALK_SHIFT << TILE_SHIFT | east >> WALK_SHIFT;
        add_to_own(sums + tile * TILE_CELLS + at, sum_x << SUM_SHIFT | sum_y);
        more = HIT + 1;
        is_end = false;
      }
      for (int i = 0; i < run; i++) {
        const int at = north >> WALK_SHIFT << TILE_SHIFT | east >> WALK_SHIFT;
        const uint before = add_to_own(cells + at, more), after = before + more;
        seen |= after;
        if (after >= HIT) {
          if (more > 1 || is_wall(before, occupied, least_hits) != is_wall(after, occupied, least_hits)) {
            join_own(changed + tile * TILE + (at >> TILE_SHIFT), 1u << (at & TILE_MASK));
          }
          more = 1;
        }
        east += step_x;
        north += step_y;
      }
    }
  }
  if (seen & FULL) {
    full[0] = 1;
  }
}

/* Count beams of any number of scans in one map: as count_beams, with words of their own for hits and
 * visits.
 *
 * beams    BEAM_INTS ints per beam: x, y of its end and of the laser, 1/1024 cell, in the window
 * is_hit   uchar per beam
 * pages    int, rows of `width`; cells of page 0 are left out
 * sign     1, or -1 to take beams back that were counted
 */
__kernel void count_walks(
    __global const int4 *beams, const int count, __global const uchar *is_hit, const int width,
    __global const int *pages, __global uint *hits, __global uint *visits, const int sign) {
  const int item = get_global_id(0);
  if (item >= count) {
    return;
  }
  const int4 beam = beams[item];
  const walk w = walk_of(beam.x, beam.y, beam.z, beam.w);
  int places[AHEAD];
  for (int first = 0; first <= (int)w.steps; first += AHEAD) {
    const int n = look_ahead(w, first, pages, width, visits, places);
    if (first == 0 && is_hit[item] && places[0] >= TILE_CELLS) {
      add_to_word(hits + places[0], (uint)sign);
    }
    for (int k = 0; k < n; k++) {
      if (places[k] >= TILE_CELLS) {
        add_to_word(visits + places[k], (uint)sign);
      }
    }
  }
}

/* Bits with those up to `reach` places away from them. */
INLINE ulong widened(ulong bits, const int reach) {
  for (int n = 0; n < reach; n++) {
    bits |= bits << 1 | bits >> 1;
  }
  return bits;
}

/* Where the hits of a cell are on average along one axis, in 1/256 cell from the cell's middle. The
 * quotient is exact: with half a unit more it is farther from a whole number than float32 errs. */
INLINE int mean_offset(const uint sum, const float per_hit) {
  return (int)(((float)(sum * OFFSET_ONE) + 0.5f) * per_hit) + OFFSET_HALF - CELL_HALF;
}

/* Renew the field around the changed cells, a page an item.
 *
 * places      int per page: of those to look at, the place in `pages`
 * pages       int, width x height per map
 * field       uchar, two for each of PAIRS pairs in a tile's row: of a cell and of the one above it, the
 *             best that the table gives an occupied cell within `reach` cells
 * changed     uint, a word per row of a tile, as count_beams left it
 * table       uchar, TABLE_LAST + 1, never rising: of the squared distance, in 1/256 cell, from the
 *             cell's centre to the mean hit of the occupied cell, shifted right by `shift`; the last for
 *             all beyond
 * reach       cells, 0 to MOST_REACH
 * occupied, least_hits  see is_wall
 */
__kernel void settle_field(
    __global const int *places, const int count, __global const int *pages, const int width,
    const int height, __global const uint *counts, __global const uint *sums, __global uchar *field,
    __global const uint *changed, __global const uchar *table, const int shift, const int reach,
    const uint occupied, const uint least_hits) {
  const int item = get_global_id(0);
  if (item >= count || pages[places[item]] == 0) {
    return;
  }
  const int page = places[item] % (width * height), row0 = page / width, col0 = page % width;
  int tiles[3][3];
  for (int k = 0; k < 9; k++) {
    const int row = row0 + k / 3 - 1, col = col0 + k % 3 - 1;
    const bool inside = row >= 0 && col >= 0 && row < height && col < width;
    tiles[k / 3][k % 3] = inside ? pages[places[item] - page + row * width + col] : 0;
  }

  /* Cells to renew: those with a changed one within reach, of the tile and of its edge. */
  ulong mine[TILE + 1];
  ulong any = 0;
  for (int row = 0; row <= TILE; row++) {
    mine[row] = 0;
  }
  for (int k = -reach; k <= TILE + reach; k++) {
    const int *across = tiles[(k >> TILE_SHIFT) + 1];
    const int row = k & TILE_MASK;
    const ulong west = changed[across[0] * TILE + row], east = changed[across[2] * TILE + row];
    const ulong bits = west << reach >> TILE | (ulong)changed[across[1] * TILE + row] << reach |
                       east << (TILE + reach);
    if (bits != 0) {
      const ulong wide = widened(bits, reach) >> reach & ((1ul << PAIRS) - 1);
      for (int n = HIGHER(k - reach, 0); n <= LOWER(k + reach, TILE); n++) {
        mine[n] |= wide;
      }
      any |= wide;
    }
  }
  if (any == 0) {
    return;
  }

  /* Cells with hits near these, column -reach in the lowest bit. */
  ulong walls[TILE + 2 * MOST_REACH + 1];
  for (int k = -reach; k <= TILE + reach; k++) {
    ulong near = 0;
    for (int n = HIGHER(k - reach, 0); n <= LOWER(k + reach, TILE); n++) {
      near |= mine[n];
    }
    walls[k + reach] = 0;
    if (near == 0) {
      continue;
    }
    near = widened(near << reach, reach);
    const int *across = tiles[(k >> TILE_SHIFT) + 1];
    const int line = (k & TILE_MASK) << TILE_SHIFT;
    __global const uint *own = counts + across[1] * TILE_CELLS + line;
    uint is_hit = 0;
    for (int n = 0; n < TILE; n++) {
      is_hit |= (uint)(own[n] >= HIT) << n;
    }
    ulong hit = (ulong)is_hit << reach;
    if (near & ((1ul << reach) - 1)) {
      __global const uint *west = counts + across[0] * TILE_CELLS + line + TILE - reach;
      for (int n = 0; n < reach; n++) {
        hit |= (ulong)(west[n] >= HIT) << n;
      }
    }
    if (near >> (TILE + reach)) {
      __global const uint *east = counts + across[2] * TILE_CELLS + line;
      for (int n = 0; n <= reach; n++) {
        hit |= (ulong)(east[n] >= HIT) << (n + TILE + reach);
      }
    }
    walls[k + reach] = hit & near;
    FETCH(sums + across[1] * TILE_CELLS + line);
    FETCH(sums + across[1] * TILE_CELLS + line + TILE / 2);
  }

  /* The least squared distance from each cell to a mean hit. */
  int least[TILE + 1][COLUMNS];
  for (int row = 0; row <= TILE; row++) {
    if (mine[row] != 0) {
      for (int n = 0; n < COLUMNS; n++) {
        least[row][n] = FARTHEST;
      }
    }
  }
  for (int k = -reach; k <= TILE + reach; k++) {
    const int *across = tiles[(k >> TILE_SHIFT) + 1];
    const int line = (k & TILE_MASK) << TILE_SHIFT;
    for (ulong left = walls[k + reach]; left != 0; left &= left - 1) {
      const int col = LOWEST_BIT(left) - reach;
      const int at = across[(col >> TILE_SHIFT) + 1] * TILE_CELLS + line + (col & TILE_MASK);
      if (!is_wall(counts[at], occupied, least_hits)) {
        continue;
      }
      const float per_hit = 1.0f / (float)(counts[at] >> HITS_SHIFT);
      const int x = mean_offset(sums[at] >> SUM_SHIFT, per_hit);
      const int y = mean_offset(sums[at] & SUM_MASK, per_hit);
      int across2[BLOCK];
      for (int n = 0; n < BLOCK; n++) {
        const int dx = (reach - n) * CELL_ONE + x;
        across2[n] = n <= 2 * reach ? dx * dx : FARTHEST;
      }
      for (int n = HIGHER(k - reach, 0); n <= LOWER(k + reach, TILE); n++) {
        if (mine[n] == 0) {
          continue;
        }
        const int dy = (k - n) * CELL_ONE + y;
        int *best = least[n] + col + reach;
        for (int m = 0; m < BLOCK; m++) {
          const int distance2 = across2[m] + dy * dy;
          best[m] = distance2 < best[m] ? distance2 : best[m];
        }
      }
    }
  }

  __global uchar *pair = field + (size_t)tiles[1][1] * (TILE * PAIRS * 2);
  for (int row = 0; row <= TILE; row++, pair += 2 * PAIRS) {
    for (ulong left = mine[row]; left != 0; left &= left - 1) {
      const int col = LOWEST_BIT(left), distance2 = least[row][col + 2 * reach];
      const int step = distance2 >> shift;
      const uchar value = distance2 >= FARTHEST ? 0 : table[step < TABLE_LAST ? step : TABLE_LAST];
      if (row < TILE) {
        pair[2 * col] = value;
      }
      if (row > 0) {
        pair[2 * (col - PAIRS) + 1] = value;
      }
    }
  }
}
