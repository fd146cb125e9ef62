/* The formula of an attention block and of its gradients. Included by test_attention_block.c once per type `real` of
 * its arithmetic: as FORMULA in double, the exact values, and in float, whose errors are the measure. Results are out,
 * then the gradients in the order of ast_attention_block_gradients; gradients start at 0. */
#include <tgmath.h> /* exp, sqrt and others of the type of their argument */
#undef I            /* of complex.h */

#define NAMED_AS(function, name) function##_##name
#define NAMED(function, name)    NAMED_AS(function, name)
#define PART(name)               NAMED(FORMULA, name)

/* u = (x - mean) / sd of one row of floats or, if that is NULL, of y; returns 1 / sd */
static real PART(normalize)(const float *x, const real *y, int64_t n, real *u) {
  real mean = 0, square = 0;
  for (int64_t k = 0; k < n; k++) mean += (u[k] = x ? (real)x[k] : y[k]) / (real)n;
  for (int64_t k = 0; k < n; k++) square += (u[k] - mean) * (u[k] - mean) / (real)n;
  for (int64_t k = 0; k < n; k++) u[k] = (u[k] - mean) / sqrt(square + (real)1e-5);
  return 1 / sqrt(square + (real)1e-5);
}

/* A layer on a normalized row: to = W (gamma . u + beta) + bias; W [m,n], bias or NULL. */
typedef struct {
  const float *gamma, *beta, *weight, *bias;
  int64_t n, m;
  real *dgamma, *dbeta, *dweight, *dbias;
} PART(layer);

static void PART(apply)(const PART(layer) * l, const real *u, real *to) {
  for (int64_t o = 0; o < l->m; o++) {
    to[o] = l->bias ? (real)l->bias[o] : 0;
    for (int64_t k = 0; k < l->n; k++)
      to[o] += (real)l->weight[o * l->n + k] * ((real)l->gamma[k] * u[k] + (real)l->beta[k]);
  }
}

/* Adds the gradients of the row, and the one of x to dx; scale is 1 / sd. */
static void PART(apply_back)(const PART(layer) * l, const real *u, real scale, const real *dto, real *dx) {
  const int64_t n = l->n;
  real *d = calloc((size_t)n + 1, sizeof *d), mean = 0, along = 0;
  for (int64_t o = 0; o < l->m; o++) {
    if (l->dbias) l->dbias[o] += dto[o];
    for (int64_t k = 0; k < n; k++) {
      d[k] += dto[o] * (real)l->weight[o * n + k];
      l->dweight[o * n + k] += dto[o] * ((real)l->gamma[k] * u[k] + (real)l->beta[k]);
    }
  }
  for (int64_t k = 0; k < n; k++) {
    l->dgamma[k] += d[k] * u[k];
    l->dbeta[k] += d[k];
    d[k] *= (real)l->gamma[k];
    mean += d[k] / (real)n;
    along += d[k] * u[k] / (real)n;
  }
  for (int64_t k = 0; k < n; k++) dx[k] += scale * (d[k] - mean - u[k] * along);
  free(d);
}

/* H heads x [H,D] of one row, whose pairs are multiplied by the complex numbers `by` [D] or, back, by their conjugates;
 * NULL: they stay */
static void PART(rotate)(real *x, int64_t H, int64_t D, const float *by, bool back) {
  for (int64_t i = 0; by && i < H * D; i += 2) {
    const real a = x[i], b = x[i + 1], c = (real)by[i % D], s = back ? -(real)by[i % D + 1] : (real)by[i % D + 1];
    x[i] = a * c - b * s, x[i + 1] = a * s + b * c;
  }
}

/* One query q [D] of a head and keys and values, rows of N floats, each [D]: what it makes of them, and with dmixed the
 * gradients, which are added. */
static void PART(attend)(const real *q, const real *k, const real *v, int64_t keys, int64_t N, int64_t D, real *mixed,
                         const real *dmixed, real *dq, real *dk, real *dv) {
  real *w = calloc((size_t)(2 * keys) + 1, sizeof *w), *dw = w + keys, most = -INFINITY, sum = 0, along = 0;
  for (int64_t j = 0; j < keys; j++) {
    for (int64_t d = 0; d < D; d++) w[j] += q[d] * k[j * N + d] / sqrt((real)D);
    if (w[j] > most) most = w[j];
  }
  for (int64_t j = 0; j < keys; j++) sum += w[j] = exp(w[j] - most);
  for (int64_t j = 0; j < keys; j++) {
    w[j] /= sum;
    for (int64_t d = 0; d < D; d++) {
      if (!dmixed) mixed[d] += w[j] * v[j * N + d];
      else dw[j] += dmixed[d] * v[j * N + d], dv[j * N + d] += w[j] * dmixed[d];
    }
    along += w[j] * dw[j];
  }
  for (int64_t j = 0; dmixed && j < keys; j++)
    for (int64_t d = 0; d < D; d++) {
      const real ds = w[j] * (dw[j] - along) / sqrt((real)D);
      dq[d] += ds * k[j * N + d], dk[j * N + d] += ds * q[d];
    }
  free(w);
}

