/* Attention: out = dropout(softmax(scale Q K^T)) V for each scene and head, and its gradients, without a Tq x Tk array.
 *
 * Keys come in blocks. With x_j the scores of one query against a block, m their running maximum and l their running sum,
 *   m' = max(m, max_j x_j),  p_j = exp(x_j - m'),  l' = l exp(m - m') + sum_j p_j,  o' = o exp(m - m') + sum_j p_j v_j,
 * and out = o / l at the end. The weights carry a factor 2^-shift with 2^shift >= Tk, so l <= 1 and |o| <= max |v|: nothing
 * overflows that the result would not. A row with a NaN or +inf score, or with nothing but -inf, is NaN, as x - max says.
 *
 * With y = dout, P the weights, Z the dropout factors (0 or 1/keep) and . the product by elements, the gradients are
 *   dV = (P . Z)^T y,   dS = P . (Z . (y V^T) - rowsum(y . out)),   dQ = scale dS K,   dK = scale dS^T Q.
 * P is recomputed as exp(x - m) / l; the log sum exp in one float would be off by 5e-4 where it is 1e4. Where one weight is 1 and the
 * others vanish, dS is exactly 0: both terms are rounded alike.
 *
 * Blocks start at the scene's first row and their sizes are constants: a result depends on neither threads nor batch.
 */
#include <math.h>

#include "ast.h"
#include "gemm.h"
#include "simd.h"

enum {
  QUERIES = 256,   /* a forward task: one scene and head, this many queries; packed keys are shared among them */
  QUERY_TILE = 64, /* rows and */
  KEYS = 128,      /* columns of the tile of scores */
  MAX_D = 128,
  ROW = MAX_D + 16, /* floats from row to row of copied queries and the like: no power of two, which would crowd few cache sets */
  DROPOUT_KEYS = 128
};
_Static_assert(KEYS % DROPOUT_KEYS == 0, "a block of keys holds whole groups of the dropout mask");
static const float LOG2_E = 0x1.715476p+0f;

/* ---- dropout ---- */

typedef struct {
  uint32_t key[5];
  uint32_t threshold; /* a weight is dropped if its 16 random bits are below this; 0: no dropout */
  float gain;         /* 1 / the share kept, of the threshold itself */
} dropout;

static dropout dropout_of(const ast_attention *s, int64_t scene, int64_t head) {
  dropout d = {.key = {(uint32_t)s->seed, (uint32_t)(s->seed >> 32), (uint32_t)scene, (uint32_t)head}};
  d.key[4] = 0x1BD11BDAu ^ d.key[0] ^ d.key[1] ^ d.key[2] ^ d.key[3];
  d.threshold = (uint32_t)min64(65535, (int64_t)(s->dropout_p * 65536 + 0.5));
  d.gain = 65536.0f / (float)(65536 - d.threshold);
  return d;
}

/* Threefry-4x32 of 12 rounds (Salmon et al., Parallel random numbers: as easy as 1, 2, 3, 2011), VW counters at once. */
AST_INLINE void threefry(const uint32_t key[5], vu x[4]) {
  static const uint8_t rotation[8][2] = {{10, 26}, {11, 21}, {13, 27}, {23, 5}, {6, 20}, {17, 11}, {25, 10}, {18, 20}};
#pragma GCC unroll 4
  for (int i = 0; i < 4; i++) x[i] += key[i];
#pragma GCC unroll 12
  for (int round = 0; round < 12; round++) {
    const int a = round % 2 ? 3 : 1, b = round % 2 ? 1 : 3;
    const uint32_t r = rotation[round % 8][0], t = rotation[round % 8][1];
    x[0] += x[a];
    x[a] = ((x[a] << r) | (x[a] >> (32 - r))) ^ x[0];
    x[2] += x[b];
    x[b] = ((x[b] << t) | (x[b] >> (32 - t))) ^ x[2];
    if (round % 4 != 3) continue;
    const uint32_t s = (uint32_t)round / 4 + 1;
#pragma GCC unroll 4
    for (uint32_t i = 0; i < 4; i++) x[i] += key[(i + s) % 5];
    x[3] += s;
  }
}

