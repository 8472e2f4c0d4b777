/* Let aligned grids vote cell by cell.
 *
 * Method: majority of unknown, free and occupied per cell; any tie for first place is occupied
 * ([F16]: two of three decide, three different values give 1); or walls with a tolerance, by weight. Twin:
 * slamfusion/compute/votes.py, by the same names. All integer, so kernel and twin agree exactly.
 *
 * Inputs are 1 to MOST_INPUTS grids of `cells` cells, each in its own buffer, so that none is copied
 * to be stacked; arguments beyond `count` are never read. Every work item takes `chunk` cells in a row (a
 * multiple of BLOCK_CELLS). Outputs: fused (cells) char -1 / 0 / 1; agreement (cells) char, share of the
 * votes for the winner in percent, rounded half up, -1 without votes; dissent (planes, pitch)
 * uchar, bit n % 8 of plane n / 8 set where input n voted otherwise than the winner, the pitch being
 * `cells` rounded up to BLOCK_CELLS; phantom (chunks) int, cells of the chunk that are occupied in the
 * fused grid and in no input.
 * Global: (chunks).
 */
#include "common.h"

/* PoCL leaves min as a call. */
#define LESS(a, b) ((a) < (b) ? (a) : (b))
#define GRID __global const uchar *
#define DISSENT_PITCH(cells) (((size_t)(cells) + BLOCK_CELLS - 1) / BLOCK_CELLS * BLOCK_CELLS)
#define GRIDS                                                                                     \
  GRID g0, GRID g1, GRID g2, GRID g3, GRID g4, GRID g5, GRID g6, GRID g7, GRID g8, GRID g9,       \
      GRID g10, GRID g11, GRID g12, GRID g13, GRID g14, GRID g15, GRID g16, GRID g17, GRID g18,   \
      GRID g19, GRID g20, GRID g21, GRID g22, GRID g23, GRID g24, GRID g25, GRID g26, GRID g27,   \
      GRID g28, GRID g29, GRID g30, GRID g31
#define GRID_LIST                                                                                 \
  {g0,  g1,  g2,  g3,  g4,  g5,  g6,  g7,  g8,  g9,  g10, g11, g12, g13, g14, g15,                \
   g16, g17, g18, g19, g20, g21, g22, g23, g24, g25, g26, g27, g28, g29, g30, g31}

/* -- the majority, 32 cells at once --------------------------------------------------------------
 * A block is four words of eight cells, one byte lane a cell. Counts stay below 64, so lanes add,
 * subtract and compare without a carry. A flag is 0 or 1 in each lane, a mask 0 or 255. */
#define EACH(value) ((ulong4)((ulong)(value) * EACH_LANE))
#define LOW EACH(0x01)
#define HIGH EACH(0x80)

INLINE ulong4 flag_at_least(const ulong4 a, const ulong4 b) { return (((a | HIGH) - b) >> 7) & LOW; }
INLINE ulong4 flag_zero(const ulong4 a) { return ((HIGH - a) >> 7) & LOW; }
INLINE ulong4 mask_of(const ulong4 flag) { return (flag << 8) - flag; }
INLINE bool any_lane(const ulong4 a) { return (a.x | a.y | a.z | a.w) != 0; }

/* Cells are 0xff, 0x00 and 0x01: the high bit says unknown, the low bit known as occupied or
 * unknown. */
INLINE ulong4 unknown_flag(const ulong4 cell) { return (cell >> 7) & LOW; }
INLINE ulong4 occupied_flag(const ulong4 cell) { return (cell & LOW) ^ unknown_flag(cell); }

/* Load or store a block, or what of it lies before the end of the grid. Word by word: compilers
 * make one vector access of it, while PoCL leaves vload4 and vstore4 as calls, at twice the time. */
INLINE ulong4 load_block(GRID from, const int cells) {
  ulong word[4] = {0, 0, 0, 0};
  if (cells >= BLOCK_CELLS) {
    __global const ulong *words = (__global const ulong *)from;
    return (ulong4)(words[0], words[1], words[2], words[3]);
  }
  for (int i = 0; i < cells; i++) ((uchar *)word)[i] = from[i];
  return (ulong4)(word[0], word[1], word[2], word[3]);
}

