/* Maps of tiles, shared by the kernels of the SLAMs.
 *
 * A map is a window of pages, row-major; a page holds the number of a tile in the pools, and tile 0
 * is the empty tile that every unused page shares, so that a look-up needs no branch. A pool holds
 * one value for each cell of each tile. Cell (0, 0) is the lower-left cell of the window.
 */
#ifndef SLAMFUSION_TILES_H
#define SLAMFUSION_TILES_H

#define TILE_SHIFT 5
#define TILE_MASK 31
#define TILE_CELLS 1024

/* Place of cell (x, y) in a pool; cells beyond the window fall on its border, which is empty. */
inline int tile_cell(__global const int *pages, const int width, const int height, int x, int y) {
  const int last_x = (width << TILE_SHIFT) - 1, last_y = (height << TILE_SHIFT) - 1;
  x = x < 0 ? 0 : x;
  x = x > last_x ? last_x : x;
  y = y < 0 ? 0 : y;
  y = y > last_y ? last_y : y;
  const int tile = pages[(y >> TILE_SHIFT) * width + (x >> TILE_SHIFT)];
  return tile * TILE_CELLS + ((y & TILE_MASK) << TILE_SHIFT) + (x & TILE_MASK);
}

#endif
