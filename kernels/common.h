/* Shared by every kernel family.
 *
 * Constants and records that the host knows too stand in slamfusion/compute/layout.py and come as -D
 * options. What a kernel alone knows is defined in it.
 *
 * Cells are trinary: -1 unknown, 0 free, 1 occupied; grids are row-major, row grows with +y.
 * A lattice position is in half cells, so the centre of cell (row, col) is (2 col + 1, 2 row + 1)
 * and stays an integer. A fixed pose is four longs in Q30: cos, sin, tx, ty with tx and ty in half
 * cells; it maps a lattice position exactly, so that a kernel and its NumPy twin read the same cell.
 */
#ifndef SLAMFUSION_COMMON_H
#define SLAMFUSION_COMMON_H

/* PoCL defines `inline` as nothing, and a loop with a call in it is not vectorised. */
#define INLINE inline __attribute__((always_inline))

/* Cell (x = col, y = row) under a lattice position after a fixed pose. */
INLINE int2 fixed_cell(const long4 pose, const int x2, const int y2) {
  const long x = pose.x * x2 - pose.y * y2 + pose.z;
  const long y = pose.y * x2 + pose.x * y2 + pose.w;
  return (int2)((int)(x >> FIXED_TO_CELL_SHIFT), (int)(y >> FIXED_TO_CELL_SHIFT));
}

/* Vectors that no register of the processor holds are converted in place: PoCL 3.0 cannot read back a
 * program of its cache in which such a vector is an argument of a call. */
#ifdef ONE_THREAD_A_GROUP
#define CONVERT(type, vector) __builtin_convertvector(vector, type)
#else
#define CONVERT(type, vector) convert_##type(vector)
#endif

/* PoCL 3.0 leaves its builtins (vload, vstore, min, max, sqrt, floor) as function calls, and a call
 * spills every vector register around it. So hot loops read 32 bytes by plain loads where the device
 * takes any address, compare instead of calling min, and cut to int instead of calling floor.
 * IN_LANES stands ahead of a loop of gathers: clang takes them for too dear to vectorise, and is
 * wrong. */
#ifdef UNALIGNED_WORDS
#define IN_LANES _Pragma("clang loop vectorize_width(16)")
#define WORD(p, i) (((__global const ulong *)(p))[i])
#define LOAD16(p) as_uchar16((ulong2)(WORD(p, 0), WORD(p, 1)))
#define LOAD32(p) ((ulong4)(WORD(p, 0), WORD(p, 1), WORD(p, 2), WORD(p, 3)))
INLINE void store32(const ulong4 words, __global ulong *to) {
  to[0] = words.x;
  to[1] = words.y;
  to[2] = words.z;
  to[3] = words.w;
}
#define STORE32(words, p) store32(words, (__global ulong *)(p))
#define LOWEST_BIT(bits) __builtin_ctzl(bits)
#define LOWER(a, b) ((a) < (b) ? (a) : (b))
#define HIGHER(a, b) ((a) > (b) ? (a) : (b))
#else
#define IN_LANES
#define LOAD16(p) vload16(0, p)
INLINE ulong4 load32(__global const uchar *p) {
  const uchar16 a = vload16(0, p), b = vload16(1, p);
  return (ulong4)(as_ulong2(a), as_ulong2(b));
}
#define LOAD32(p) load32((__global const uchar *)(p))
INLINE void store32(const ulong4 words, __global uchar *to) {
  vstore16(as_uchar16(words.lo), 0, to);
  vstore16(as_uchar16(words.hi), 1, to);
}
#define STORE32(words, p) store32(words, (__global uchar *)(p))
#define LOWEST_BIT(bits) ((int)popcount(((bits) & -(bits)) - 1))
#define LOWER(a, b) min(a, b)
#define HIGHER(a, b) max(a, b)
#endif

#endif
