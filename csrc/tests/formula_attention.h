/* The formula of out, log sum exp and gradients of attention. Included by test_attention.c once per type `real` of its
 * arithmetic: as FORMULA in double, the exact values, and in float, whose errors are the measure. */
#include <tgmath.h> /* exp, sqrt and others of the type of their argument */
#undef I            /* of complex.h */

static void FORMULA(const problem *a, real *out, real *lse, real *dq, real *dk, real *dv) {
  const ast_attention s = sizes_of(a);
  const int64_t D = a->D, row = a->H * D;
  real *w = calloc((size_t)(a->Tk + 1) * 2, sizeof *w), *z = w + a->Tk + 1;
  for (int64_t i = 0; i < a->Tq * row; i++) dq[i] = out[i] = 0;
  for (int64_t i = 0; i < a->Tk * row; i++) dk[i] = dv[i] = 0;
  for (int64_t b = 0; b < a->B; b++)
    for (int64_t i = a->q_offsets[b]; i < a->q_offsets[b + 1]; i++)
      for (int64_t h = 0; h < a->H; h++) {
        const float *q = a->q + i * row + h * D, *y = a->dout + i * row + h * D;
        const int64_t k0 = a->k_offsets[b], k1 = a->k_offsets[b + 1];
        real m = -INFINITY, l = 0, delta = 0;
        for (int64_t j = k0; j < k1; j++) {
          real x = 0;
          for (int64_t d = 0; d < D; d++) x += (real)q[d] * (real)a->k[j * row + h * D + d];
          w[j] = x * (real)s.scale;
          if (!(w[j] <= m)) m = w[j];
        }
        for (int64_t j = k0; j < k1; j++) l += w[j] = exp(w[j] - m);
        lse[i * a->H + h] = k1 > k0 ? m + log(l) : -INFINITY;
        for (int64_t j = k0; j < k1; j++) {
          w[j] /= l;
          z[j] = s.dropout_p > 0 ? (real)dropout_factor(&s, b, h, i - a->q_offsets[b], j - k0) : 1;
          for (int64_t d = 0; d < D; d++) out[i * row + h * D + d] += w[j] * z[j] * (real)a->v[j * row + h * D + d];
        }
        for (int64_t d = 0; d < D; d++) delta += (real)y[d] * out[i * row + h * D + d];
        for (int64_t j = k0; j < k1; j++) {
          real dp = 0;
          for (int64_t d = 0; d < D; d++) dp += (real)y[d] * (real)a->v[j * row + h * D + d];
          const real ds = w[j] * (z[j] * dp - delta) * (real)s.scale;
          for (int64_t d = 0; d < D; d++) {
            const int64_t at = j * row + h * D + d;
            dq[i * row + h * D + d] += ds * (real)a->k[at];
            dk[at] += ds * (real)q[d];
            dv[at] += w[j] * z[j] * (real)y[d];
          }
        }
      }
  free(w);
}

#undef real
#undef FORMULA
