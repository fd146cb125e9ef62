/* Attention: out = dropout(softmax(scale Q K^T)) V for each scene and head, without a Tq x Tk array.
 *
 * Keys come in blocks. With x_j the scores of one query against a block, m their running maximum, l the running sum of
 * the weights and o the running sum of the weighted values,
 *
 *   m' = max(m, max_j x_j),   p_j = exp(x_j - m'),
 *   l' = l exp(m - m') + sum_j p_j,   o' = o exp(m - m') + sum_j p_j v_j,   and out = o / l at the end.
 *
 * The weights carry a factor 1 / unit. The factor is 2^LIFT, so that a small weight times a small value keeps its
 * digits, until a value above FLT_MAX 2^(-LIFT - shift) comes, with 2^shift >= Tk. From then on it is 2^-shift, so that
 * l <= 1 and |o| <= max |v|: nothing overflows that the result would not. A row with a NaN or +inf score, or with
 * nothing but -inf, is NaN, as x - max says.
 *
 * A task is one scene and head, QUERIES queries and one part of the keys. Only a scene of few tasks and many keys has
 * more than one part; its parts leave (m, l, o), merged in their order by the same formula. All sizes depend on the
 * scene's own numbers of queries, keys and heads, so a result depends on neither threads nor batch.
 *
 * Cost: 4 Tq Tk D flops a head in two products, and some 15 vector operations (26 with dropout) a vector of scores
 * between them.
 */
#include <float.h>

#include "ast.h"
#include "attention_tiles.h"
#include "dropout.h"
#ifdef AST_BFLOAT16
#include "attention_bfloat16.h"
#endif

enum {
  QUERIES = 512,     /* of a task, which share the copies of its keys; the panels stay in the second cache */
  PARTED_TASKS = 16, /* a scene with fewer tasks is cut over its keys as well, */
  PART_KEYS = 1024,  /* into parts of at least this number */
  LIFT = 40,         /* a power of 2: what small weights are raised by */
};
_Static_assert(QUERIES % LANES == 0 && (int)KEYS == DROPOUT_KEYS,
               "tasks hold whole panels, blocks one group of the dropout");

/* How a scene is cut. */
typedef struct {
  int64_t q0, queries, k0, keys;    /* its rows */
  int64_t chunks, parts, part_keys; /* of queries; of keys; keys of a part */
  int64_t partial_rows;             /* queries of the states that the parts leave */
  int64_t partial_floats;           /* floats of such a state */
  int64_t first_partial;            /* floats of such states before this scene */
} attention_forward_cut;

typedef struct {
  const ast_attention *s;
  const float *q, *k, *v;
  float *out, *maximum, *sum;
  const attention_forward_cut *cuts;       /* [B] */
  const int64_t *first_task, *first_merge; /* [B+1] of each scene */
  float *partials;
} attention_forward_job;

/* What a task knows of its queries: o [query][ROW], m and l [query], and the unit of all weights. */
typedef struct {
  float *out, *maximum, *sum, *unit;
} attention_forward_state;

typedef struct {
  float keys[KEYS * ROW], values[KEYS * ROW];
  float scores[KEYS * ROW];
  dropout_words words[2];
  float queries[QUERIES * MAX_D]; /* scale Q in panels, */
  float scale;                    /* or Q and the scale of its scores, which is 1 otherwise */
  float out[QUERIES * ROW], maximum[QUERIES], sum[QUERIES], unit;
#ifdef AST_BFLOAT16
  float query_pairs[QUERIES / 2 * (MAX_D + BFLOAT16_STEP)];
  attention_rounded rounded;
#endif
} attention_forward_scratch;

/* The scene, head, queries and keys of a task. */
typedef struct {
  const attention_forward_cut *cut;
  int64_t b, h, part, first_query, rows, first_key, keys;
  int32_t shift;
} attention_forward_range;

/* ---- a panel against a block of keys ---- */

