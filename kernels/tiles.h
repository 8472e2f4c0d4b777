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

/* Keep the greater word of a cell; and add to a word, and return what it was. An atomic waits for its
 * cell and lets nothing pass; on a device of one thread `volatile` keeps order enough. */
#ifdef ONE_THREAD
INLINE void keep_greater(volatile __global uint *word, const uint other) {
  const uint own = *word;
  *word = own < other ? other : own;
}
INLINE uint add_to_word(volatile __global uint *word, const uint more) {
  const uint before = *word;
  *word = before + more;
  return before;
}
#else
INLINE void keep_greater(__global uint *word, const uint other) { atomic_max(word, other); }
INLINE uint add_to_word(__global uint *word, const uint more) { return atomic_add(word, more); }
#endif

/* Mark a cell inside the window with a word, and its page as met; return whether that has no tile. */
INLINE int mark_cell(
    __global uint *observed, __global const int *pages, const int width, __global int *met,
    const int x, const int y, const uint word) {
  const int page = (y >> TILE_SHIFT) * width + (x >> TILE_SHIFT);
  const int tile = pages[page];
  met[page] = 1;
  if (tile == 0) {
    return 1;
  }
  keep_greater(
      observed + tile * TILE_CELLS + ((y & TILE_MASK) << TILE_SHIFT) + (x & TILE_MASK), word);
  return 0;
}

/* Copy a tile of a field to column x and row y of a dense window, `width` pages wide. */
INLINE void copy_page(
    __global const uchar *field, const int tile, __global uchar *restrict cells, const int x,
    const int y, const int width) {
  __global const uchar *from = field + (size_t)tile * TILE_CELLS;
  __global uchar *restrict to = cells + ((size_t)y * TILE * width + x) * TILE;
  for (int row = 0; row < TILE; row++) {
    STORE32(LOAD32(from + row * TILE), to + row * width * TILE);
  }
}

/* Tile of a page that was met, and is not met any more; 0 of one that was not. */
INLINE int met_tile(__global const int *pages, __global int *met, const int page) {
  const int tile = met[page] ? pages[page] : 0;
  met[page] = 0;
  return tile;
}

#endif
