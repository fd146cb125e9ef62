/* LayerNorm of rows y of n channels, in both directions, for mlp.c, message.c and attention_block.c.
 *
 *   u = (y - mean(y)) / sd,   sd = sqrt(var(y) + eps),   out = gamma . u + beta
 *   p = gamma . dout,   dy = (p - mean(p) - u mean(p . u)) / sd,   dgamma = sum of dout . u,   dbeta = sum of dout
 *
 * The mean is taken of the differences y - y_0 to the first value, the variance of their squared differences to the
 * mean, in a second pass over a row in the cache. Of nearly equal values the differences are exact; of a large mean the
 * rounding would stay in all of them. No difference is larger than twice the largest one to the mean, so none loses
 * digits that count.
 *
 * Rows are readable and writable up to whole vectors; `whole`, a constant, says that n is a multiple of VW, so that no
 * vector asks for its tail.
 */
#ifndef AST_NORM_H
#define AST_NORM_H

#include <math.h>

#include "simd.h"

static const float NORM_EPSILON = 1e-5f;

/* the first n lanes of x, 0 in the others */
AST_INLINE vf norm_lanes(vf x, int64_t n) { return n >= VW ? x : (vf)((vi)x & (LANE_INDICES < (int32_t)n)); }

/* 1 / sd of n differences to the mean whose squares are too large for a float; NaN if one of them is not finite. */
static __attribute__((noinline)) float norm_of_large(const float *d, int64_t n) {
  float squares = 0;
  for (int64_t c = 0; c < n; c++) squares += (0x1p-100f * d[c]) * (0x1p-100f * d[c]);
  return squares < INFINITY ? 0x1p-100f / sqrtf(squares / (float)n) : NAN;
}

/* y becomes y - mean(y), 0 behind its n channels; returns 1 / sd, the factor that makes u of it. */
AST_INLINE float norm_centre(float *y, int64_t n, const bool whole) {
  const vf first = vsplat(y[0]);
  vf sum = {0}, squares = {0};
  for (int64_t c = 0; c < n; c += VW) sum += whole ? vload(y + c) - first : norm_lanes(vload(y + c) - first, n - c);
  const float mean = vsum(sum) / (float)n; /* of y - y_0 */
  for (int64_t c = 0; c < n; c += VW) {
    const vf difference = (vload(y + c) - first) - mean, d = whole ? difference : norm_lanes(difference, n - c);
    squares += d * d;
    vstore(y + c, d);
  }
  const float variance = vsum(squares) / (float)n;
  return variance < INFINITY ? 1 / sqrtf(variance + NORM_EPSILON) : norm_of_large(y, n);
}

/* gamma . u + beta of the lanes from channel c on, u = scale (y - mean(y)) */
AST_INLINE vf norm_out(vf u, const float *gamma, const float *beta, int64_t c, int64_t lanes) {
  return vload_upto(gamma + c, lanes) * u + vload_upto(beta + c, lanes);
}

/* Of some rows: what dgamma and dbeta are so far, each in chains of every fourth row, and room for p of one. */
enum { NORM_CHAINS = 4, NORM_COLUMNS = 2 * NORM_CHAINS + 1 /* rows in all */ };

typedef struct {
  float *dgamma, *dbeta, *p; /* [NORM_CHAINS,row], the same, [row] */
  int64_t row;
} norm_columns;

AST_INLINE norm_columns norm_new_columns(float *memory, int64_t row) {
  return (norm_columns){memory, memory + NORM_CHAINS * row, memory + 2 * NORM_CHAINS * row, row};
}

AST_INLINE void norm_clear_columns(const norm_columns *columns) {
  memset(columns->dgamma, 0, (size_t)(2 * NORM_CHAINS * columns->row) * sizeof(float));
}

/* Row i: y, from norm_centre, becomes dy. dout and `also`, unless NULL, are added; u is read if it was kept, and y is
 * not then. */
AST_INLINE void norm_backward(int64_t i, int64_t n, const bool whole, const float *gamma, const float *dout,
                              const float *also, float scale, const float *u_kept, float *y,
                              const norm_columns *columns) {
  const int64_t chain = i % NORM_CHAINS * columns->row;
  float *dgamma = columns->dgamma + chain, *dbeta = columns->dbeta + chain, *p = columns->p;
  vf sum = {0}, along = {0};
  for (int64_t c = 0; c < n; c += VW) {
    const int64_t lanes = whole ? VW : n - c;
    const vf u = u_kept ? vload_upto(u_kept + c, lanes) : scale * vload(y + c);
    vf d = vload_upto(dout + c, lanes);
    if (also) d += vload_upto(also + c, lanes);
    const vf p_c = vload_upto(gamma + c, lanes) * d; /* forward: out = gamma u + beta */
    vstore(y + c, u);
    vstore(p + c, p_c); /* not computed twice: fused into the difference below it would not cancel */
    sum += p_c;
    along += p_c * u;
    vstore(dgamma + c, vload(dgamma + c) + d * u);
    vstore(dbeta + c, vload(dbeta + c) + d);
  }
  const float mean = vsum(sum) / (float)n, mean_along = vsum(along) / (float)n;
  /* forward: u = (y - mean(y)) / sd, both of which depend on y */
  for (int64_t c = 0; c < n; c += VW) vstore(y + c, scale * ((vload(p + c) - mean) - vload(y + c) * mean_along));
}

#endif
