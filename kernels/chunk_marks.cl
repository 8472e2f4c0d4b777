/* Marks of chunks: which parts of a drive hit a cell and which saw it, one bit each, so that one map
 * holds for every chunk the map of all others.
 *
 * Method: leave-one-out prediction of what a chunk saw by what all others did; a word of bits in
 * place of a map for each chunk. Bits are set by atomic ors, so the result does not depend on the
 * device's schedule.
 * Twin: slamfusion/compute/chunk_marks.py, by the same names; exact.
 *
 * seen           uint, TILE_CELLS per tile: bits of chunks
 * hits           uint, FACINGS times TILE_CELLS per tile, one after the other
 * pages          int, width x height; page 0 has no tile
 * beams          int4 each: x, y of the hit and of the laser in 1/1024 cell
 * facings        int per beam: the direction that the hit surface faces, 0 to FACINGS - 1
 */
#include "common.h"
#include "tiles.h"
#include "walk.h"

/* Place of cell (x, y) in a pool; -1 beyond the window and where the page has no tile. */
INLINE int kept_cell(__global const int *pages, const int width, const int height, const int x,
                     const int y) {
  const int page_x = x >> TILE_SHIFT, page_y = y >> TILE_SHIFT;
  if (page_x < 0 || page_y < 0 || page_x >= width || page_y >= height) return -1;
  const int tile = pages[page_y * width + page_x];
  return tile ? tile * TILE_CELLS + ((y & TILE_MASK) << TILE_SHIFT) + (x & TILE_MASK) : -1;
}

/* Place in `hits` of a cell at a place in `seen`, for a facing. */
INLINE int hit_place(const int cell, const int facing) {
  const int tile = cell / TILE_CELLS;
  return (tile * FACINGS + facing) * TILE_CELLS + (cell - tile * TILE_CELLS);
}

/* Set bits of a word. Most beams find them set, and on a CPU an atomic takes as long as ten reads; bits
 * are never taken back, so that a word read too early costs an atomic in vain. */
INLINE void set_bits(volatile __global uint *word, const uint bits) {
#ifdef ONE_THREAD_A_GROUP
  if (!(~*word & bits)) return;
#endif
  atomic_or(word, bits);
}

/* Mark beams with the bits of their chunks: every cell of the walk is seen, that of the end hit.
 * bits uint per beam. Global: (count). */
__kernel void mark_chunks(__global uint *hits, __global uint *seen, __global const int *pages,
                          const int width, const int height, __global const int4 *beams,
                          __global const int *facings, __global const uint *bits,
                          const int count) {
  const int n = get_global_id(0);
  if (n >= count) return;
  const int4 beam = beams[n];
  const uint own = bits[n];
  const int end = kept_cell(pages, width, height, beam.x >> BEAM_SHIFT, beam.y >> BEAM_SHIFT);
  const int side = FACINGS_ALIKE / 2;
  for (int turn = -side; end >= 0 && turn <= side; turn++)
    set_bits(hits + hit_place(end, (facings[n] + turn + FACINGS) % FACINGS), own);
  const walk w = walk_of(beam.x, beam.y, beam.z, beam.w);
  for (int i = 0; i <= (int)w.steps; i++) {
    const int x = (int)((w.x + i * w.step_x) >> WALK_SHIFT);
    const int y = (int)((w.y + i * w.step_y) >> WALK_SHIFT);
    const int cell = kept_cell(pages, width, height, x, y);
    if (cell >= 0) set_bits(seen + cell, own);
  }
}

/* How near the end of each beam the chunks that are not left out hit something, and whether they saw
 * the cell of the end.
 * left_out uint per beam; reach in cells;
 * out int2 per beam: squared distance to the nearest hit cell's centre in (1/1024 cell)^2, -1 where
 * there is none within reach; 1 where seen. Global: (count). */
__kernel void nearest_marks(__global const uint *hits, __global const uint *seen,
                            __global const int *pages, const int width, const int height,
                            __global const int4 *beams, __global const int *facings,
                            __global const uint *left_out, const int count, const int reach,
                            __global int2 *out) {
  const int n = get_global_id(0);
  if (n >= count) return;
  const int x = beams[n].x, y = beams[n].y, facing = facings[n];
  const uint counted = ~left_out[n];
  const int col = x >> BEAM_SHIFT, row = y >> BEAM_SHIFT;
  int nearest = INT_MAX;
  for (int r = row - reach; r <= row + reach; r++) {
    const int gap_y = (r << BEAM_SHIFT) + BEAM_HALF - y;
    for (int c = col - reach; c <= col + reach; c++) {
      const int cell = kept_cell(pages, width, height, c, r);
      if (cell < 0 || !(hits[hit_place(cell, facing)] & counted)) continue;
      const int gap_x = (c << BEAM_SHIFT) + BEAM_HALF - x;
      const int squared = gap_x * gap_x + gap_y * gap_y;
      nearest = squared < nearest ? squared : nearest;
    }
  }
  const int own = kept_cell(pages, width, height, col, row);
  out[n] = (int2)(nearest == INT_MAX ? -1 : nearest, own >= 0 && (seen[own] & counted));
}
