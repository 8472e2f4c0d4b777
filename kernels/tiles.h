/* Maps of tiles, shared by the kernels of the SLAMs.
 *
 * A map is a window of pages, row-major; a page holds the number of a tile in the pools, and tile 0
 * is the empty tile that every unused page shares, so that a look-up needs no branch. A pool holds
 * one value for each cell of each tile. Cell (0, 0) is the lower-left cell of the window.
 */
#ifndef SLAMFUSION_TILES_H
#define SLAMFUSION_TILES_H

/* Place of cell (x, y) in a pool; cells beyond the window fall on its border, which is empty. */
INLINE int tile_cell(__global const int *pages, const int width, const int height, int x, int y) {
  const int last_x = (width << TILE_SHIFT) - 1, last_y = (height << TILE_SHIFT) - 1;
  x = x < 0 ? 0 : x;
  x = x > last_x ? last_x : x;
  y = y < 0 ? 0 : y;
  y = y > last_y ? last_y : y;
  const int tile = pages[(y >> TILE_SHIFT) * width + (x >> TILE_SHIFT)];
  return tile * TILE_CELLS + ((y & TILE_MASK) << TILE_SHIFT) + (x & TILE_MASK);
}

/* Keep the greater word of a cell; take a cell's word and leave 0; and add to a word, and return what
 * it was. An atomic waits for its cell and lets nothing pass; on a device of one
 * thread `volatile` keeps order enough. */
#ifdef ONE_THREAD
INLINE void keep_greater(volatile __global uint *word, const uint other) {
  if (*word < other) {
    *word = other;
  }
}
INLINE uint take_word(volatile __global uint *word) {
  const uint taken = *word;
  if (taken != 0u) {
    *word = 0u;
  }
  return taken;
}
INLINE uint add_to_word(volatile __global uint *word, const uint more) {
  const uint before = *word;
  *word = before + more;
  return before;
}
#else
INLINE void keep_greater(__global uint *word, const uint other) { atomic_max(word, other); }
INLINE uint take_word(__global uint *word) { return atomic_xchg(word, 0u); }
INLINE uint add_to_word(__global uint *word, const uint more) { return atomic_add(word, more); }
#endif

/* Mark a cell inside the window with a word. If its page has no tile, that is wanted and 1 returned. */
INLINE int mark_cell(
    __global uint *observed, __global const int *pages, const int width, __global int *wanted,
    const int x, const int y, const uint word) {
  const int page = (y >> TILE_SHIFT) * width + (x >> TILE_SHIFT);
  const int tile = pages[page];
  if (tile == 0) {
    wanted[page] = 1;
    return 1;
  }
  keep_greater(
      observed + tile * TILE_CELLS + ((y & TILE_MASK) << TILE_SHIFT) + (x & TILE_MASK), word);
  return 0;
}

#endif