/* Scores of n keys against the queries i0..i0+LANES, and their maximum; later out[query] = fade[query] out[query] + the
 * values weighted by what became of the scores, or these alone without fade. */
#ifdef AST_BFLOAT16
static void attention_panel_scores(attention_forward_scratch *t, int64_t i0, int64_t n, int64_t D, vf largest[2]) {
  const float *pairs = t->query_pairs + i0 / 2 * round_up(D, BFLOAT16_STEP);
  attention_rounded_scores(n, D, pairs, &t->rounded, t->scores, largest);
}
static void attention_panel_product(attention_forward_scratch *t, int64_t rows, int64_t n, int64_t D, float *out,
                                    const float *fade) {
  (void)rows;
  attention_rounded_product(D, n, t->scores, &t->rounded, out, fade);
}
#else
static void attention_panel_scores(attention_forward_scratch *t, int64_t i0, int64_t n, int64_t D, vf largest[2]) {
  attention_scores(round_up(n, ROW_STEP), D, t->keys, t->queries + i0 * D, t->scores, largest);
}
static void attention_panel_product(attention_forward_scratch *t, int64_t rows, int64_t n, int64_t D, float *out,
                                    const float *fade) {
  attention_faded_product(round_up(rows, ROW_STEP), D, n, t->scores, t->values, out, fade);
}
#endif

/* Scores x become exp(x - base) 2^-shift; their sums over the n keys. */
AST_INLINE void attention_weights(float *x, int64_t n, const vf base[2], int32_t shift, vf sum[2]) {
  for (int64_t j = 0; j < n; j++) {
    EACH(2, c) {
      const vf p = vexp(vload(x + j * ROW + c * VW) - base[c], shift);
      sum[c] += p;
      vstore(x + j * ROW + c * VW, p);
    }
  }
}

/* The same, with dropped weights 0; the sums are of all. */
AST_INLINE void attention_dropped_weights(float *x, int64_t n, const vf base[2], int32_t shift, const dropout *d,
                                          dropout_words words[2], vf sum[2]) {
  const vu threshold = (vu){0} + (d->threshold << 16);
  EACH(DROPOUT_SLOTS, slot) {
    for (int64_t lane = 0; lane < min64(n - slot * DROPOUT_LANES, DROPOUT_LANES); lane++) {
      EACH(2, c) {
        float *to = x + (slot * DROPOUT_LANES + lane) * ROW + c * VW;
        const vf p = vexp(vload(to) - base[c], shift);
        sum[c] += p;
        vstore(to, dropout_keep(words[c][lane], slot, threshold, p));
      }
    }
  }
}

/* Scores of n keys times a factor, and their maximum. */
static __attribute__((noinline)) void attention_scale_scores(int64_t n, float factor, float *x, vf largest[2]) {
  EACH(2, c) largest[c] = vsplat(-INFINITY);
  for (int64_t j = 0; j < n; j++) {
    EACH(2, c) {
      const vf scaled = factor * vload(x + j * ROW + c * VW);
      vstore(x + j * ROW + c * VW, scaled);
      largest[c] = vmax(scaled, largest[c]);
    }
  }
}

/* Takes n keys, k0 the first of them in the scene, into the state of a panel, the queries i0..i0+rows of the task. */
static void attention_forward_panel(attention_forward_scratch *t, const attention_forward_state *state, int64_t i0,
                                    int64_t rows, int64_t query, int64_t k0, int64_t n, int64_t D, int32_t shift,
                                    bool first, const dropout *d) {
  float *m = state->maximum + i0, *l = state->sum + i0, fade[LANES];
  vf largest[2] = {vsplat(-INFINITY), vsplat(-INFINITY)}, base[2], sum[2] = {{0}};
  attention_panel_scores(t, i0, n, D, largest);
  if (t->scale != 1) attention_scale_scores(n, t->scale, t->scores, largest);
  EACH(2, c) {
    const vf before = vload(m + c * VW), now = vmax(largest[c], before);
    base[c] = vselect(now == -INFINITY, (vf){0}, now); /* only -inf so far: weights 0, not NaN */
    vstore(fade + c * VW, vexp(before - base[c], 0));
    vstore(m + c * VW, now);
  }
  if (d->threshold) {
    for (int64_t c = 0; c < 2; c++) dropout_draw_queries(d, query + c * VW, k0, n, t->words[c]);
    attention_dropped_weights(t->scores, n, base, shift, d, t->words, sum);
  } else {
    attention_weights(t->scores, n, base, shift, sum);
  }
  EACH(2, c) vstore(l + c * VW, vload(l + c * VW) * vload(fade + c * VW) + sum[c]);
  attention_panel_product(t, rows, n, D, state->out + i0 * ROW, first ? NULL : fade);
}