INLINE void store_block(const ulong4 block, __global uchar *to, const int cells) {
  const ulong word[4] = {block.x, block.y, block.z, block.w};
  if (cells >= BLOCK_CELLS) {
    __global ulong *words = (__global ulong *)to;
    words[0] = block.x;
    words[1] = block.y;
    words[2] = block.z;
    words[3] = block.w;
    return;
  }
  for (int i = 0; i < cells; i++) to[i] = ((const uchar *)word)[i];
}

/* Sum of the lanes of a flag. */
INLINE int count_lanes(const ulong4 flag) {
  const ulong word[4] = {flag.x, flag.y, flag.z, flag.w};
  int sum = 0;
  for (int i = 0; i < BLOCK_CELLS; i++) sum += ((const uchar *)word)[i];
  return sum;
}

/* One block of the vote; returns its phantom cells. Inlined, so that a constant count unrolls. */
INLINE int vote_block(
    GRID *grids, const int count, const int at, const int left, const size_t pitch,
    const ulong4 abstains, __global const ulong *shares, const int share_count,
    __global uchar *fused, __global uchar *agreement, __global uchar *dissent) {
  /* Count. */
  ulong4 occupied = 0, unknown = 0;
  for (int n = 0; n < count; n++) {
    const ulong4 cell = load_block(grids[n] + at, left);
    unknown += unknown_flag(cell);
    occupied += occupied_flag(cell);
  }
  const ulong4 free = EACH(count) - unknown - occupied;
  const ulong4 votes = EACH(count) - (unknown & abstains);

  /* Decide. */
  const ulong4 rival = unknown & ~abstains;
  const ulong4 silent = flag_zero(votes);
  const ulong4 tie = flag_zero(free ^ rival) & ~abstains;
  const ulong4 is_occupied =
      (flag_at_least(occupied, free) & flag_at_least(occupied, rival) & ~silent) | tie;
  const ulong4 is_unknown = (flag_at_least(rival, free) & ~is_occupied & ~abstains) | silent;
  const ulong4 occupied_mask = mask_of(is_occupied), unknown_mask = mask_of(is_unknown);
  const ulong4 winner = is_occupied | unknown_mask;
  store_block(winner, fused + at, left);

  /* Share of the winner. */
  const ulong4 own = (occupied & occupied_mask) | (rival & unknown_mask) |
                     (free & ~occupied_mask & ~unknown_mask);
  const ulong4 others = votes - own;
  ulong4 percent = EACH(100) | mask_of(silent);
  if (any_lane(others))
    for (int s = 0; s < share_count; s++) {
      const ulong4 differs = (own ^ shares[3 * s]) | (others ^ shares[3 * s + 1]);
      const ulong4 here = mask_of(flag_zero(differs));
      percent = (percent & ~here) | (shares[3 * s + 2] & here);
    }
  store_block(percent, agreement + at, left);

  /* Who was outvoted. */
  for (int first = 0; first < count; first += 8) {
    ulong4 bits = 0;
    for (int n = first; n < LESS(first + 8, count); n++) {
      const ulong4 cell = load_block(grids[n] + at, left);
      const ulong4 differs = cell ^ winner;
      const ulong4 voted = ~(unknown_flag(cell) & abstains);
      bits |= ((differs | (differs >> 7)) & LOW & voted) << (ulong)(n - first);
    }
    store_block(bits, dissent + (first / 8) * pitch + at, left);
  }

  /* Walls of no input. */
  const ulong4 invented = is_occupied & flag_zero(occupied);
  return any_lane(invented) ? count_lanes(invented) : 0;
}

/* unknown_votes: 1 where unknown is a value like the others, 0 where it abstains.
 * shares (share_count, 3) ulong: votes for the winner, votes for others (at least 1), percent, each
 * in all eight lanes; every pair that can occur. */
__kernel void vote_majority(GRIDS, const int count, const int cells, const int unknown_votes,
                            __global const ulong *shares, const int share_count, const int chunk,
                            __global uchar *fused, __global uchar *agreement,
                            __global uchar *dissent, __global int *phantom) {
  const int start = get_global_id(0) * chunk;
  if (start >= cells) return;
  const int stop = LESS(start + chunk, cells);
  const size_t pitch = DISSENT_PITCH(cells);
  GRID grids[MOST_INPUTS] = GRID_LIST;
  const ulong4 abstains = unknown_votes ? (ulong4)0 : ~(ulong4)0;
  int phantoms = 0, at = start;
  /* The usual case, three inputs and unknown a value, with constants: the block unrolls. */
  if (count == 3 && unknown_votes)
    for (; at + BLOCK_CELLS <= stop; at += BLOCK_CELLS)
      phantoms += vote_block(
          grids, 3, at, BLOCK_CELLS, pitch, 0, shares, share_count, fused, agreement, dissent);
  for (; at < stop; at += BLOCK_CELLS)
    phantoms += vote_block(grids, count, at, stop - at, pitch, abstains, shares, share_count, fused,
                           agreement, dissent);
  phantom[get_global_id(0)] = phantoms;
}