/* keep[j] = -1 or 0 for keys first_key <= j < first_key + n, first_key a multiple of DROPOUT_KEYS; keep has room for whole
 * groups. Key 128 g + 16 slot + lane takes half slot % 2 of word slot / 2 of counter (16 g + lane, query): 8 keys a counter. */
static void dropout_mask(const dropout *d, int64_t query, int64_t first_key, int64_t n, int32_t *keep) {
  vu lanes;
  for (int i = 0; i < VW; i++) lanes[i] = (uint32_t)i;
  for (int64_t j = 0; j < n; j += DROPOUT_KEYS)
    for (uint32_t lane = 0; lane < 16; lane += VW) {
      vu x[4] = {lanes + ((uint32_t)((first_key + j) / 8) + lane), (vu){0} + (uint32_t)query, (vu){0}, (vu){0}};
      threefry(d->key, x);
#pragma GCC unroll 8
      for (int slot = 0; slot < 8; slot++) {
        const vu bits = slot % 2 ? x[slot / 2] >> 16 : x[slot / 2] & 0xffff;
        const vi kept = (vi)bits >= (int32_t)d->threshold;
        memcpy(keep + j + 16 * slot + lane, &kept, sizeof kept);
      }
    }
}

/* ---- what both directions share ---- */

/* to[i] = factor from[i], rows ROW apart */
static void copy_rows(const float *from, int64_t stride, int64_t rows, int64_t D, float factor, float *to) {
  for (int64_t i = 0; i < rows; i++)
    for (int64_t d = 0; d < D; d += VW) vstore(to + i * ROW + d, factor * vload(from + i * stride + d));
}

static void fill_rows(float value, int64_t stride, int64_t rows, int64_t D, float *to) {
  for (int64_t i = 0; i < rows; i++)
    for (int64_t d = 0; d < D; d++) to[i * stride + d] = value;
}

/* ---- forward ---- */

typedef struct {
  const ast_attention *s;
  const float *q, *k, *v;
  float *out, *maximum, *sum;
  const int64_t *first; /* [B+1] tasks before each scene */
} forward_job;

typedef struct {
  float keys[MAX_D * (KEYS + GEMM_COLUMNS)]; /* K^T, packed */
  float values[KEYS * ROW];
  float queries[QUERIES * ROW]; /* scale Q */
  float scores[QUERY_TILE * KEYS];
  float out[QUERIES * MAX_D], maximum[QUERIES], sum[QUERIES];
  int32_t keep[KEYS];
} forward_scratch;

/* One row of n scores, padded to `padded`, becomes a row of weights exp(x - maximum) 2^-shift; their sum. */
AST_INLINE float weights_of(float *x, int64_t padded, float maximum, int32_t shift, const int32_t *keep) {
  vf sum = {0};
  for (int64_t j = 0; j < padded; j += VW) {
    const vf p = vexp2((vload(x + j) - maximum) * LOG2_E, shift);
    sum += p;
    vi kept;
    if (keep) memcpy(&kept, keep + j, sizeof kept);
    vstore(x + j, keep ? (vf)((vi)p & kept) : p);
  }
  return vsum(sum);
}

static float largest(float *x, int64_t n, int64_t padded) {
  for (int64_t j = n; j < padded; j++) x[j] = -INFINITY;
  vf even = vsplat(-INFINITY), odd = even; /* two chains: a maximum waits for the one before */
  for (int64_t j = 0; j < padded; j += GEMM_COLUMNS) {
    even = vmax(vload(x + j), even);
    odd = vmax(vload(x + j + VW), odd);
  }
  return vlargest(vmax(even, odd));
}