/* Whether one of the n rows has a number of larger magnitude. */
static bool attention_holds_larger(const float *rows, int64_t n, int64_t D, float limit) {
  vf largest = {0};
  for (int64_t i = 0; i < n; i++)
    for (int64_t d = 0; d < D; d += VW) {
      const vf x = vload(rows + i * ROW + d);
      largest = vmax(vmax(x, -x), largest);
    }
  bool larger = false;
  for (int64_t i = 0; i < VW; i++) larger |= largest[i] > limit;
  return larger;
}

/* Another unit of the weights in the first rows of a state. */
static void attention_set_unit(const attention_forward_state *state, int64_t rows, int64_t D, float unit) {
  const float factor = *state->unit / unit;
  *state->unit = unit;
  for (int64_t i = 0; i < rows; i++) {
    state->sum[i] *= factor;
    for (int64_t d = 0; d < D; d += VW) {
      float *o = state->out + i * ROW + d;
      vstore(o, factor * vload(o));
    }
  }
}

/* ---- tasks ---- */

static attention_forward_cut attention_cut_forward(const ast_attention *s, int64_t b) {
  attention_forward_cut cut = {.q0 = s->q_offsets[b], .k0 = s->k_offsets[b]};
  cut.queries = s->q_offsets[b + 1] - cut.q0;
  cut.keys = s->k_offsets[b + 1] - cut.k0;
  cut.chunks = divide_up(cut.queries, QUERIES);
  const int64_t wanted = min64(PARTED_TASKS / max64(cut.chunks * s->H, 1), divide_up(cut.keys, PART_KEYS));
  cut.part_keys = round_up(divide_up(cut.keys, max64(wanted, 1)), KEYS);
  cut.partial_rows = min64(QUERIES, round_up(cut.queries, LANES));
  cut.partial_floats = cut.partial_rows * (ROW + 2) + VW;
  cut.parts = cut.keys ? divide_up(cut.keys, cut.part_keys) : 1;
  return cut;
}

/* Task `index`, or that merge: merges are not parted. */
static attention_forward_range attention_find_forward_range(const attention_forward_job *job, int64_t index,
                                                            bool merge) {
  const int64_t *first = merge ? job->first_merge : job->first_task, b = scene_at(first, job->s->B, index);
  const attention_forward_cut *cut = job->cuts + b;
  const int64_t parts = merge ? 1 : cut->parts, local = index - first[b];
  attention_forward_range t = {
      .cut = cut, .b = b, .h = local / (cut->chunks * parts), .part = local / cut->chunks % parts};
  t.first_query = local % cut->chunks * QUERIES;
  t.rows = min64(QUERIES, cut->queries - t.first_query);
  t.first_key = t.part * cut->part_keys;
  t.keys = min64(cut->part_keys, cut->keys - t.first_key);
  t.shift = num_bits((uint64_t)max64(cut->keys - 1, 0));
  return t;
}

/* What `part` leaves of the task's queries. */
static attention_forward_state attention_partial_of(const attention_forward_job *job, const attention_forward_range *t,
                                                    int64_t part) {
  const attention_forward_cut *cut = t->cut;
  const int64_t number = (t->h * cut->chunks + t->first_query / QUERIES) * cut->parts + part, rows = cut->partial_rows;
  float *out = job->partials + cut->first_partial + number * cut->partial_floats;
  return (attention_forward_state){out, out + rows * ROW, out + rows * (ROW + 1), out + rows * (ROW + 2)};
}

