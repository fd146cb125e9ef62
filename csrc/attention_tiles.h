/* What attention and its gradient are built of: scores of panels, and products on register tiles.
 *
 * A panel is LANES rows across the lanes: of queries in the forward pass, whose scores are held transposed,
 * x[key][query], so that maximum and sum of a row of the softmax are operations between vectors, never within one; of
 * keys in the backward pass, x[query][key]. Every array that a product reads row by row has rows ROW floats apart: a
 * constant, so that a tile needs one pointer for each operand, and no power of two, which would crowd few cache sets.
 * Products add in rising order of the summed index, in every tile alike: a score has the same bits forward and
 * backward. A score is a sum of chains of SCORE_DEPTH products: its error, times its own size, is that of a weight.
 *
 * Legend: n keys of a block, D channels of a head; A read by broadcast, B in vectors, C in GEMM_ROWS x 2 vectors of
 * registers.
 */
#ifndef AST_ATTENTION_TILES_H
#define AST_ATTENTION_TILES_H

#include <math.h>

#include "gemm.h"

enum {
  LANES = GEMM_COLUMNS, /* rows of a panel */
  KEYS = 128,           /* keys of a block: its scores against a panel of queries stay in the first cache */
  MAX_D = 128,          /* channels of a head */
  ROW = MAX_D + 16,     /* floats from row to row */
  SCORE_DEPTH = 64,     /* products of one chain of a score at most: their rounding errors grow with their number */
  ROW_STEP = 4,         /* products compute rows in multiples of this: 90 keys cost 92 */
};

/* ---- register tiles ---- */

/* Rows of the next tile when `rest`, a multiple of ROW_STEP, are left: no tile of 4 follows one of 12. */
AST_INLINE int64_t next_tile(int64_t rest) {
  if (GEMM_ROWS == 12) return rest == 16 ? 8 : rest >= 12 ? 12 : rest >= 8 ? 8 : 4;
  if (GEMM_ROWS == 6) return rest >= 6 && rest != 8 ? 6 : 4;
  return 4;
}

/* Functions of their own for the tiles of GEMM_ROWS, 8 and 4 rows of `f`: inlined, their loops would compete for
 * registers. */
#define TILE_FUNCTIONS(f, parameters, ...)                                                          \
  static __attribute__((noinline)) void f##_whole parameters { f(GEMM_ROWS, __VA_ARGS__); }         \
  static __attribute__((noinline)) void f##_8 parameters { f(GEMM_ROWS < 8 ? 4 : 8, __VA_ARGS__); } \
  static __attribute__((noinline)) void f##_4 parameters { f(4, __VA_ARGS__); }

/* Calls them for the tiles i..i+rows of all n rows. */
#define EACH_TILE(n, f, ...)                                    \
  for (int64_t tile_ = 0, rows_; tile_ < (n); tile_ += rows_) { \
    rows_ = next_tile((n) - tile_);                             \
    if (rows_ == GEMM_ROWS) f##_whole(tile_, __VA_ARGS__);      \
    else if (rows_ == 8) f##_8(tile_, __VA_ARGS__);             \
    else f##_4(tile_, __VA_ARGS__);                             \
  }

/* x[row][lane] = (x[row][lane] +) a[row] . b[lane] over D channels for a tile of rows; raises largest[2], unless NULL,
 * to the maximum of x. */
AST_INLINE void chain_tile(const int rows, const bool add, int64_t i, int64_t D, const float *a, const float *b,
                           float *x, vf *largest) {
  vf sum[GEMM_ROWS][2];
  gemm_product(rows, 2, D, (gemm_a){a + i * ROW, ROW, 1}, b, LANES, sum);
  EACH(rows, r) EACH(2, j) {
    float *to = x + (i + r) * ROW + j * VW;
    if (add) sum[r][j] += vload(to);
    vstore(to, sum[r][j]);
  }
  if (!largest) return;
  EACH(2, j) {
    vf m = largest[j];
    EACH(rows, r) m = vmax(sum[r][j], m);
    largest[j] = m;
  }
}
#define CHAIN_TILE(name, add)                                                                                         \
  AST_INLINE void name(const int rows, int64_t i, int64_t D, const float *a, const float *b, float *x, vf *largest) { \
    chain_tile(rows, add, i, D, a, b, x, largest);                                                                    \
  }                                                                                                                   \
  TILE_FUNCTIONS(name, (int64_t i, int64_t D, const float *a, const float *b, float *x, vf *largest), i, D, a, b, x,  \
                 largest)
CHAIN_TILE(first_chain, false)
CHAIN_TILE(next_chain, true)
#undef CHAIN_TILE

