/* The formula of one row of mlp and its gradients; weight gradients are added to. Included by test_mlp.c once per
 * type `real` of its arithmetic: as FORMULA in double, the exact values, and in float, whose errors are the measure. */
#include <tgmath.h> /* exp, sqrt and others of the type of their argument */
#undef I            /* of complex.h */

static void FORMULA(const problem *a, int64_t i, real *const *r) {
  const ast_mlp *s = &a->s;
  const int64_t I = s->I, I2 = s->I2, K = I + I2, H = s->H, O = s->O;
  real *in = calloc((size_t)(K + 2 * H + 2 * O), sizeof *in), *h = in + K, *dz = h + H, *y = dz + H, *d = y + O;
  real mean = 0, variance = 0, scale = 1, mean_d = 0, mean_dn = 0;
  for (int64_t k = 0; k < K; k++) in[k] = (real)(k < I ? s->x[i * I + k] : s->beside[i * I2 + k - I]);
  for (int64_t u = 0; u < H; u++) {
    for (int64_t k = 0; k < K; k++) h[u] += in[k] * (real)s->weight1[u * K + k];
    h[u] += (real)s->bias1[u];
    h[u] = h[u] > 0 ? h[u] : 0;
  }
  for (int64_t o = 0; o < O; o++) {
    for (int64_t u = 0; u < H; u++) y[o] += h[u] * (real)s->weight2[o * H + u];
    y[o] += (real)s->bias2[o];
    mean += y[o] / (real)O;
    d[o] = (real)a->arrays[9][i * O + o];
  }
  for (int64_t o = 0; s->gamma && o < O; o++) variance += (y[o] - mean) * (y[o] - mean) / (real)O;
  if (s->gamma) scale = 1 / sqrt(variance + (real)1e-5f);
  for (int64_t o = 0; o < O; o++) {
    if (s->gamma) {
      y[o] = (y[o] - mean) * scale;
      r[7][o] += d[o] * y[o];
      r[8][o] += d[o];
      d[o] *= (real)s->gamma[o];
      mean_d += d[o] / (real)O;
      mean_dn += d[o] * y[o] / (real)O;
    }
    r[0][i * O + o] = (s->gamma ? (real)s->gamma[o] * y[o] + (real)s->beta[o] : y[o]) + (real)a->arrays[8][i * O + o];
  }
  for (int64_t o = 0; o < O; o++) {
    const real dy = s->gamma ? scale * (d[o] - mean_d - y[o] * mean_dn) : d[o];
    r[6][o] += dy;
    for (int64_t u = 0; u < H; u++) {
      r[5][o * H + u] += dy * h[u];
      dz[u] += dy * (real)s->weight2[o * H + u];
    }
  }
  for (int64_t u = 0; u < H; u++) {
    if (!(h[u] > 0)) dz[u] = 0;
    r[4][u] += dz[u];
    for (int64_t k = 0; k < K; k++) {
      r[3][u * K + k] += dz[u] * in[k];
      *(k < I ? &r[1][i * I + k] : &r[2][i * I2 + k - I]) += dz[u] * (real)s->weight1[u * K + k];
    }
  }
  free(in);
}

#undef real
#undef FORMULA
