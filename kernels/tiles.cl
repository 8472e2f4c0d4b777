/* Tiles of a pool: copied before they are written, fetched, and laid out as a dense window.
 *
 * Twin: slamfusion/compute/tiles.py, by the same names; exact.
 */
#include "common.h"
#include "tiles.h"

/* Copy tiles inside a pool; no target is a source.
 *
 * pool    TILE_CELLS values per tile, in words of 32 bytes
 * words   of a tile
 * pairs   int2 each: source and target; source 0, the empty tile, clears the target
 * Global: (words, count).
 */
__kernel void copy_tiles(
    __global ulong4 *pool, const int words, __global const int2 *pairs, const int count) {
  const int word = get_global_id(0), n = get_global_id(1);
  if (word < words && n < count) {
    const int2 pair = pairs[n];
    pool[(size_t)pair.y * words + word] = pool[(size_t)pair.x * words + word];
  }
}

/* Fetch tiles of a pool.
 *
 * pool     TILE_CELLS values per tile, in words of 8 bytes
 * words    of a tile
 * numbers  int, count of them
 * tiles    count tiles
 * Global: (words, count).
 */
__kernel void take_tiles(
    __global const ulong *pool, const int words, __global const int *numbers, const int count,
    __global ulong *tiles) {
  const int word = get_global_id(0), n = get_global_id(1);
  if (word < words && n < count) {
    tiles[(size_t)n * words + word] = pool[(size_t)numbers[n] * words + word];
  }
}

/* Copy a rectangle of pages of a tiled map's field into a dense one; a work item does a page.
 *
 * field    uchar, `across` cells per row of a tile, `step` bytes per cell, the first of them the value
 * pages    int, pages_wide per row
 * first    column and row of the window's first page
 * cells    uchar, TILE times width x height
 * Global: (width * height).
 */
__kernel void copy_window(
    __global const uchar *field, const int across, const int step, __global const int *pages,
    const int pages_wide, const int first_x, const int first_y, const int width,
    const int height, __global uchar *restrict cells) {
  const int item = get_global_id(0), x = item % width, y = item / width;
  if (y >= height) {
    return;
  }
  const int tile = pages[(first_y + y) * pages_wide + first_x + x];
  if (step == 1) {
    copy_page(field, tile, cells, x, y, width);
    return;
  }
  __global const uchar *from = field + (size_t)tile * TILE * across * step;
  __global uchar *restrict to = cells + ((size_t)y * TILE * width + x) * TILE;
  for (int row = 0; row < TILE; row++, from += across * step, to += width * TILE) {
    for (int k = 0; k < TILE; k++) {
      to[k] = from[k * step];
    }
  }
}
