/* The gradients of attention, its weights recomputed, without a Tq x Tk array.
 *
 * With y = dout, P the weights, Z the dropout factors (0 or 1/keep) and . the product by elements,
 *
 *   dV = (P . Z)^T y,   dS = P . (Z . (y V^T) - rowsum(y . out)),   dQ = scale dS K,   dK = scale dS^T Q.
 *
 * P is recomputed as exp(x - m) / l; the log sum exp in one float would be off by 5e-4 where it is 1e4. Where one
 * weight is 1 and the others vanish, dS is exactly 0: both terms are rounded alike. Where one key takes nearly all the
 * weight of a query, its dS is a small difference of large terms; but a row of dS sums to 0. So that key is noted, and
 * what its row sums to is at the end taken off its dS.
 *
 * A task takes a chunk of queries against all blocks of keys, then the next chunk: each score is computed once and dQ,
 * dK and dV grow in the second cache. Scores have keys across the lanes: no row is summed here, and so panels are
 * needed of a block of keys only, not of the chunk, whose arrays would not fit with them. A scene of few tasks is cut
 * over its longer side; each part but the first leaves its share of the gradient of the shorter side, added in the
 * order of the parts. All sizes depend on the scene's own, as in the forward pass.
 *
 * Cost: 10 Tq Tk D flops a head in five products. Memory: at most 2 BACKWARD_TASKS D floats for each row of the shorter
 * side, and a peak for each query, head and part of the keys.
 */
#include "ast.h"
#include "attention_tiles.h"
#include "dropout.h"

enum {
  CHUNK = 512,         /* queries whose rows and gradients are kept in the second cache */
  SQUARE = 128,        /* of these, against a block of keys; */
  GROUP = 24,          /* of these, whose scores stay in the first cache: whole tiles */
  BACKWARD_TASKS = 16, /* a scene with fewer tasks is cut */
  BACKWARD_PART = 512, /* into parts of at least this number of keys or queries */
};
_Static_assert(CHUNK % SQUARE == 0 && GROUP % (int)GEMM_ROWS == 0 && KEYS % (int)LANES == 0,
               "chunks hold whole squares, groups tiles");

/* How a scene is cut. */
typedef struct {
  int64_t q0, queries, k0, keys;       /* its rows */
  bool by_queries;                     /* parts are of queries, of which there are more than keys; else of keys */
  int64_t parts, part_rows;            /* rows of a part */
  int64_t partial_size, first_partial; /* floats of a partial gradient, of dq or of dk and dv; and before this scene */
  int64_t peaks, first_peak;           /* of a head: of all queries, once for each part of the keys; and before */
} attention_backward_cut;

/* Of a query whose weights are nearly all of one key: that key of the scene, or -1 if it is in no block so far, and the
 * sum of dS. */
typedef struct {
  int64_t key;
  float sum;
} attention_backward_peak;

static const float PEAK = 0.875f;        /* the weight from which a key is one */
static const float LEAST_SUM = 0x1p-46f; /* of the terms of dS: what is smaller would be 0 in double, too */

typedef struct {
  const ast_attention *s;
  const float *q, *k, *v, *out, *maximum, *sum, *dout;
  float *dq, *dk, *dv;
  const attention_backward_cut *cuts; /* [B] */
  const int64_t *first_task;          /* [B+1] of each scene */
  float *partials;
  attention_backward_peak *peaks; /* [parts by keys, queries] of each scene and head */
  bool any_peaks;
} attention_backward_job;

typedef struct {
  float keys[KEYS * ROW], key_panels[KEYS * MAX_D],
      value_panels[KEYS * MAX_D]; /* K by rows and in panels, gain V in panels */
  float dk[KEYS * ROW], dv[KEYS * ROW];
  float weights[SQUARE * ROW], dscores[SQUARE * ROW];             /* P . keep and dS as [query][key] */
  float queries[CHUNK * ROW], dout[CHUNK * ROW], dq[CHUNK * ROW]; /* scale Q, y and dQ / scale; or */
  float scale; /* Q and the scale of its scores, which is 1 otherwise */
  dropout_row words[GROUP];
  float maximum[CHUNK], share[CHUNK], delta[CHUNK]; /* m, 1 / l, rowsum(y . out) */
  attention_backward_peak peaks[CHUNK];
} attention_backward_scratch;

/* The scene, head, queries and keys of a task, and where its gradients go: rows [.][stride]. */
typedef struct {
  const attention_backward_cut *cut;
  int64_t b, h, first_query, queries, first_key, keys;
  float *dq, *dk, *dv;
  int64_t dq_stride, dk_stride, dv_stride;
  int64_t first_peak; /* of the scene's first query */
} attention_backward_range;