/* out = gain o / l, maximum and sum of the task's queries */
static void attention_finish_forward(const attention_forward_job *job, const attention_forward_range *t,
                                     const attention_forward_state *state) {
  const ast_attention *s = job->s;
  const int64_t H = s->H, D = s->D, q0 = t->cut->q0 + t->first_query;
  const float gain = dropout_of(s, t->b, t->h).gain;
  for (int64_t i = 0; i < t->rows; i++) {
    const float l = state->sum[i] > 0 ? state->sum[i] : NAN, factor = gain / l;
    job->maximum[(q0 + i) * H + t->h] = l > 0 ? state->maximum[i] : NAN;
    job->sum[(q0 + i) * H + t->h] = *state->unit * l;
    float *out = job->out + ((q0 + i) * H + t->h) * D;
    for (int64_t d = 0; d < D; d += VW) vstore(out + d, factor * vload(state->out + i * ROW + d));
  }
}

static ast_status attention_forward_task(int64_t index, void *context) {
  const attention_forward_job *job = context;
  const ast_attention *s = job->s;
  const attention_forward_range task = attention_find_forward_range(job, index, false);
  const int64_t H = s->H, D = s->D, h = task.h, rows = task.rows, q0 = task.cut->q0 + task.first_query;
  if (task.keys == 0) {
    attention_fill_rows(0, H * D, rows, D, job->out + (q0 * H + h) * D);
    attention_fill_rows(-INFINITY, H, rows, 1, job->maximum + q0 * H + h);
    attention_fill_rows(0, H, rows, 1, job->sum + q0 * H + h);
    return AST_OK;
  }
  attention_forward_scratch *t = ast_scratch(sizeof *t);
  if (!t) return AST_NO_MEMORY;
  const bool whole = task.cut->parts == 1;
  const attention_forward_state state = whole ? (attention_forward_state){t->out, t->maximum, t->sum, &t->unit}
                                              : attention_partial_of(job, &task, task.part);
  const dropout d = dropout_of(s, task.b, h);
  const int64_t panels = divide_up(rows, LANES), share = divide_up(KEYS, panels);
  for (int64_t p = 0; p < panels; p++)
    attention_pack_panel(job->q + (q0 + p * LANES) * s->q_stride + h * D, s->q_stride, rows - p * LANES, D,
                         attention_scale_of_queries(s->scale), t->queries + p * LANES * D);
#ifdef AST_BFLOAT16
  for (int64_t p = 0; p < panels; p++)
    attention_round_queries(t->queries + p * LANES * D, D, t->query_pairs + p * LANES / 2 * round_up(D, BFLOAT16_STEP));
#endif
  t->scale = attention_scale_of_scores(s->scale);
  attention_fill_rows(0, 0, 1, panels * LANES, state.sum);
  attention_fill_rows(-INFINITY, 0, 1, panels * LANES, state.maximum);
  *state.unit = ldexpf(1, -LIFT);
  for (int64_t k0 = 0; k0 < task.keys; k0 += KEYS) {
    const int64_t n = min64(KEYS, task.keys - k0), row = task.cut->k0 + task.first_key + k0;
    const float *k = job->k + row * s->k_stride + h * D, *v = job->v + row * s->v_stride + h * D;
    attention_copy_rows(k, s->k_stride, n, D, 1, t->keys);
    attention_copy_rows(v, s->v_stride, n, D, 1, t->values);
#ifdef AST_BFLOAT16
    attention_round_block(n, D, t->keys, t->values, &t->rounded);
#endif
    if (*state.unit < 1 && attention_holds_larger(t->values, n, D, ldexpf(FLT_MAX, -LIFT - task.shift)))
      attention_set_unit(&state, k0 ? panels * LANES : 0, D, ldexpf(1, task.shift));
    for (int64_t p = 0; p < panels; p++) {
      const int64_t next = KEYS + p * share, ahead = min64(share, task.keys - k0 - next);
      attention_prefetch_rows(k + next * s->k_stride, s->k_stride, ahead, D, 0);
      attention_prefetch_rows(v + next * s->v_stride, s->v_stride, ahead, D, 0);
      attention_forward_panel(t, &state, p * LANES, min64(LANES, rows - p * LANES), task.first_query + p * LANES,
                              task.first_key + k0, n, D, *state.unit < 1 ? -LIFT : task.shift, k0 == 0, &d);
    }
  }
  if (whole) attention_finish_forward(job, &task, &state);
  return AST_OK;
}