/* The rows after attention: out from y, and the gradients, of which the one of y is added to dy */
static void PART(feed_forward)(const ast_attention_block *s, const PART(layer) * first, int64_t i, const real *y,
                               const float *dout, real *const *r, real *dy) {
  const int64_t W = s->W, F = s->F;
  real *u = calloc((size_t)(W + 4 * F) + 1, sizeof *u), *z = u + W, *dz = z + 2 * F;
  const real scale = PART(normalize)(NULL, y, W, u);
  PART(apply)(first, u, z);
  for (int64_t o = 0; o < W; o++) {
    r[0][i * W + o] = y[o] + (real)s->second_bias[o];
    r[16][o] += (real)dout[i * W + o];
    dy[o] += (real)dout[i * W + o];
  }
  for (int64_t k = 0; k < F; k++) {
    const real a = z[k], b = z[F + k], phi = (real)0.5 * (1 + erf(b * (real)0.70710678118654752));
    const real density = exp(-b * b / 2) * (real)0.39894228040143268;
    real dh = 0;
    for (int64_t o = 0; o < W; o++) {
      r[0][i * W + o] += (real)s->second[o * F + k] * (a * b * phi);
      r[15][o * F + k] += (real)dout[i * W + o] * (a * b * phi);
      dh += (real)dout[i * W + o] * (real)s->second[o * F + k];
    }
    dz[k] = dh * b * phi, dz[F + k] = dh * a * (phi + b * density);
  }
  PART(apply_back)(first, u, scale, dz, dy);
  free(u);
}

static void FORMULA(const ast_attention_block *s, const float *dout, real *const *r) {
  const int64_t queries = s->Q, K = s->K, W = s->W, C = s->C, H = s->H, D = s->D, N = H * D;
  const PART(layer)
      query = {s->gamma, s->beta, s->query, NULL, W, N, r[3], r[4], r[7], NULL},
      key_value = {s->context_gamma, s->context_beta, s->key_value, NULL, C, 2 * N, r[5], r[6], r[8], NULL},
      first = {s->inner_gamma, s->inner_beta, s->first, s->first_bias, W, 2 * s->F, r[11], r[12], r[13], r[14]};
  real *u = calloc((size_t)(queries * W + K * C + queries + K) + 1, sizeof *u), *of_context = u + queries * W,
       *scale = of_context + K * C;
  real *q = calloc((size_t)(2 * (queries + 2 * K) * N) + 1, sizeof *q), *kv = q + queries * N, *dq = kv + 2 * K * N,
       *dkv = dq + queries * N;
  real *mixed = calloc((size_t)(2 * N + 2 * W) + 1, sizeof *mixed), *dmixed = mixed + N, *y = dmixed + N, *dy = y + W;
  for (int64_t i = 0; i < queries; i++) {
    scale[i] = PART(normalize)(s->x + i * W, NULL, W, u + i * W);
    PART(apply)(&query, u + i * W, q + i * N);
    PART(rotate)(q + i * N, H, D, s->rotations ? s->rotations + i * D : NULL, false);
  }
  for (int64_t j = 0; j < K; j++) {
    scale[queries + j] = PART(normalize)(s->context + j * C, NULL, C, of_context + j * C);
    PART(apply)(&key_value, of_context + j * C, kv + j * 2 * N);
    PART(rotate)(kv + j * 2 * N, H, D, s->context_rotations ? s->context_rotations + j * D : NULL, false);
  }
  for (int64_t b = 0; b < s->B; b++)
    for (int64_t i = s->q_offsets[b]; i < s->q_offsets[b + 1]; i++) {
      const int64_t at = s->k_offsets[b] * 2 * N, keys = s->k_offsets[b + 1] - s->k_offsets[b];
      for (int64_t k = 0; k < 2 * N + 2 * W; k++) mixed[k] = 0;
      for (int64_t h = 0; h < N; h += D)
        PART(attend)(q + i * N + h, kv + at + h, kv + at + N + h, keys, 2 * N, D, mixed + h, NULL, NULL, NULL, NULL);
      for (int64_t o = 0; o < W; o++) {
        y[o] = (real)s->x[i * W + o] + (real)s->bias[o];
        for (int64_t k = 0; k < N; k++) y[o] += (real)s->weight[o * N + k] * mixed[k];
      }
      PART(feed_forward)(s, &first, i, y, dout, r, dy);
      for (int64_t o = 0; o < W; o++) {
        r[1][i * W + o] += dy[o];
        r[10][o] += dy[o];
        for (int64_t k = 0; k < N; k++) {
          r[9][o * N + k] += dy[o] * mixed[k];
          dmixed[k] += dy[o] * (real)s->weight[o * N + k];
        }
      }
      for (int64_t h = 0; h < N; h += D)
        PART(attend)(q + i * N + h, kv + at + h, kv + at + N + h, keys, 2 * N, D, NULL, dmixed + h, dq + i * N + h,
                     dkv + at + h, dkv + at + N + h);
      PART(rotate)(dq + i * N, H, D, s->rotations ? s->rotations + i * D : NULL, true);
      PART(apply_back)(&query, u + i * W, scale[i], dq + i * N, r[1] + i * W);
    }
  for (int64_t j = 0; j < K; j++) {
    PART(rotate)(dkv + j * 2 * N, H, D, s->context_rotations ? s->context_rotations + j * D : NULL, true);
    PART(apply_back)(&key_value, of_context + j * C, scale[queries + j], dkv + j * 2 * N, r[2] + j * C);
  }
  free(u), free(q), free(mixed);
}

#undef NAMED_AS
#undef NAMED
#undef PART
#undef real
#undef FORMULA