/* The block of n keys from k0 on, for the tile of `rows` queries from i0 on. */
static void forward_tile(forward_scratch *t, int64_t i0, int64_t rows, int64_t k0, int64_t n, int64_t D, int32_t shift, const dropout *d,
                         int64_t first_query) {
  const int64_t padded = round_up(n, GEMM_COLUMNS);
  gemm(rows, padded, D, (gemm_a){t->queries + i0 * ROW, ROW, 1}, gemm_packed(t->keys, D), t->scores, KEYS, false);
  for (int64_t i = 0; i < rows; i++) {
    float *x = t->scores + i * KEYS, *m = t->maximum + i0 + i, *l = t->sum + i0 + i, *out = t->out + (i0 + i) * D;
    const float x_max = largest(x, n, padded), m_new = x_max > *m ? x_max : *m;
    const float base = m_new == -INFINITY ? 0 : m_new; /* only -inf so far: weights 0, not NaN */
    float sum;
    if (d->threshold) {
      dropout_mask(d, first_query + i0 + i, k0, n, t->keep);
      sum = weights_of(x, padded, base, shift, t->keep);
    } else {
      sum = weights_of(x, padded, base, shift, NULL);
    }
    if (k0 == 0) {
      *l = sum;
    } else {
      const float fade = vexp2(vsplat((*m - base) * LOG2_E), 0)[0];
      *l = *l * fade + sum;
      for (int64_t j = 0; fade != 1 && j < D; j += VW) vstore(out + j, fade * vload(out + j));
    }
    *m = m_new;
  }
  gemm(rows, D, n, (gemm_a){t->scores, KEYS, 1}, gemm_rows(t->values, ROW), t->out + i0 * D, D, k0 > 0);
}

static ast_status forward_task(int64_t index, void *context) {
  const forward_job *job = context;
  const ast_attention *s = job->s;
  int64_t b = 0, last = s->B - 1; /* the last scene that has at most `index` tasks before it */
  while (b < last) {
    const int64_t middle = (b + last + 1) / 2;
    if (job->first[middle] <= index) b = middle;
    else last = middle - 1;
  }
  const int64_t H = s->H, D = s->D, blocks = (job->first[b + 1] - job->first[b]) / H, local = index - job->first[b], h = local / blocks;
  const int64_t first_query = local % blocks * QUERIES, q0 = s->q_offsets[b] + first_query;
  const int64_t rows = min64(QUERIES, s->q_offsets[b + 1] - q0), keys = s->k_offsets[b + 1] - s->k_offsets[b];
  float *out = job->out + (q0 * H + h) * D, *maximum = job->maximum + q0 * H + h, *sum = job->sum + q0 * H + h;
  if (keys == 0) {
    fill_rows(0, H * D, rows, D, out);
    fill_rows(-INFINITY, H, rows, 1, maximum);
    fill_rows(0, H, rows, 1, sum);
    return AST_OK;
  }
  forward_scratch *t = ast_scratch(5, sizeof *t);
  if (!t) return AST_NO_MEMORY;
  int32_t shift = 0;
  while (shift < 62 && (int64_t)1 << shift < keys) shift++;
  const dropout d = dropout_of(s, b, h);
  copy_rows(job->q + q0 * s->q_stride + h * D, s->q_stride, rows, D, s->scale, t->queries);
  fill_rows(-INFINITY, 1, rows, 1, t->maximum);
  for (int64_t k0 = 0; k0 < keys; k0 += KEYS) {
    const int64_t n = min64(KEYS, keys - k0), row = s->k_offsets[b] + k0;
    gemm_pack(job->k + row * s->k_stride + h * D, 1, s->k_stride, D, n, t->keys);
    copy_rows(job->v + row * s->v_stride + h * D, s->v_stride, n, D, 1, t->values);
    for (int64_t i0 = 0; i0 < rows; i0 += QUERY_TILE) forward_tile(t, i0, min64(QUERY_TILE, rows - i0), k0, n, D, shift, &d, first_query);
  }
  for (int64_t i = 0; i < rows; i++) {
    const float l = t->sum[i] > 0 ? t->sum[i] : NAN;
    const float factor = d.gain / l;
    maximum[i * H] = l > 0 ? t->maximum[i] : NAN;
    sum[i * H] = ldexpf(l, shift);
    for (int64_t j = 0; j < D; j += VW) vstore(out + i * H * D + j, factor * vload(t->out + i * D + j));
  }
  return AST_OK;
}

