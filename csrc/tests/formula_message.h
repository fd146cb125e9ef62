/* The formula of message and its gradients, edge by edge. Included by test_message.c once per type `real` of its
 * arithmetic: as FORMULA in double, the exact values, and in float, whose errors are the measure. */
#include <tgmath.h> /* exp, sqrt and others of the type of their argument */
#undef I            /* of complex.h */

static void FORMULA(const ast_message *s, const float *dsum, const float *dmessages, real *const *out) {
  const int64_t E = s->E, H = s->H, F = s->F, F2 = s->F2;
  real *h = calloc((size_t)(2 * H + 2 * F + 2 * F2 + 1), sizeof *h), *x = h + H, *u = x + F, *dy = u + F2,
       *dz = dy + F2;
  real *dc = dz + F;
  CHECK(h, "no memory");
  for (int64_t m = 0; m < s->M; m++) {
    const float *e = s->edge_features + m * E, *p = s->of_senders + s->senders[m] * F,
                *q = s->of_receivers + s->receivers[m] * F;
    for (int64_t i = 0; i < H; i++) {
      h[i] = (real)s->a1[i];
      for (int64_t k = 0; k < E; k++) h[i] += (real)s->A1[i * E + k] * (real)e[k];
      if (h[i] < 0) h[i] = 0;
    }
    for (int64_t i = 0; i < F; i++) {
      x[i] = (real)p[i] + (real)q[i];
      for (int64_t k = 0; k < H; k++) x[i] += (real)s->A2[i * H + k] * h[k];
      if (E && !H) x[i] += (real)e[i];
      if (x[i] < 0) x[i] = 0;
    }
    real mean = 0, variance = 0, mean_p = 0, mean_pu = 0;
    for (int64_t i = 0; i < F2; i++) {
      u[i] = (real)s->b2[i];
      for (int64_t k = 0; k < F; k++) u[i] += (real)s->W2[i * F + k] * x[k];
      mean += u[i] / (real)F2;
    }
    for (int64_t i = 0; i < F2; i++) variance += (u[i] - mean) * (u[i] - mean) / (real)F2;
    const real inverse = 1 / sqrt(variance + (real)1e-5);
    for (int64_t i = 0; i < F2; i++) {
      const int64_t at_sum = s->receivers[m] * F2 + i;
      u[i] = (u[i] - mean) * inverse;
      out[MESSAGES][m * F2 + i] = u[i] * (real)s->gamma[i] + (real)s->beta[i];
      out[SUM][at_sum] += out[MESSAGES][m * F2 + i];
      const real g = (real)dsum[at_sum] + (dmessages ? (real)dmessages[m * F2 + i] : 0);
      dy[i] = g * (real)s->gamma[i];
      mean_p += dy[i] / (real)F2;
      mean_pu += dy[i] * u[i] / (real)F2;
      out[GAMMA][i] += g * u[i];
      out[BETA][i] += g;
    }
    for (int64_t i = 0; i < F2; i++) {
      dy[i] = (dy[i] - mean_p - u[i] * mean_pu) * inverse;
      out[B2][i] += dy[i];
      for (int64_t k = 0; k < F; k++) out[W2][i * F + k] += dy[i] * x[k];
    }
    for (int64_t k = 0; k < F; k++) {
      dz[k] = 0;
      for (int64_t i = 0; x[k] > 0 && i < F2; i++) dz[k] += dy[i] * (real)s->W2[i * F + k];
      out[P][s->senders[m] * F + k] += dz[k];
      out[Q][s->receivers[m] * F + k] += dz[k];
      for (int64_t j = 0; j < H; j++) out[A2][k * H + j] += dz[k] * h[j];
      if (E && !H) out[EDGES][m * E + k] = dz[k];
    }
    for (int64_t j = 0; j < H; j++) {
      dc[j] = 0;
      for (int64_t k = 0; h[j] > 0 && k < F; k++) dc[j] += dz[k] * (real)s->A2[k * H + j];
      out[B1][j] += dc[j];
      for (int64_t i = 0; i < E; i++) out[A1][j * E + i] += dc[j] * (real)e[i];
      for (int64_t i = 0; i < E; i++) out[EDGES][m * E + i] += dc[j] * (real)s->A1[j * E + i];
    }
  }
  free(h);
}

#undef real
#undef FORMULA
