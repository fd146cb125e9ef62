/* The formula of an attention block. Included by test_attention_block.c once per type `real` of its arithmetic: as
 * FORMULA in double, the exact values, and in float, whose errors are the measure. */
#include <tgmath.h> /* exp, sqrt and others of the type of their argument */
#undef I            /* of complex.h */

#define NAMED_AS(function, name) function##_##name
#define NAMED(function, name)    NAMED_AS(function, name)
#define PART(name)               NAMED(FORMULA, name)

/* to = W gamma . (x - mean) / sd + beta of one row x [n] of floats or, if that is NULL, of y; W [m,n], bias or NULL */
static void PART(layer)(const float *x, const real *y, int64_t n, const float *gamma, const float *beta, int64_t m,
                        const float *weight, const float *bias, real *to) {
  real *u = calloc((size_t)n + 1, sizeof *u), mean = 0, square = 0;
  for (int64_t k = 0; k < n; k++) mean += (u[k] = x ? (real)x[k] : y[k]) / (real)n;
  for (int64_t k = 0; k < n; k++) square += (u[k] - mean) * (u[k] - mean) / (real)n;
  for (int64_t k = 0; k < n; k++) u[k] = (real)gamma[k] * (u[k] - mean) / sqrt(square + (real)1e-5) + (real)beta[k];
  for (int64_t o = 0; o < m; o++) {
    to[o] = bias ? (real)bias[o] : 0;
    for (int64_t k = 0; k < n; k++) to[o] += (real)weight[o * n + k] * u[k];
  }
  free(u);
}

/* H heads x [H,D] of one row, whose pairs are multiplied by the complex numbers `by` [D]; NULL: they stay */
static void PART(rotate)(real *x, int64_t H, int64_t D, const float *by) {
  for (int64_t i = 0; by && i < H * D; i += 2) {
    const real a = x[i], b = x[i + 1], c = (real)by[i % D], s = (real)by[i % D + 1];
    x[i] = a * c - b * s, x[i + 1] = a * s + b * c;
  }
}

static void FORMULA(const ast_attention_block *s, real *out) {
  const int64_t W = s->W, D = s->D, N = s->H * D, F = s->F;
  real *kv = calloc((size_t)(s->K * 2 * N) + 1, sizeof *kv),
       *rest = calloc((size_t)(2 * N + W + 2 * F + s->K), sizeof *kv);
  real *q = rest, *mixed = q + N, *y = mixed + N, *hidden = y + W, *w = hidden + 2 * F;
  for (int64_t j = 0; j < s->K; j++) {
    PART(layer)(s->context + j * s->C, NULL, s->C, s->context_gamma, s->context_beta, 2 * N, s->key_value, NULL,
                kv + j * 2 * N);
    PART(rotate)(kv + j * 2 * N, s->H, D, s->context_rotations ? s->context_rotations + j * D : NULL);
  }
  for (int64_t b = 0; b < s->B; b++)
    for (int64_t i = s->q_offsets[b]; i < s->q_offsets[b + 1]; i++) {
      const int64_t k0 = s->k_offsets[b], k1 = s->k_offsets[b + 1];
      PART(layer)(s->x + i * W, NULL, W, s->gamma, s->beta, N, s->query, NULL, q);
      PART(rotate)(q, s->H, D, s->rotations ? s->rotations + i * D : NULL);
      for (int64_t h = 0; h < s->H; h++) {
        real most = -INFINITY, sum = 0;
        for (int64_t d = 0; d < D; d++) mixed[h * D + d] = 0;
        for (int64_t j = k0; j < k1; j++) {
          w[j] = 0;
          for (int64_t d = 0; d < D; d++) w[j] += q[h * D + d] * kv[j * 2 * N + h * D + d] / sqrt((real)D);
          if (w[j] > most) most = w[j];
        }
        for (int64_t j = k0; j < k1; j++) sum += w[j] = exp(w[j] - most);
        for (int64_t j = k0; j < k1; j++)
          for (int64_t d = 0; d < D; d++) mixed[h * D + d] += w[j] / sum * kv[j * 2 * N + N + h * D + d];
      }
      for (int64_t o = 0; o < W; o++) {
        y[o] = (real)s->x[i * W + o] + (real)s->bias[o];
        for (int64_t k = 0; k < N; k++) y[o] += (real)s->weight[o * N + k] * mixed[k];
      }
      PART(layer)(NULL, y, W, s->inner_gamma, s->inner_beta, 2 * F, s->first, s->first_bias, hidden);
      for (int64_t k = 0; k < F; k++)
        hidden[k] *= hidden[F + k] * (real)0.5 * (1 + erf(hidden[F + k] * (real)0.70710678118654752));
      for (int64_t o = 0; o < W; o++) {
        out[i * W + o] = y[o] + (real)s->second_bias[o];
        for (int64_t k = 0; k < F; k++) out[i * W + o] += (real)s->second[o * F + k] * hidden[k];
      }
    }
  free(kv), free(rest);
}

#undef NAMED_AS
#undef NAMED
#undef PART
#undef real
#undef FORMULA