/* -- walls, with a tolerance and by weight ---------------------------------------------------------
 * Eight cells with no wall near are decided at once. Grids are codes of bits
 * (slamfusion/vote/walls.py). weights (count, block_rows, block_cols) uchar and ranks, ushort, of each
 * block of 2^shift cells on a side; row_phase, col_phase: place of the first cell in its block; trusted
 * (count) uchar, weights in all; reach: cells up to which a wall that faces the same way is the same
 * wall. The chunk is whole rows. */

/* Share of a part in the whole in percent, rounded half up; -1 of nothing. */
INLINE char share_percent(const int part, const int whole) {
  if (part == whole) return whole ? 100 : -1;
  return (char)((200 * part + whole) / (2 * whole));
}

/* Whether a wall at a cell stands that faces some ways. support, against: weights for it and against
 * it; moved: an input of weight 1/2 or more has the same wall elsewhere. */
INLINE bool wall_stands(GRID *grids, const int count, const int *weight, const int *trust,
                        const int at, const uchar ways, int *support, int *against, bool *moved) {
  int supported = 0;
  *support = *against = 0;
  *moved = false;
  for (int n = 0; n < count; n++) {
    const uchar code = grids[n][at];
    const bool same = (code >> WALL_SIDES) & ways;
    if (code & WALL_NEAR) {
      *support += weight[n];
      supported += trust[n];
    } else if (same || (code & WALL_FREE)) {
      *against += weight[n];
      *moved |= same && 2 * weight[n] >= VOTE_ONE;
    }
  }
  return 2 * supported >= VOTE_ONE && (*moved ? 3 : 2) * *support >= 2 * *against;
}

/* Whether the nearest wall of one input stands that faces some ways, up to `reach` cells from cell i
 * along a row or column, or next to that line. */
INLINE bool stands_elsewhere(GRID *grids, const int count, const int *weight, const int *trust,
                             GRID own, const int i, const uchar ways, const int reach,
                             const int width, const int cells) {
  const int col = i % width;
  for (int step = 1; step <= reach; step++)
    for (int side = 0; side < 4; side++) {
      const bool along_row = side < 2;
      if (!(ways & (along_row ? ALONG_ROW : ALONG_COL))) continue;
      for (int aside = -1; aside <= 1; aside++) {
        const int far = side & 1 ? -step : step;
        const int right = along_row ? far : aside, down = along_row ? aside : far;
        const int at = i + down * width + right;
        if (col + right < 0 || col + right >= width || at < 0 || at >= cells) continue;
        const uchar faced = own[at] >> WALL_SIDES;
        if (!(own[at] & WALL_OCCUPIED) || !(faced & ways)) continue;
        int support, against;
        bool moved;
        return wall_stands(grids, count, weight, trust, at, faced, &support, &against, &moved);
      }
    }
  return false;
}

