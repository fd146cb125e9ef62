/* What attention and its gradient are built of: scores of panels, and products on register tiles.
 *
 * A panel is LANES rows across the lanes: of queries in the forward pass, whose scores are held transposed,
 * x[key][query], so that maximum and sum of a row of the softmax are operations between vectors, never within one; of
 * keys in the backward pass, x[query][key]. Every array that a product reads row by row has rows ROW floats apart: a
 * constant, so that a tile needs one pointer for each operand, and no power of two, which would crowd few cache sets.
 * Products add in rising order of the summed index, in every tile alike: a score has the same bits forward and
 * backward. A score is a sum of chains of SCORE_DEPTH products: its error, times its own size, is the error of a
 * weight.
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

/* Queries carry a scale up to 1, so that no product overflows which the scaled one does not; a larger one is left for
 * the scores, as scale q could overflow where the score does not. */
AST_INLINE float attention_scale_of_queries(float scale) { return fabsf(scale) > 1 ? 1 : scale; }
AST_INLINE float attention_scale_of_scores(float scale) { return fabsf(scale) > 1 ? scale : 1; }

/* ---- register tiles ---- */

/* x[row][lane] = (x[row][lane] +) a[row] . b[lane] over D channels for a tile of rows; raises largest[2], unless NULL,
 * to the maximum of x. */
AST_INLINE void attention_chain_tile(const int rows, const bool add, int64_t D, const float *a, const float *b,
                                     float *x, vf *largest) {
  vf sum[GEMM_ROWS][2];
  gemm_product(rows, 2, D, (gemm_a){a, ROW, 1}, b, LANES, sum);
  EACH(rows, r) EACH(2, j) {
    float *to = x + r * ROW + j * VW;
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

AST_INLINE void attention_chain_strip(int64_t n, const bool add, int64_t D, const float *a, const float *b, float *x,
                                      vf *largest) {
#define CHAIN_TILE(rows) attention_chain_tile(rows, add, D, a + i * ROW, b, x + i * ROW, largest)
  EACH_TILE_OF_ROWS(i, n, CHAIN_TILE);
#undef CHAIN_TILE
}

/* x[row][lane] = a[row] . b[lane] for n rows, chain after chain; raises largest[2], unless NULL, to the maximum. */
static void attention_scores(int64_t n, int64_t D, const float *a, const float *b, float *x, vf *largest) {
  attention_chain_strip(n, false, min64(D, SCORE_DEPTH), a, b, x, D > SCORE_DEPTH ? NULL : largest);
  for (int64_t d = SCORE_DEPTH; d < D; d += SCORE_DEPTH)
    attention_chain_strip(n, true, min64(D - d, SCORE_DEPTH), a + d, b + d * LANES, x,
                          D > d + SCORE_DEPTH ? NULL : largest);
}

/* c[i][j] = factor[i] c[i][j] + sum_k a_ki b[k][j], or the sum alone without a factor; rows ROW apart */
AST_INLINE void attention_faded_tile(const int rows, const int vectors, int64_t K, const float *a, const float *b,
                                     float *c, const float *factor) {
  vf sum[GEMM_ROWS][2];
  gemm_product(rows, vectors, K, (gemm_a){a, 1, ROW}, b, ROW, sum);
  if (factor) TILE_EACH(i, j) sum[i][j] += factor[i] * vload(c + i * ROW + j * VW);
  TILE_EACH(i, j) vstore(c + i * ROW + j * VW, sum[i][j]);
}

AST_INLINE void attention_faded_strip(const int vectors, int64_t M, int64_t K, const float *a, const float *b, float *c,
                                      const float *factor) {
#define FADED_TILE(rows) attention_faded_tile(rows, vectors, K, a + i, b, c + i * ROW, factor ? factor + i : NULL)
  EACH_TILE_OF_ROWS(i, M, FADED_TILE);
#undef FADED_TILE
}

/* The same for C [M,N], N a multiple of VW. */
static inline void attention_faded_product(int64_t M, int64_t N, int64_t K, const float *a, const float *b, float *c,
                                           const float *factor) {
  for (int64_t j = 0; j < N; j += GEMM_COLUMNS) {
    if (N - j >= GEMM_COLUMNS) attention_faded_strip(2, M, K, a, b + j, c + j, factor);
    else attention_faded_strip(1, M, K, a, b + j, c + j, factor);
  }
}

/* ---- rows and panels ---- */

/* x_dj = from[j][d] for VW rows and VW channels; rows from `rows` on are 0 and not read */
AST_INLINE void attention_load_transposed(const float *from, int64_t stride, int64_t rows, vf x[VW]) {
  EACH(VW, j) x[j] = j < rows ? vload(from + j * stride) : (vf){0};
  vtranspose(x);
}

/* panel[d][lane] = factor from[lane][d] for at most LANES rows; the panel's other lanes are 0 */
static void attention_pack_panel(const float *from, int64_t stride, int64_t rows, int64_t D, float factor,
                                 float *panel) {
  for (int64_t j = 0; j < LANES; j += VW)
    for (int64_t d = 0; d < D; d += VW) {
      vf x[VW];
      attention_load_transposed(from + j * stride + d, stride, rows - j, x);
      EACH(VW, i) vstore(panel + (d + i) * LANES + j, factor * x[i]);
    }
}

/* to[i] = factor from[i], rows ROW apart, and once more the last of them up to a whole ROW_STEP: a key that comes twice
 * changes no maximum */
static void attention_copy_rows(const float *from, int64_t stride, int64_t rows, int64_t D, float factor, float *to) {
  for (int64_t i = 0; i < round_up(rows, ROW_STEP); i++)
    for (int64_t d = 0; d < D; d += VW)
      vstore(to + i * ROW + d, factor * vload(from + min64(i, rows - 1) * stride + d));
}

static void attention_fill_rows(float value, int64_t stride, int64_t rows, int64_t D, float *to) {
  for (int64_t i = 0; i < rows; i++)
    for (int64_t d = 0; d < D; d++) to[i * stride + d] = value;
}

/* Asks for the lines of rows that will soon be read, or written: at their use each would wait for memory. */
AST_INLINE void attention_prefetch_rows(const float *from, int64_t stride, int64_t rows, int64_t D, const int write) {
  for (int64_t i = 0; i < rows; i++)
    for (int64_t d = 0; d < D; d += 16) {
      if (write) __builtin_prefetch(from + i * stride + d, 1, 2);
      else __builtin_prefetch(from + i * stride + d, 0, 2);
    }
}

#endif