/* ---- a square of queries against a block of keys ---- */

/* Score x and gain y V^T become P . keep and dS. Words NULL: all are kept; so is a row that is NaN, as 0 NaN is NaN. */
AST_INLINE void attention_gradient(float *x, float *dx, vf maximum, vf share, vf delta, const vu *words, int slot,
                                   vu threshold) {
  const vf p = share * vexp(vload(x) - maximum, 0), dp = vload(dx);
  threshold &= (vu)(maximum == maximum);
  vstore(x, words ? dropout_keep(words, slot, threshold, p) : p);
  vstore(dx, p * ((words ? dropout_keep(words, slot, threshold, dp) : dp) - delta));
}

/* The first of n scores that is the maximum, or -1. */
static int64_t attention_find_peak(const float *x, int64_t n, float maximum) {
  int64_t c = 0;
  for (; c + VW <= n; c += VW)
    if (vsum((vf)((vload(x + c) == maximum) & (vi)vsplat(1))) > 0) break;
  for (const int64_t end = min64(n, c + VW); c < end; c++)
    if (x[c] == maximum) return c;
  return -1;
}

static float attention_sum_of(const float *x, int64_t n) {
  vf sum = {0};
  for (int64_t c = 0; c < n; c += VW) sum += vload_upto(x + c, n - c);
  return vsum(sum);
}

/* Weights and their gradients of the queries i..i+rows in the scratch; k0 the first of n keys of the scene. */
static void attention_backward_group(attention_backward_scratch *t, int64_t i, int64_t rows, int64_t query, int64_t k0,
                                     int64_t n, int64_t D, const dropout *d) {
  float *x = t->weights + i % SQUARE * ROW, *dx = t->dscores + i % SQUARE * ROW;
  const int64_t whole = round_up(rows, ROW_STEP);
  for (int64_t c = 0; c < n; c += LANES) {
    attention_scores(whole, D, t->queries + i * ROW, t->key_panels + c * D, x + c, NULL);
    attention_scores(whole, D, t->dout + i * ROW, t->value_panels + c * D, dx + c, NULL);
  }
  const vu threshold = (vu){0} + (d->threshold << 16);
  if (d->threshold)
    for (int64_t r = 0; r < rows; r++) dropout_draw_keys(d, query + r, k0, t->words[r]);
  for (int64_t r = 0; r < rows; r++) {
    const vf maximum = vsplat(t->maximum[i + r]), share = vsplat(t->share[i + r]), delta = vsplat(t->delta[i + r]);
    float *x_r = x + r * ROW, *dx_r = dx + r * ROW;
    for (int64_t c = 0; t->scale != 1 && c < n; c += VW) vstore(x_r + c, t->scale * vload(x_r + c));
    attention_backward_peak *peak = t->share[i + r] > PEAK ? &t->peaks[i + r] : NULL;
    if (peak && peak->key < 0) {
      const int64_t at = attention_find_peak(x_r, n, t->maximum[i + r]);
      if (at >= 0) peak->key = k0 + at;
    }
    for (int64_t c = 0; !d->threshold && c < n; c += VW)
      attention_gradient(x_r + c, dx_r + c, maximum, share, delta, NULL, 0, threshold);
    EACH(DROPOUT_SLOTS, slot) {
      if (!d->threshold || slot * DROPOUT_LANES >= n) break;
      EACH(DROPOUT_PARTS, part) {
        const int64_t c = slot * DROPOUT_LANES + part * VW;
        attention_gradient(x_r + c, dx_r + c, maximum, share, delta, t->words[r][part], slot, threshold);
      }
    }
    if (peak) peak->sum += attention_sum_of(dx_r, n);
    for (int64_t c = 0; t->scale != 1 && c < n; c += VW) vstore(dx_r + c, t->scale * vload(dx_r + c));
  }
}

/* ---- tasks ---- */