/* x[row][lane] = a[row] . b[lane] for n rows, chain after chain; raises largest[2], unless NULL, to the maximum of x.
 */
static void scores_product(int64_t n, int64_t D, const float *a, const float *b, float *x, vf *largest) {
  EACH_TILE(n, first_chain, min64(D, SCORE_DEPTH), a, b, x, D > SCORE_DEPTH ? NULL : largest)
  for (int64_t d = SCORE_DEPTH; d < D; d += SCORE_DEPTH)
    EACH_TILE(n, next_chain, min64(D - d, SCORE_DEPTH), a + d, b + d * LANES, x, D > d + SCORE_DEPTH ? NULL : largest)
}

/* c[i][j] = factor[i] c[i][j] + sum_k a_ki b[k][j], or the sum alone without a factor; rows ROW apart */
AST_INLINE void faded_tile(const int rows, const int vectors, int64_t i, int64_t K, const float *a, const float *b,
                           float *c, const float *factor) {
  vf sum[GEMM_ROWS][2];
  gemm_product(rows, vectors, K, (gemm_a){a + i, 1, ROW}, b, ROW, sum);
  c += i * ROW;
  if (factor) TILE_EACH(r, j) sum[r][j] += factor[i + r] * vload(c + r * ROW + j * VW);
  TILE_EACH(r, j) vstore(c + r * ROW + j * VW, sum[r][j]);
}

#define FADED_TILE(name, vectors)                                                                                      \
  AST_INLINE void name(const int rows, int64_t i, int64_t K, const float *a, const float *b, float *c,                 \
                       const float *factor) {                                                                          \
    faded_tile(rows, vectors, i, K, a, b, c, factor);                                                                  \
  }                                                                                                                    \
  TILE_FUNCTIONS(name, (int64_t i, int64_t K, const float *a, const float *b, float *c, const float *factor), i, K, a, \
                 b, c, factor)
FADED_TILE(wide_tile, 2)
FADED_TILE(narrow_tile, 1)
#undef FADED_TILE

/* The same for C [M,N]; M a multiple of ROW_STEP, N one of VW. */
static void faded_product(int64_t M, int64_t N, int64_t K, const float *a, const float *b, float *c,
                          const float *factor) {
  int64_t j = 0;
  for (; j + 2 * VW <= N; j += 2 * VW) EACH_TILE(M, wide_tile, K, a, b + j, c + j, factor)
  if (j < N) EACH_TILE(M, narrow_tile, K, a, b + j, c + j, factor)
}

/* ---- rows and panels ---- */

/* x_dj = from[j][d] for VW rows and VW channels; rows from `rows` on are 0 and not read */
AST_INLINE void load_transposed(const float *from, int64_t stride, int64_t rows, vf x[VW]) {
  EACH(VW, j) x[j] = j < rows ? vload(from + j * stride) : (vf){0};
  vtranspose(x);
}

/* panel[d][lane] = factor from[lane][d] for at most LANES rows; the panel's other lanes are 0 */
static void pack_panel(const float *from, int64_t stride, int64_t rows, int64_t D, float factor, float *panel) {
  for (int64_t j = 0; j < LANES; j += VW)
    for (int64_t d = 0; d < D; d += VW) {
      vf x[VW];
      load_transposed(from + j * stride + d, stride, rows - j, x);
      EACH(VW, i) vstore(panel + (d + i) * LANES + j, factor * x[i]);
    }
}

/* to[i] = factor from[i], rows ROW apart, and once more the last of them up to a whole ROW_STEP: a key that comes twice
 * changes no maximum */
static void copy_rows(const float *from, int64_t stride, int64_t rows, int64_t D, float factor, float *to) {
  for (int64_t i = 0; i < round_up(rows, ROW_STEP); i++)
    for (int64_t d = 0; d < D; d += VW)
      vstore(to + i * ROW + d, factor * vload(from + min64(i, rows - 1) * stride + d));
}

static void fill_rows(float value, int64_t stride, int64_t rows, int64_t D, float *to) {
  for (int64_t i = 0; i < rows; i++)
    for (int64_t d = 0; d < D; d++) to[i * stride + d] = value;
}

/* Asks for the lines of rows that will soon be read, or written: at their use each would wait for memory. */
AST_INLINE void prefetch_rows(const float *from, int64_t stride, int64_t rows, int64_t D, const int write) {
  for (int64_t i = 0; i < rows; i++)
    for (int64_t d = 0; d < D; d += 16) {
      if (write) __builtin_prefetch(from + i * stride + d, 1, 2);
      else __builtin_prefetch(from + i * stride + d, 0, 2);
    }
}

#endif
