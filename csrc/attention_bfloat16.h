/* Both products of attention with factors rounded to bfloat16: scores of a panel of queries, x[key][query], and the
 * weighted values, transposed so that the keys run along the rows of one factor and the pairs of the other:
 *
 *   x_kq = sum_d r(K_kd) r(Q_qd),   o_dq = sum_k r(V_kd) r(w_kq)
 *
 * Keys and values of a block are rounded once for all panels, queries once for all blocks.
 */
#ifndef AST_ATTENTION_BFLOAT16_H
#define AST_ATTENTION_BFLOAT16_H

#include "attention_tiles.h"
#include "bfloat16.h"

enum { ROUNDED_ROW = MAX_D + BFLOAT16_STEP }; /* numbers from row to row of keys, and of values by channel */
_Static_assert((int)KEYS == (int)MAX_D && KEYS % 16 == 0, "both have rows of one length, and fill tiles");

typedef struct {
  uint16_t keys[KEYS * ROUNDED_ROW], values[MAX_D * ROUNDED_ROW]; /* [key][channel], [channel][key] */
  float transposed[ROW];
  float weights[KEYS / 2 * GEMM_COLUMNS], sums[MAX_D * GEMM_COLUMNS];
} attention_rounded;

/* A panel of queries [D][LANES] in pairs, filled up to whole steps. */
static void attention_round_queries(const float *panel, int64_t D, float *pairs) {
  for (int64_t d = 0; d < D; d += BFLOAT16_STEP) {
    float step[BFLOAT16_STEP * GEMM_COLUMNS] = {0};
    memcpy(step, panel + d * LANES, (size_t)(min64(BFLOAT16_STEP, D - d) * LANES) * sizeof *step);
    bfloat16_pack(step, GEMM_COLUMNS, pairs + d / 2 * GEMM_COLUMNS);
  }
}

/* n keys and values, rows ROW apart. */
static void attention_round_block(int64_t n, int64_t D, const float *keys, const float *values, attention_rounded *t) {
  for (int64_t k = 0; k < n; k++) bfloat16_round_row(keys + k * ROW, D, t->keys + k * ROUNDED_ROW);
  for (int64_t d = 0; d < D; d++) {
    for (int64_t k = 0; k < n; k++) t->transposed[k] = values[k * ROW + d];
    bfloat16_round_row(t->transposed, n, t->values + d * ROUNDED_ROW);
  }
}

/* The scores of n keys, rows ROW apart, and their maximum. */
static void attention_rounded_scores(int64_t n, int64_t D, const float *queries, attention_rounded *t, float *x,
                                     vf largest[2]) {
  bfloat16_products(n, round_up(D, BFLOAT16_STEP), t->keys, ROUNDED_ROW, queries, x, ROW, false);
  for (int64_t k = 0; k < n; k++) EACH(2, c) largest[c] = vmax(vload(x + k * ROW + c * VW), largest[c]);
}

/* out[query] = fade[query] out[query] + the values weighted by n rows w[key], or these alone; all rows ROW apart. The
 * rows of w up to a whole step become 0. */
static void attention_rounded_product(int64_t D, int64_t n, float *w, attention_rounded *t, float *out,
                                      const float *fade) {
  const int64_t depth = round_up(n, BFLOAT16_STEP);
  for (int64_t k = n; k < depth; k++) memset(w + k * ROW, 0, LANES * sizeof *w);
  for (int64_t k = 0; k < depth; k += BFLOAT16_STEP) bfloat16_pack(w + k * ROW, ROW, t->weights + k / 2 * GEMM_COLUMNS);
  bfloat16_products(D, depth, t->values, ROUNDED_ROW, t->weights, t->sums, GEMM_COLUMNS, false);
  for (int64_t q = 0; q < LANES; q += VW)
    for (int64_t d = 0; d < D; d += VW) {
      vf x[VW];
      EACH(VW, i) x[i] = vload(t->sums + (d + i) * GEMM_COLUMNS + q);
      vtranspose(x);
      EACH(VW, i) {
        float *to = out + (q + i) * ROW + d;
        vstore(to, fade ? fade[q + i] * vload(to) + x[i] : x[i]);
      }
    }
}

#endif