/* The queries first..first+rows of the scene of `range`: rows, m, 1 / l and delta. */
static void attention_load_queries(const attention_backward_job *job, const attention_backward_range *range,
                                   int64_t first, int64_t rows, attention_backward_scratch *t) {
  const ast_attention *s = job->s;
  const int64_t H = s->H, D = s->D, h = range->h, q0 = range->cut->q0 + first;
  const float *q = job->q + q0 * s->q_stride + h * D, *dout = job->dout + (q0 * H + h) * D,
              *out = job->out + (q0 * H + h) * D;
  attention_copy_rows(q, s->q_stride, rows, D, attention_scale_of_queries(s->scale), t->queries);
  attention_copy_rows(dout, H * D, rows, D, 1, t->dout);
  for (int64_t i = 0; i < rows; i += VW) {
    vf sum = {0}, chain = {0}; /* in the order of the products, so that a weight of 1 leaves dS = 0 */
    for (int64_t e = 0; e < D; e += VW) {
      vf x[VW], y[VW];
      attention_load_transposed(t->dout + i * ROW + e, ROW, rows - i, y);
      attention_load_transposed(out + i * H * D + e, H * D, rows - i, x);
      EACH(VW, j) chain += y[j] * x[j];
      if ((e + VW) % SCORE_DEPTH && e + VW < D) continue;
      sum = chain + sum, chain = (vf){0};
    }
    vstore(t->delta + i, sum);
  }
  for (int64_t i = 0; i < rows; i++) {
    t->maximum[i] = job->maximum[(q0 + i) * H + h];
    t->share[i] = 1 / job->sum[(q0 + i) * H + h];
    t->peaks[i] = (attention_backward_peak){-1, 0};
  }
}

/* to = (to +) factor from, rows of `from` ROW apart */
static void attention_put_rows(const float *from, int64_t rows, int64_t D, float factor, bool add, float *to,
                               int64_t stride) {
  for (int64_t i = 0; i < rows; i++)
    for (int64_t d = 0; d < D; d += VW) {
      const vf x = factor * vload(from + i * ROW + d);
      vstore(to + i * stride + d, add ? vload(to + i * stride + d) + x : x);
    }
}

/* The queries first..first+rows, which the scratch holds, against the block of n keys from k0 on, all counted from the
 * scene's first. */
static void attention_backward_block(const attention_backward_job *job, const attention_backward_range *range,
                                     int64_t first, int64_t rows, int64_t k0, int64_t n, const dropout *d,
                                     attention_backward_scratch *t) {
  const ast_attention *s = job->s;
  const int64_t D = s->D, row = range->cut->k0 + k0, whole = round_up(n, ROW_STEP);
  const float *k = job->k + row * s->k_stride + range->h * D, *v = job->v + row * s->v_stride + range->h * D;
  attention_copy_rows(k, s->k_stride, n, D, 1, t->keys);
  for (int64_t c = 0; c < n; c += LANES) {
    attention_pack_panel(t->keys + c * ROW, ROW, n - c, D, 1, t->key_panels + c * D);
    attention_pack_panel(v + c * s->v_stride, s->v_stride, n - c, D, d->gain, t->value_panels + c * D);
  }
  float *dk = range->dk + (k0 - range->first_key) * range->dk_stride,
        *dv = range->dv + (k0 - range->first_key) * range->dv_stride;
  const int64_t left = range->first_key + range->keys - k0 - KEYS;
  const int64_t groups = divide_up(rows, GROUP), share = divide_up(KEYS, groups);
  for (int64_t i0 = 0; i0 < rows; i0 += SQUARE) {
    const int64_t width = min64(SQUARE, rows - i0);
    for (int64_t i = i0; i < i0 + width; i += GROUP) {
      const int64_t at = i / GROUP * share;
      attention_prefetch_rows(k + (KEYS + at) * s->k_stride, s->k_stride, min64(share, left - at), D, 0);
      attention_prefetch_rows(v + (KEYS + at) * s->v_stride, s->v_stride, min64(share, left - at), D, 0);
      attention_prefetch_rows(dk + at * range->dk_stride, range->dk_stride, min64(share, n - at), D, 1);
      attention_prefetch_rows(dv + at * range->dv_stride, range->dv_stride, min64(share, n - at), D, 1);
      attention_backward_group(t, i, min64(GROUP, i0 + width - i), first + i, k0, n, D, d);
    }
    gemm(whole, D, width, t->weights, ROW, t->dout + i0 * ROW, ROW, t->dv, ROW, i0 > 0);
    gemm(whole, D, width, t->dscores, ROW, t->queries + i0 * ROW, ROW, t->dk, ROW, i0 > 0);
    gemm_inlined(round_up(width, ROW_STEP), D, n, (gemm_a){t->dscores, ROW, 1}, t->keys, ROW, t->dq + i0 * ROW, ROW,
                 k0 > range->first_key);
  }
  attention_put_rows(t->dk, n, D, 1, first > range->first_query, dk, range->dk_stride);
  attention_put_rows(t->dv, n, D, d->gain, first > range->first_query, dv, range->dv_stride);
}