__kernel void vote_walls(GRIDS, const int count, const int cells, __global const uchar *weights,
                         __global const ushort *ranks, __global const uchar *trusted,
                         const int width, const int reach, const int shift, const int row_phase,
                         const int col_phase, const int block_rows, const int block_cols,
                         const int chunk, __global char *fused, __global char *agreement,
                         __global uchar *dissent, __global int *phantom) {
  const int start = get_global_id(0) * chunk;
  if (start >= cells) return;
  const int stop = LESS(start + chunk, cells);
  const size_t pitch = DISSENT_PITCH(cells);
  GRID grids[MOST_INPUTS] = GRID_LIST;
  int weight[MOST_INPUTS], rank[MOST_INPUTS], trust[MOST_INPUTS];
  for (int n = 0; n < count; n++) trust[n] = trusted[n];
  int block = -1;
  /* Whether each input that has a weight here may free a cell alone. */
  bool alone = false;
  for (int i = start; i < stop; i++) {
    const int row = i / width, col = i - row * width;
    const int here = ((row + row_phase) >> shift) * block_cols + ((col + col_phase) >> shift);
    if (here != block) {
      block = here;
      alone = true;
      for (int n = 0; n < count; n++) {
        weight[n] = weights[n * block_rows * block_cols + block];
        rank[n] = ranks[n * block_rows * block_cols + block];
        alone &= weight[n] == 0 || 2 * trust[n] >= VOTE_ONE;
      }
    }
    if (alone && (i & 7) == 0 && col + 8 <= width && i + 8 <= stop &&
        (col + 7 + col_phase) >> shift == (col + col_phase) >> shift) {
      ulong near = 0, free = 0;
      for (int n = 0; n < count; n++) {
        const ulong word = *(__global const ulong *)(grids[n] + i);
        near |= word & (WALL_NEAR * EACH_LANE);
        if (weight[n] > 0) free |= word & (WALL_FREE * EACH_LANE);
      }
      if (near == 0) {
        const ulong lanes = free / WALL_FREE, known = (lanes << 8) - lanes;
        *(__global ulong *)(fused + i) = ~known;
        *(__global ulong *)(agreement + i) = ~known | lanes * 100;
        for (int first = 0; first < count; first += 8) {
          ulong bits = 0;
          for (int n = first; n < LESS(first + 8, count); n++) {
            const ulong word = *(__global const ulong *)(grids[n] + i);
            bits |= ((word / WALL_FREE) & EACH_LANE & ~lanes) << (n - first);
          }
          *(__global ulong *)(dissent + (first / 8) * pitch + i) = bits;
        }
        i += 7;
        continue;
      }
    }

    /* Who draws here, and what is for free. */
    int highest = -1, freeing = 0, freed = 0, walls = 0;
    uchar shown = 0, any = 0;
    for (int n = 0; n < count; n++) {
      const uchar code = grids[n][i];
      any |= code;
      if ((code & WALL_NEAR) && weight[n] > 0 && rank[n] > highest) {
        highest = rank[n];
        shown = code;
      }
      if (code & WALL_FREE) {
        freeing += weight[n];
        freed += trust[n];
      }
      if (code & WALL_OCCUPIED) walls += weight[n];
    }
    const bool is_free = freeing > 0 && 2 * freed >= VOTE_ONE;
    if (!(any & WALL_NEAR)) {
      /* The usual case: no wall anywhere near. */
      fused[i] = is_free ? FREE : UNKNOWN;
      agreement[i] = is_free ? 100 : -1;
      for (int first = 0; first < count; first += 8) {
        uchar bits = 0;
        if (!is_free)
          for (int n = first; n < LESS(first + 8, count); n++)
            bits |= ((grids[n][i] & WALL_FREE) != 0) << (n - first);
        dissent[(first / 8) * pitch + i] = bits;
      }
      continue;
    }

    /* A wall is drawn where it stands, unless a better map draws it elsewhere, and it stands there. */
    const uchar ways = (shown & WALL_OCCUPIED) ? shown >> WALL_SIDES : 0;
    int support, against;
    bool moved;
    bool stands =
        wall_stands(grids, count, weight, trust, i, ways, &support, &against, &moved) && highest >= 0;
    for (int n = 0; stands && moved && n < count; n++) {
      const uchar code = grids[n][i], both = (code >> WALL_SIDES) & ways;
      if (both && !(code & WALL_NEAR) && 2 * weight[n] >= VOTE_ONE && rank[n] > highest)
        stands = !stands_elsewhere(
            grids, count, weight, trust, grids[n], i, both, reach, width, cells);
    }
    const int winner = stands && (shown & WALL_OCCUPIED) ? OCCUPIED : is_free ? FREE : UNKNOWN;
    fused[i] = (char)winner;
    agreement[i] = winner == OCCUPIED ? share_percent(support, support + against)
                   : winner == FREE   ? share_percent(freeing, freeing + walls)
                                      : -1;
    for (int first = 0; first < count; first += 8) {
      uchar bits = 0;
      for (int n = first; n < LESS(first + 8, count); n++) {
        const uchar code = grids[n][i];
        const bool same = (code >> WALL_SIDES) & ways, free = (code & WALL_FREE) != 0;
        const bool out = winner == OCCUPIED
                             ? !(code & WALL_NEAR) && (free || same)
                             : !stands && ((code & WALL_OCCUPIED) || (free && winner != FREE));
        bits |= out << (n - first);
      }
      dissent[(first / 8) * pitch + i] = bits;
    }
  }
  phantom[get_global_id(0)] = 0;
}
