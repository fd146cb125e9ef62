/* An attention block as a whole, without gradients.
 *
 *   q = W_q LN(x),   [k, v] = W_kv LN_c(context),   y = x + W_o attention(rotated q, rotated k, v) + b_o
 *   [a, b] = W_1 LN_f(y) + b_1,   out = y + W_2 (a . gelu(b)) + b_2
 *
 * It is made of the kernels of its parts, one after another on arrays in scratch memory, so its rows have their bits.
 * What it saves is what calls of small kernels cost. A rotation turns each pair of channels (u, w) of a head into
 * (u cos - w sin, w cos + u sin) (Su et al. 2021).
 *
 * Memory: rows of x, q, y and the hidden units, and of the context, k and v.
 */
#include "weight_panels.h"
#include "norm.h"

/* ---- rows ---- */

typedef struct {
  const float *x, *gamma, *beta; /* normalized; or */
  const float *rotations;        /* [M,D] cosine and sine of each pair, which turn H heads in place */
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
      const vf cosine = vselect(odd, swapped, pair), sine = vselect(odd, pair, -swapped);
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

static ast_status block_rotate(const ast_attention_block *s, const float *rotations, int64_t M, int64_t n, float *to) {
  block_rows job = {.rotations = rotations, .M = M, .n = n, .H = s->H, .D = s->D, .to = to};
  return rotations ? ast_parallel(divide_up(M, DENSE_ROWS), block_rotate_task, &job) : AST_OK;
}

/* ---- the block ---- */

static ast_status block_linear(const float *x, int64_t M, int64_t I, int64_t O, ast_activation activation,
                               const float *weight, const float *bias, const float *residual, float *out) {
  const ast_linear sizes = {
      .M = M, .I = I, .O = O, .x_stride = I, .weight_stride = I, .residual_stride = O, .activation = activation};
  return linear(&sizes, x, weight, bias, residual, out, NULL);
}

static float *block_floats(int64_t num) { return ast_scratch(num * (int64_t)sizeof(float)); }

static ast_status attention_block(const ast_attention_block *s, float *restrict out) {
  AST_SCRATCH_SCOPE;
  const int64_t Q = s->Q, K = s->K, W = s->W, C = s->C, F = s->F, I = s->H * s->D;
  float *normed = block_floats(max64(Q * W, K * C)), *query = block_floats(Q * I), *key_value = block_floats(K * 2 * I);
  float *mixed = block_floats(Q * I), *sums = block_floats(2 * Q * s->H), *y = block_floats(Q * W);
  float *hidden = block_floats(Q * F);
  if (!normed || !query || !key_value || !mixed || !sums || !y || !hidden) return AST_NO_MEMORY;
  const ast_attention sizes = {.B = s->B,
                               .H = s->H,
                               .D = s->D,
                               .q_offsets = s->q_offsets,
                               .k_offsets = s->k_offsets,
                               .q_stride = I,
                               .k_stride = 2 * I,
                               .v_stride = 2 * I,
                               .scale = (float)(1 / sqrt((double)s->D))};
  ast_status status = block_norm(s->x, Q, W, s->gamma, s->beta, normed);
#define THEN(call) status = status == AST_OK ? (call) : status
  THEN(block_linear(normed, Q, W, I, AST_IDENTITY, s->query, NULL, NULL, query));
  THEN(block_rotate(s, s->rotations, Q, I, query));
  THEN(block_norm(s->context, K, C, s->context_gamma, s->context_beta, normed));
  THEN(block_linear(normed, K, C, 2 * I, AST_IDENTITY, s->key_value, NULL, NULL, key_value));
  THEN(block_rotate(s, s->context_rotations, K, 2 * I, key_value));
  THEN(attention(&sizes, query, key_value, key_value + I, mixed, sums, sums + Q * s->H));
  THEN(block_linear(mixed, Q, I, W, AST_IDENTITY, s->weight, s->bias, s->x, y));
  THEN(block_norm(y, Q, W, s->inner_gamma, s->inner_beta, normed));
  THEN(block_linear(normed, Q, W, 2 * F, AST_GEGLU, s->first, s->first_bias, NULL, hidden));
  THEN(block_linear(hidden, Q, F, W, AST_IDENTITY, s->second, s->second_bias, y, out));
#undef THEN
  return status;
}