static attention_backward_cut attention_cut_backward(const ast_attention *s, int64_t b) {
  attention_backward_cut cut = {.q0 = s->q_offsets[b], .k0 = s->k_offsets[b]};
  cut.queries = s->q_offsets[b + 1] - cut.q0;
  cut.keys = s->k_offsets[b + 1] - cut.k0;
  cut.by_queries = cut.queries > cut.keys;
  const int64_t longer = max64(cut.queries, cut.keys);
  const int64_t wanted = max64(min64(BACKWARD_TASKS / max64(s->H, 1), longer / BACKWARD_PART), 1);
  cut.part_rows = round_up(divide_up(longer, wanted), cut.by_queries ? CHUNK : KEYS);
  cut.parts = longer ? divide_up(longer, cut.part_rows) : 1;
  cut.partial_size = s->D * (cut.by_queries ? 2 * cut.keys : cut.queries);
  if (cut.keys) cut.peaks = cut.by_queries ? cut.queries : cut.parts * cut.queries;
  return cut;
}

/* Leaves the peaks of the queries first..first+rows of the scene. */
static void attention_put_peaks(attention_backward_job *job, const attention_backward_range *range, int64_t first,
                                int64_t rows, const attention_backward_scratch *t) {
  attention_backward_peak *to = job->peaks + range->first_peak + first;
  bool any = false;
  for (int64_t i = 0; i < rows; i++) {
    to[i] = t->peaks[i];
    if (fabsf(to[i].sum) <= LEAST_SUM * fabsf(t->delta[i])) to[i].sum = 0;
    any |= to[i].sum != 0;
  }
  if (any) __atomic_store_n(&job->any_peaks, true, __ATOMIC_RELAXED);
}

/* Takes off the dS of each peak what its row sums to. */
static void attention_settle_peaks(const attention_backward_job *job, const attention_backward_cut *cut, int64_t h) {
  const ast_attention *s = job->s;
  const int64_t D = s->D;
  const attention_backward_peak *peaks = job->peaks + cut->first_peak + h * cut->peaks;
  for (int64_t i = 0; i < min64(cut->queries, cut->peaks); i++) {
    attention_backward_peak all = {-1, 0};
    for (int64_t at = i; at < cut->peaks; at += cut->queries) {
      all.sum += peaks[at].sum;
      if (all.key < 0) all.key = peaks[at].key;
    }
    if (all.key < 0 || all.sum == 0 || !isfinite(all.sum)) continue;
    const int64_t query = cut->q0 + i, key = cut->k0 + all.key;
    const float *q = job->q + query * s->q_stride + h * D, *k = job->k + key * s->k_stride + h * D;
    float *dq = job->dq + query * s->dq_stride + h * D, *dk = job->dk + key * s->dk_stride + h * D;
    const float factor = s->scale * all.sum;
    for (int64_t e = 0; e < D; e += VW) {
      vstore(dq + e, vload(dq + e) - factor * vload(k + e));
      vstore(dk + e, vload(dk + e) - factor * vload(q + e));
    }
  }
}

static attention_backward_range attention_find_backward_range(const attention_backward_job *job, int64_t index) {
  const ast_attention *s = job->s;
  const int64_t b = scene_at(job->first_task, s->B, index), D = s->D;
  const attention_backward_cut *cut = job->cuts + b;
  const int64_t h = (index - job->first_task[b]) / cut->parts, part = (index - job->first_task[b]) % cut->parts;
  attention_backward_range r = {.cut = cut, .b = b, .h = h, .queries = cut->queries, .keys = cut->keys};
  const int64_t before = part * cut->part_rows;
  float *partial = job->partials + cut->first_partial + (h * (cut->parts - 1) + part - 1) * cut->partial_size;
  if (cut->by_queries) r.first_query = before, r.queries = min64(cut->part_rows, r.queries - before);
  else r.first_key = before, r.keys = min64(cut->part_rows, r.keys - before);
  r.first_peak = cut->first_peak + h * cut->peaks + (cut->by_queries ? 0 : part * r.queries);
  r.dq = job->dq + (cut->q0 + r.first_query) * s->dq_stride + h * D, r.dq_stride = s->dq_stride;
  r.dk = job->dk + (cut->k0 + r.first_key) * s->dk_stride + h * D, r.dk_stride = s->dk_stride;
  r.dv = job->dv + (cut->k0 + r.first_key) * s->dv_stride + h * D, r.dv_stride = s->dv_stride;
  if (part > 0 && cut->by_queries) r.dk = partial, r.dv = partial + r.keys * D, r.dk_stride = r.dv_stride = D;
  if (part > 0 && !cut->by_queries) r.dq = partial, r.dq_stride = D;
  return r;
}