static ast_status attention(const ast_attention *s, const float *restrict q, const float *restrict k, const float *restrict v,
                            float *restrict out, float *restrict maximum, float *restrict sum) {
  int64_t *first = ast_scratch(6, (s->B + 1) * (int64_t)sizeof *first);
  if (!first) return AST_NO_MEMORY;
  first[0] = 0;
  for (int64_t b = 0; b < s->B; b++) first[b + 1] = first[b] + s->H * ((s->q_offsets[b + 1] - s->q_offsets[b] + QUERIES - 1) / QUERIES);
  forward_job job = {s, q, k, v, out, maximum, sum, first};
  return ast_parallel(first[s->B], forward_task, &job);
}

/* ---- backward ---- */

typedef struct {
  const ast_attention *s;
  const float *q, *k, *v, *out, *maximum, *sum, *dout;
  float *dq, *dk, *dv;
} backward_job;

typedef struct {
  float keys[MAX_D * (KEYS + GEMM_COLUMNS)], values[MAX_D * (KEYS + GEMM_COLUMNS)]; /* K^T, V^T, packed */
  float key_rows[KEYS * ROW];                                                       /* scale K */
  float value_rows[KEYS * ROW];                                                     /* gain V */
  float queries[QUERY_TILE * ROW], dout[QUERY_TILE * ROW];                          /* scale Q, y */
  float scores[QUERY_TILE * KEYS], dscores[QUERY_TILE * KEYS];                      /* at first: y and out, packed */
  float dk[KEYS * MAX_D], dv[KEYS * MAX_D];
  int32_t keep[KEYS];
} backward_scratch;

/* sums[i] = a_i . b_i, each added in the order of gemm; a and b packed, sums [rows] up to whole panels */
static void row_products(const float *a, const float *b, int64_t rows, int64_t D, float *sums) {
  for (int64_t i = 0; i < rows; i += VW) {
    const int64_t panel = i / GEMM_COLUMNS * GEMM_COLUMNS * D + i % GEMM_COLUMNS;
    vf sum = {0};
    for (int64_t d = 0; d < D; d++) sum += vload(a + panel + d * GEMM_COLUMNS) * vload(b + panel + d * GEMM_COLUMNS);
    vstore(sums + i, sum);
  }
}

/* One row, share = 1 / l: scores x become P . keep, and gain y V^T, in dx, becomes dS. */
AST_INLINE void gradients_of(float *x, float *dx, int64_t padded, float maximum, float share, float delta, const int32_t *keep) {
  for (int64_t j = 0; j < padded; j += VW) {
    const vf p = share * vexp2((vload(x + j) - maximum) * LOG2_E, 0), dp = vload(dx + j);
    vi kept;
    if (keep) memcpy(&kept, keep + j, sizeof kept);
    vstore(x + j, keep ? (vf)((vi)p & kept) : p);
    vstore(dx + j, p * ((keep ? (vf)((vi)dp & kept) : dp) - delta));
  }
}