/* Merges the parts of one scene, head and chunk of queries, in their order. */
static ast_status attention_merge_task(int64_t index, void *context) {
  const attention_forward_job *job = context;
  const attention_forward_range task = attention_find_forward_range(job, index, true);
  const int64_t D = job->s->D;
  const attention_forward_state into = attention_partial_of(job, &task, 0);
  for (int64_t part = 1; part < task.cut->parts; part++) {
    const attention_forward_state from = attention_partial_of(job, &task, part);
    const float unit = *from.unit > *into.unit ? *from.unit : *into.unit;
    attention_set_unit(&into, task.rows, D, unit);
    attention_set_unit(&from, task.rows, D, unit);
    float fade[QUERIES], weight[QUERIES];
    for (int64_t i = 0; i < task.rows; i += VW) {
      const vf before = vload(into.maximum + i), other = vload(from.maximum + i), now = vmax(other, before);
      const vf base = vselect(now == -INFINITY, (vf){0}, now);
      vstore(fade + i, vexp(before - base, 0));
      vstore(weight + i, vexp(other - base, 0));
      vstore(into.maximum + i, now);
      vstore(into.sum + i, vload(into.sum + i) * vload(fade + i) + vload(from.sum + i) * vload(weight + i));
    }
    for (int64_t i = 0; i < task.rows; i++)
      for (int64_t d = 0; d < D; d += VW) {
        float *o = into.out + i * ROW + d;
        vstore(o, vload(o) * fade[i] + vload(from.out + i * ROW + d) * weight[i]);
      }
  }
  attention_finish_forward(job, &task, &into);
  return AST_OK;
}

static ast_status attention(const ast_attention *s, const float *restrict q, const float *restrict k,
                            const float *restrict v, float *restrict out, float *restrict maximum,
                            float *restrict sum) {
  AST_SCRATCH_SCOPE;
  attention_forward_cut *cuts = ast_scratch(s->B * (int64_t)sizeof *cuts);
  int64_t *first_task = ast_scratch(2 * (s->B + 1) * (int64_t)sizeof *first_task), floats = 0;
  if (!cuts || !first_task) return AST_NO_MEMORY;
  int64_t *first_merge = first_task + s->B + 1;
  first_task[0] = first_merge[0] = 0;
  for (int64_t b = 0; b < s->B; b++) {
    cuts[b] = attention_cut_forward(s, b);
    cuts[b].first_partial = floats;
    const int64_t chunks = s->H * cuts[b].chunks, merges = cuts[b].parts > 1 ? chunks : 0;
    first_task[b + 1] = first_task[b] + chunks * cuts[b].parts;
    first_merge[b + 1] = first_merge[b] + merges;
    floats += merges * cuts[b].parts * cuts[b].partial_floats;
  }
  float *partials = ast_scratch(floats * (int64_t)sizeof *partials);
  if (!partials) return AST_NO_MEMORY;
  attention_forward_job job = {s, q, k, v, out, maximum, sum, cuts, first_task, first_merge, partials};
  const ast_status status = ast_parallel(first_task[s->B], attention_forward_task, &job);
  return status == AST_OK ? ast_parallel(first_merge[s->B], attention_merge_task, &job) : status;
}
