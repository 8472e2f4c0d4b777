/* Tiles of a pool: copied before they are written, and fetched.
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
