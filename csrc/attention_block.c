/* An attention block as a whole, and its gradients.
 *
 *   q = W_q LN(x),   [k, v] = W_kv LN_c(context),   m = attention(rotated q, rotated k, v),   y = x + W_o m + b_o
 *   z = [a, b] = W_1 LN_f(y) + b_1,   h = a . gelu(b),   out = y + W_2 h + b_2
 *
 * It is made of the kernels of its parts, one after another on arrays in scratch memory, so its rows and its gradients
 * have their bits. What it saves is what calls of small kernels cost. A rotation turns each pair of channels (u, w) of
 * a head into (u cos - w sin, w cos + u sin) (Su et al. 2021); its gradient turns them back. The gradients go through
 * the parts in the opposite order; normalized rows are computed again, everything else is read if it was kept.
 *
 * Memory: rows of x, q, y and the hidden units, and of the context, k and v; backward also their gradients.
 */
#include "weight_panels.h"
#include "norm.h"

/* ---- rows ---- */

typedef struct {
  const float *x, *gamma, *beta; /* normalized; or */
  const float *rotations;        /* [M,D] cosine and sine of each pair, which turn H heads in place, */
  bool back;                     /* or turn them back */
  int64_t M, n, H, D;            /* n floats from row to row */
  float *to;
} block_rows;

static ast_status block_norm_task(int64_t index, void *context) {
  const block_rows *job = context;
  const int64_t n = job->n, first = index * DENSE_ROWS, last = min64(job->M, first + DENSE_ROWS);
  float *y = ast_scratch(round_up(n, VW) * (int64_t)sizeof *y);
  if (!y) return AST_NO_MEMORY;
  for (int64_t i = first; i < last; i++) {
    dense_copy_rows(job->x + i * n, n, 1, n, y, 0);
    const float scale = n % VW ? norm_centre(y, n, false) : norm_centre(y, n, true);
    for (int64_t j = 0; j < n; j += VW)
      vstore_upto(job->to + i * n + j, norm_out(scale * vload(y + j), job->gamma, job->beta, j, n - j), n - j);
  }
  return AST_OK;
}

static ast_status block_rotate_task(int64_t index, void *context) {
  const block_rows *job = context;
  const int64_t D = job->D, first = index * DENSE_ROWS, last = min64(job->M, first + DENSE_ROWS);
  const vi odd = (LANE_INDICES & 1) == 1;
  for (int64_t i = first; i < last; i++)
    for (int64_t d = 0; d < D; d += VW) {
      const vf pair = vload(job->rotations + i * D + d), swapped = vswap(pair, 1);
      const vf cosine = vselect(odd, swapped, pair), turn = vselect(odd, pair, -swapped),
               sine = job->back ? -turn : turn;
      for (float *to = job->to + i * job->n + d, *end = to + job->H * D; to < end; to += D) {
        const vf x = vload(to);
        vstore(to, x * cosine + vswap(x, 1) * sine);
      }
    }
  return AST_OK;
}

static ast_status block_norm(const float *x, int64_t M, int64_t n, const float *gamma, const float *beta, float *to) {
  block_rows job = {.x = x, .gamma = gamma, .beta = beta, .M = M, .n = n, .to = to};
  return ast_parallel(divide_up(M, DENSE_ROWS), block_norm_task, &job);
}

static ast_status block_rotate(const ast_attention_block *s, const float *rotations, bool back, int64_t M, int64_t n,
                               float *to) {
  block_rows job = {.rotations = rotations, .back = back, .M = M, .n = n, .H = s->H, .D = s->D, .to = to};
  return rotations ? ast_parallel(divide_up(M, DENSE_ROWS), block_rotate_task, &job) : AST_OK;
}

/* ---- forward ---- */

static ast_status block_linear(const float *x, int64_t M, int64_t I, int64_t O, ast_activation activation,
                               const float *weight, const float *bias, const float *residual, float *out, float *z) {
  const ast_linear sizes = {
      .M = M, .I = I, .O = O, .x_stride = I, .weight_stride = I, .residual_stride = O, .activation = activation};
  return linear(&sizes, x, weight, bias, residual, out, z);
}

static float *block_floats(int64_t num) { return ast_scratch(num * (int64_t)sizeof(float)); }
static float *block_kept(float *kept, int64_t num) { return kept ? kept : block_floats(num); }

static ast_attention block_attention(const ast_attention_block *s) {
  const int64_t I = s->H * s->D;
  return (ast_attention){.B = s->B,
                         .H = s->H,
                         .D = s->D,
                         .q_offsets = s->q_offsets,
                         .k_offsets = s->k_offsets,
                         .q_stride = I,
                         .k_stride = 2 * I,
                         .v_stride = 2 * I,
                         .scale = (float)(1 / sqrt((double)s->D)),
                         .dq_stride = I,
                         .dk_stride = 2 * I,
                         .dv_stride = 2 * I};
}