/* The block of n keys from k0 on, for the tile of `rows` queries from i0 on of scene b and head h. */
static void backward_tile(const backward_job *job, backward_scratch *t, int64_t b, int64_t h, int64_t i0, int64_t rows, int64_t k0,
                          int64_t n, const dropout *d, float *delta) {
  const ast_attention *s = job->s;
  const int64_t H = s->H, D = s->D, padded = round_up(n, GEMM_COLUMNS), q0 = s->q_offsets[b] + i0;
  const float *dout = job->dout + (q0 * H + h) * D;
  copy_rows(job->q + q0 * s->q_stride + h * D, s->q_stride, rows, D, s->scale, t->queries);
  copy_rows(dout, H * D, rows, D, 1, t->dout);
  if (k0 == 0) {
    gemm_pack(dout, 1, H * D, D, rows, t->scores);
    gemm_pack(job->out + (q0 * H + h) * D, 1, H * D, D, rows, t->dscores);
    row_products(t->scores, t->dscores, rows, D, delta + i0);
  }
  gemm(rows, padded, D, (gemm_a){t->queries, ROW, 1}, gemm_packed(t->keys, D), t->scores, KEYS, false);
  gemm(rows, padded, D, (gemm_a){t->dout, ROW, 1}, gemm_packed(t->values, D), t->dscores, KEYS, false);
  for (int64_t i = 0; i < rows; i++) {
    const float maximum = job->maximum[(q0 + i) * H + h], share = 1 / job->sum[(q0 + i) * H + h];
    float *x = t->scores + i * KEYS, *dx = t->dscores + i * KEYS;
    if (d->threshold) {
      dropout_mask(d, i0 + i, k0, n, t->keep);
      gradients_of(x, dx, padded, maximum, share, delta[i0 + i], t->keep);
    } else {
      gradients_of(x, dx, padded, maximum, share, delta[i0 + i], NULL);
    }
  }
  gemm(n, D, rows, (gemm_a){t->scores, 1, KEYS}, gemm_rows(t->dout, ROW), t->dv, D, i0 > 0);
  gemm(n, D, rows, (gemm_a){t->dscores, 1, KEYS}, gemm_rows(t->queries, ROW), t->dk, D, i0 > 0);
  gemm(rows, D, n, (gemm_a){t->dscores, KEYS, 1}, gemm_rows(t->key_rows, ROW), job->dq + (q0 * H + h) * D, H * D, k0 > 0);
}

static ast_status backward_task(int64_t index, void *context) {
  const backward_job *job = context;
  const ast_attention *s = job->s;
  const int64_t H = s->H, D = s->D, b = index / H, h = index % H, q0 = s->q_offsets[b], k_first = s->k_offsets[b];
  const int64_t queries = s->q_offsets[b + 1] - q0, keys = s->k_offsets[b + 1] - k_first;
  if (keys == 0) fill_rows(0, H * D, queries, D, job->dq + (q0 * H + h) * D);
  if (queries == 0) {
    fill_rows(0, H * D, keys, D, job->dk + (k_first * H + h) * D);
    fill_rows(0, H * D, keys, D, job->dv + (k_first * H + h) * D);
    return AST_OK;
  }
  backward_scratch *t = ast_scratch(5, sizeof *t);
  float *delta = ast_scratch(7, round_up(queries, QUERY_TILE) * (int64_t)sizeof *delta);
  if (!t || !delta) return AST_NO_MEMORY;
  const dropout d = dropout_of(s, b, h);
  for (int64_t k0 = 0; k0 < keys; k0 += KEYS) {
    const int64_t n = min64(KEYS, keys - k0), row = k_first + k0;
    const float *k = job->k + row * s->k_stride + h * D, *v = job->v + row * s->v_stride + h * D;
    gemm_pack(k, 1, s->k_stride, D, n, t->keys);
    copy_rows(v, s->v_stride, n, D, d.gain, t->value_rows);
    gemm_pack(t->value_rows, 1, ROW, D, n, t->values);
    copy_rows(k, s->k_stride, n, D, s->scale, t->key_rows);
    for (int64_t i0 = 0; i0 < queries; i0 += QUERY_TILE) backward_tile(job, t, b, h, i0, min64(QUERY_TILE, queries - i0), k0, n, &d, delta);
    for (int64_t j = 0; j < n; j++) {
      memcpy(job->dk + ((row + j) * H + h) * D, t->dk + j * D, (size_t)D * sizeof *t->dk);
      for (int64_t i = 0; i < D; i += VW) vstore(job->dv + ((row + j) * H + h) * D + i, d.gain * vload(t->dv + j * D + i));
    }
  }
  return AST_OK;
}

static ast_status attention_backward(const ast_attention *s, const float *restrict q, const float *restrict k, const float *restrict v,
                                     const float *restrict out, const float *restrict maximum, const float *restrict sum,
                                     const float *restrict dout, float *restrict dq, float *restrict dk, float *restrict dv) {
  backward_job job = {s, q, k, v, out, maximum, sum, dout, dq, dk, dv};
  return ast_parallel(s->B * s->H, backward_task, &job);
}