static ast_status attention_backward_task(int64_t index, void *context) {
  attention_backward_job *job = context;
  const attention_backward_range r = attention_find_backward_range(job, index);
  const int64_t D = job->s->D;
  if (r.keys == 0) attention_fill_rows(0, r.dq_stride, r.queries, D, r.dq);
  if (r.queries == 0)
    attention_fill_rows(0, r.dk_stride, r.keys, D, r.dk), attention_fill_rows(0, r.dv_stride, r.keys, D, r.dv);
  if (r.keys == 0 || r.queries == 0) return AST_OK;
  attention_backward_scratch *t = ast_scratch(sizeof *t);
  if (!t) return AST_NO_MEMORY;
  const dropout d = dropout_of(job->s, r.b, r.h);
  t->scale = attention_scale_of_scores(job->s->scale);
  for (int64_t i = 0; i < r.queries; i += CHUNK) {
    const int64_t rows = min64(CHUNK, r.queries - i), first = r.first_query + i;
    attention_load_queries(job, &r, first, rows, t);
    for (int64_t k0 = 0; k0 < r.keys; k0 += KEYS)
      attention_backward_block(job, &r, first, rows, r.first_key + k0, min64(KEYS, r.keys - k0), &d, t);
    attention_put_rows(t->dq, rows, D, attention_scale_of_queries(job->s->scale), false, r.dq + i * r.dq_stride,
                       r.dq_stride);
    attention_put_peaks(job, &r, first, rows, t);
  }
  return AST_OK;
}

/* Scene index / H and head index % H: adds the partial gradients to what the first part left, and settles the peaks. */
static ast_status attention_finish_backward_task(int64_t index, void *context) {
  const attention_backward_job *job = context;
  const ast_attention *s = job->s;
  const int64_t D = s->D, h = index % s->H;
  const attention_backward_cut *cut = job->cuts + index / s->H;
  for (int64_t part = 1; part < cut->parts; part++) {
    const float *partial = job->partials + cut->first_partial + (h * (cut->parts - 1) + part - 1) * cut->partial_size;
    for (int64_t i = 0; i < cut->partial_size / D; i++, partial += D) {
      float *to = !cut->by_queries ? job->dq + (cut->q0 + i) * s->dq_stride
                  : i < cut->keys  ? job->dk + (cut->k0 + i) * s->dk_stride
                                   : job->dv + (cut->k0 + i - cut->keys) * s->dv_stride;
      to += h * D;
      for (int64_t e = 0; e < D; e += VW) vstore(to + e, vload(to + e) + vload(partial + e));
    }
  }
  if (job->any_peaks) attention_settle_peaks(job, cut, h);
  return AST_OK;
}

static ast_status attention_backward(const ast_attention *s, const float *restrict q, const float *restrict k,
                                     const float *restrict v, const float *restrict out, const float *restrict maximum,
                                     const float *restrict sum, const float *restrict dout, float *restrict dq,
                                     float *restrict dk, float *restrict dv) {
  AST_SCRATCH_SCOPE;
  attention_backward_cut *cuts = ast_scratch(s->B * (int64_t)sizeof *cuts);
  int64_t *first_task = ast_scratch((s->B + 1) * (int64_t)sizeof *first_task), floats = 0, num_peaks = 0;
  if (!cuts || !first_task) return AST_NO_MEMORY;
  first_task[0] = 0;
  for (int64_t b = 0; b < s->B; b++) {
    cuts[b] = attention_cut_backward(s, b);
    cuts[b].first_partial = floats;
    cuts[b].first_peak = num_peaks;
    first_task[b + 1] = first_task[b] + s->H * cuts[b].parts;
    floats += s->H * (cuts[b].parts - 1) * cuts[b].partial_size;
    num_peaks += s->H * cuts[b].peaks;
  }
  attention_backward_peak *peaks = ast_scratch(num_peaks * (int64_t)sizeof *peaks);
  float *partials = ast_scratch(floats * (int64_t)sizeof *partials);
  if (!peaks || !partials) return AST_NO_MEMORY;
  attention_backward_job job = {s,  q,  k,  v,    out,        maximum,  sum,   dout,
                                dq, dk, dv, cuts, first_task, partials, peaks, false};
  const ast_status status = ast_parallel(first_task[s->B], attention_backward_task, &job);
  return status == AST_OK && (floats || job.any_peaks) ? ast_parallel(s->B * s->H, attention_finish_backward_task, &job)
                                                       : status;
}