#define THEN(call) status = status == AST_OK ? (call) : status

static ast_status attention_block(const ast_attention_block *s, float *restrict out, ast_attention_block_kept kept) {
  AST_SCRATCH_SCOPE;
  const int64_t Q = s->Q, K = s->K, W = s->W, C = s->C, F = s->F, I = s->H * s->D;
  float *normed = block_floats(max64(Q * W, K * C)), *queries = block_kept(kept.queries, Q * I);
  float *keys_values = block_kept(kept.keys_values, K * 2 * I), *mixed = block_kept(kept.mixed, Q * I);
  float *maximum = block_kept(kept.maximum, Q * s->H), *total = block_kept(kept.total, Q * s->H);
  float *y = block_kept(kept.y, Q * W), *hidden = block_kept(kept.hidden, Q * F);
  if (!normed || !queries || !keys_values || !mixed || !maximum || !total || !y || !hidden) return AST_NO_MEMORY;
  const ast_attention sizes = block_attention(s);
  ast_status status = block_norm(s->x, Q, W, s->gamma, s->beta, normed);
  THEN(block_linear(normed, Q, W, I, AST_IDENTITY, s->query, NULL, NULL, queries, NULL));
  THEN(block_rotate(s, s->rotations, false, Q, I, queries));
  THEN(block_norm(s->context, K, C, s->context_gamma, s->context_beta, normed));
  THEN(block_linear(normed, K, C, 2 * I, AST_IDENTITY, s->key_value, NULL, NULL, keys_values, NULL));
  THEN(block_rotate(s, s->context_rotations, false, K, 2 * I, keys_values));
  THEN(attention(&sizes, queries, keys_values, keys_values + I, mixed, maximum, total));
  THEN(block_linear(mixed, Q, I, W, AST_IDENTITY, s->weight, s->bias, s->x, y, NULL));
  THEN(block_norm(y, Q, W, s->inner_gamma, s->inner_beta, normed));
  THEN(block_linear(normed, Q, W, 2 * F, AST_GEGLU, s->first, s->first_bias, NULL, hidden, kept.z));
  THEN(block_linear(hidden, Q, F, W, AST_IDENTITY, s->second, s->second_bias, y, out, NULL));
  return status;
}

/* ---- backward ---- */

typedef struct {
  const float *x, *gamma, *dout, *also; /* LN(x) [M,n] has the gradient dout; also, or NULL, is added to dx */
  float *dx;                            /* or NULL */
  int64_t M, n;
  dense_chunks chunks;
  dense_partials partials; /* of dgamma and dbeta */
} block_norm_job;

enum { BLOCK_DGAMMA, BLOCK_DBETA, BLOCK_SUMS };

/* dx of some rows; dgamma and dbeta are added to. `whole`, a constant, says that n is a multiple of VW. */
AST_INLINE void block_norm_back(const block_norm_job *job, int64_t first, int64_t rows, float *y,
                                const norm_columns *columns, const bool whole) {
  const int64_t n = job->n;
  for (int64_t i = first; i < first + rows; i++) {
    dense_copy_rows(job->x + i * n, n, 1, n, y, 0);
    const float scale = norm_centre(y, n, whole);
    norm_backward(i, n, whole, job->gamma, job->dout + i * n, NULL, scale, NULL, y, columns);
    for (int64_t j = 0; job->dx && j < n; j += VW) {
      const vf also = job->also ? vload_upto(job->also + i * n + j, n - j) : (vf){0};
      vstore_upto(job->dx + i * n + j, vload(y + j) + also, n - j);
    }
  }
}

static ast_status block_norm_back_task(int64_t index, void *context) {
  const block_norm_job *job = context;
  const dense_sum *sums = job->partials.sums;
  const int64_t row = sums[BLOCK_DGAMMA].row, first = index * job->chunks.rows,
                last = min64(job->M, first + job->chunks.rows);
  float *y = block_floats((1 + NORM_COLUMNS) * row),
        *partials = dense_start_chunk(&job->partials, index, first >= last);
  if (!y) return AST_NO_MEMORY;
  const norm_columns columns = norm_new_columns(y + row, row);
  for (int64_t i = first, block = 0; i < last; i += job->chunks.step, block++) {
    const int64_t rows = min64(job->chunks.step, last - i);
    dense_begin_block(&job->partials, block, partials);
    norm_clear_columns(&columns); /* sums of the block first, so that long sums stay accurate */
    if (job->n % VW) block_norm_back(job, i, rows, y, &columns, false);
    else block_norm_back(job, i, rows, y, &columns, true);
    dense_add_rows(columns.dgamma, row, NORM_CHAINS, row, partials + sums[BLOCK_DGAMMA].at);
    dense_add_rows(columns.dbeta, row, NORM_CHAINS, row, partials + sums[BLOCK_DBETA].at);
  }
  return AST_OK;
}

static ast_status block_norm_backward(const float *x, int64_t M, int64_t n, const float *gamma, const float *dout,
                                      const float *also, float *dx, float *dgamma, float *dbeta) {
  AST_SCRATCH_SCOPE;
  block_norm_job job = {.x = x, .gamma = gamma, .dout = dout, .also = also, .dx = dx, .M = M, .n = n};
  dense_sum sums[BLOCK_SUMS] = {{.to = dgamma, .rows = 1, .n = n}, {.to = dbeta, .rows = 1, .n = n}};
  job.partials = dense_place_sums(sums, BLOCK_SUMS);
  job.chunks = dense_cut(M, job.partials.size);
  if (!dense_new_partials(&job.partials, job.chunks.num, dense_blocks(job.chunks))) return AST_NO_MEMORY;
  const ast_status status = ast_parallel(job.chunks.num, block_norm_back_task, &job);
  return status == AST_OK ? dense_add_partials(&job.partials) : status;
}

static ast_status block_linear_backward(const float *dout, const float *x, int64_t M, int64_t I, int64_t O,
                                        ast_activation activation, const float *weight, const float *bias,
                                        const float *z, float *dx, float *dweight, float *dbias) {
  const ast_linear sizes = {.M = M,
                            .I = I,
                            .O = O,
                            .x_stride = I,
                            .weight_stride = I,
                            .dout_stride = activation == AST_GEGLU ? O / 2 : O,
                            .activation = activation};
  return linear_backward(&sizes, dout, x, weight, bias, z, dx, dweight, dbias);
}

static ast_status attention_block_backward(const ast_attention_block *s, const float *restrict dout,
                                           ast_attention_block_kept kept, ast_attention_block_gradients g) {
  AST_SCRATCH_SCOPE;
  const int64_t Q = s->Q, K = s->K, W = s->W, C = s->C, F = s->F, I = s->H * s->D, rows = max64(Q * W, K * C);
  float *normed = block_floats(rows), *dnormed = block_floats(rows), *dhidden = block_floats(Q * F);
  float *dy = block_floats(Q * W), *dmixed = block_floats(Q * I), *dqueries = block_floats(Q * I);
  float *dkeys_values = block_floats(K * 2 * I);
  if (!normed || !dnormed || !dhidden || !dy || !dmixed || !dqueries || !dkeys_values) return AST_NO_MEMORY;
  const ast_attention sizes = block_attention(s);
  /* forward: out = y + W_2 h + b_2, h = geglu(W_1 LN_f(y) + b_1) */
  ast_status status = block_linear_backward(dout, kept.hidden, Q, F, W, AST_IDENTITY, s->second, NULL, NULL, dhidden,
                                            g.second, g.second_bias);
  THEN(block_norm(kept.y, Q, W, s->inner_gamma, s->inner_beta, normed));
  THEN(block_linear_backward(dhidden, normed, Q, W, 2 * F, AST_GEGLU, s->first, s->first_bias, kept.z, dnormed, g.first,
                             g.first_bias));
  THEN(block_norm_backward(kept.y, Q, W, s->inner_gamma, dnormed, dout, dy, g.inner_gamma, g.inner_beta));
  /* forward: y = x + W_o m + b_o */
  THEN(block_linear_backward(dy, kept.mixed, Q, I, W, AST_IDENTITY, s->weight, NULL, NULL, dmixed, g.weight, g.bias));
  THEN(attention_backward(&sizes, kept.queries, kept.keys_values, kept.keys_values + I, kept.mixed, kept.maximum,
                          kept.total, dmixed, dqueries, dkeys_values, dkeys_values + I));
  /* forward: q = W_q LN(x), [k, v] = W_kv LN_c(context) */
  THEN(block_rotate(s, s->rotations, true, Q, I, dqueries));
  THEN(block_norm(s->x, Q, W, s->gamma, s->beta, normed));
  THEN(block_linear_backward(dqueries, normed, Q, W, I, AST_IDENTITY, s->query, NULL, NULL, dnormed, g.query, NULL));
  THEN(block_norm_backward(s->x, Q, W, s->gamma, dnormed, dy, g.x, g.gamma, g.beta));
  THEN(block_rotate(s, s->context_rotations, true, K, 2 * I, dkeys_values));
  THEN(block_norm(s->context, K, C, s->context_gamma, s->context_beta, normed));
  THEN(block_linear_backward(dkeys_values, normed, K, C, 2 * I, AST_IDENTITY, s->key_value, NULL, NULL, dnormed,
                             g.key_value, NULL));
  THEN(block_norm_backward(s->context, K, C, s->context_gamma, dnormed, NULL, g.context, g.context_gamma,
                           g.context_beta));
  return status;
}
#undef THEN
