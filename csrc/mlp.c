/* Two dense layers with a LayerNorm behind them, and their gradients; hidden units live between the two only if the caller keeps them.
 *
 *   h = max(0, [x, beside] W1^T + bias1),   y = h W2^T + bias2,   n = (y - mean(y)) / sqrt(var(y) + eps)
 *   out = gamma . n + beta + residual       (without norm: y + residual)
 *
 * Rows are taken in blocks that stay in the cache with all their intermediate values. Backward, with r = 1 / sqrt(var + eps),
 *
 *   dn = gamma . dout,   dy = r (dn - mean(dn) - n mean(dn . n)),   dz = [h > 0] . (dy W2)
 *   dW2 = dy^T h,   dW1 = dz^T [x, beside],   d[x, beside] = dz W1,   the other gradients sums of rows of dy, dz, dout and dout . n,
 *
 * h, n and r of a block are computed again, or read if the caller kept them. Sums over rows go chunk by chunk (weight_panels.h): they do
 * not depend on the threads, and a row's results depend on that row alone.
 *
 * Cost: 2 M H (I + I2 + O) operations forward and 4 M H (I + I2 + O) backward, 2 M H (I + I2 + O) more if nothing was kept.
 */
#include "ast.h"
#include "weight_panels.h"
#include "gemm.h"
#include "norm.h"
#include "simd.h"

static dense_layer mlp_layer(const float *weight, const float *bias, int64_t K, int64_t N) {
  return (dense_layer){.weight = weight, .row = 1, .column = K, .bias = bias, .K = K, .N = N};
}

/* [x, beside] of rows from `first` on, copied side by side; rows of the copy are padded with zeros to whole vectors */
static void mlp_copy_inputs(const ast_mlp *s, int64_t first, int64_t rows, float *to, int64_t row) {
  dense_copy_rows(s->x + first * s->x_stride, s->x_stride, rows, s->I, to, row);
  if (s->beside) dense_copy_rows(s->beside + first * s->beside_stride, s->beside_stride, rows, s->I2, to + s->I, row);
}

/* ---- forward ---- */

typedef struct {
  const ast_mlp *s;
  const float *residual;
  float *out;
  ast_mlp_kept kept;
  dense_layer layers[2];
  int64_t tasks, input_row, hidden_row, y_row; /* tasks; floats from row to row of a task's blocks */
} mlp_job;

enum { MLP_AHEAD = 6 }; /* rows */

/* out from y; `whole`, a constant, says that O is a multiple of VW, so that no vector asks for its tail */
AST_INLINE void mlp_norm_rows(const mlp_job *job, int64_t first, int64_t rows, float *y, const bool whole) {
  const ast_mlp *s = job->s;
  const int64_t O = s->O;
  for (int64_t i = first; i < first + rows; i++, y += job->y_row) {
    for (int64_t j = 0, later = min64(i + MLP_AHEAD, s->M - 1) * O; j < O; j += 16) { /* before a store has to wait for its line */
      __builtin_prefetch(job->out + later + j, 1);
      if (job->kept.normalized) __builtin_prefetch(job->kept.normalized + later + j, 1);
    }
    const float scale = norm_centre(y, O, whole);
    const float *residual = job->residual ? job->residual + i * s->residual_stride : NULL;
    float *out = job->out + i * O, *normalized = job->kept.normalized ? job->kept.normalized + i * O : NULL;
    if (job->kept.scale) job->kept.scale[i] = scale;
    for (int64_t j = 0; j < O; j += VW) {
      const int64_t lanes = whole ? VW : O - j;
      const vf n = scale * vload(y + j);
      vf value = norm_out(n, s->gamma, s->beta, j, lanes);
      if (residual) value += vload_upto(residual + j, lanes);
      vstore_upto(out + j, value, lanes);
      if (normalized) vstore_upto(normalized + j, n, lanes);
    }
  }
}

static ast_status mlp_task(int64_t index, void *context) {
  const mlp_job *job = context;
  const ast_mlp *s = job->s;
  const int64_t first_row = dense_begin(s->M, job->tasks, index), last = dense_begin(s->M, job->tasks, index + 1);
  float *input = ast_scratch(DENSE_ROWS * (job->input_row + job->hidden_row + job->y_row) * (int64_t)sizeof *input);
  float *block = input + DENSE_ROWS * job->input_row, *y = block + DENSE_ROWS * job->hidden_row;
  if (!input) return AST_NO_MEMORY;
  for (int64_t i = first_row; i < last; i += DENSE_ROWS) {
    const int64_t rows = min64(DENSE_ROWS, last - i), hidden_row = job->kept.hidden ? s->H : job->hidden_row;
    float *hidden = job->kept.hidden ? job->kept.hidden + i * s->H : block;
    gemm_a a = {s->x + i * s->x_stride, s->x_stride, 1};
    if (s->beside) {
      mlp_copy_inputs(s, i, rows, input, job->input_row);
      a = (gemm_a){input, job->input_row, 1};
    }
    const dense_end first = {.activation = AST_RELU,
                             .out = hidden,
                             .out_row = hidden_row,
                             .next = {dense_rows_from(s->x, s->x_stride, s->I, i + DENSE_ROWS, s->M),
                                      dense_rows_from(s->beside, s->beside_stride, s->I2, i + DENSE_ROWS, s->M)}};
    dense_rows(&job->layers[0], 0, dense_panels(&job->layers[0]), rows, a, first);
    a = (gemm_a){hidden, hidden_row, 1};
    if (s->gamma) {
      dense_rows(&job->layers[1], 0, dense_panels(&job->layers[1]), rows, a, (dense_end){.out = y, .out_row = job->y_row});
      if (s->O % VW) mlp_norm_rows(job, i, rows, y, false);
      else mlp_norm_rows(job, i, rows, y, true);
    } else {
      const dense_end second = {.out = job->out + i * s->O,
                                .out_row = s->O,
                                .residual = job->residual ? job->residual + i * s->residual_stride : NULL,
                                .residual_row = s->residual_stride};
      dense_rows(&job->layers[1], 0, dense_panels(&job->layers[1]), rows, a, second);
    }
  }
  return AST_OK;
}

static ast_status mlp(const ast_mlp *s, const float *restrict residual, float *restrict out, ast_mlp_kept kept) {
  AST_SCRATCH_SCOPE;
  mlp_job job = {.s = s, .residual = residual, .out = out, .kept = kept};
  job.layers[0] = mlp_layer(s->weight1, s->bias1, s->I + s->I2, s->H);
  job.layers[1] = mlp_layer(s->weight2, s->bias2, s->H, s->O);
  const int64_t rows = s->M >= 64 * DENSE_ROWS ? 4 * DENSE_ROWS : min64(DENSE_ROWS, max64(s->M / 8, 2 * GEMM_ROWS));
  job.tasks = min64(divide_up(s->M, GEMM_ROWS), round_up(divide_up(s->M, rows), 2));
  job.input_row = s->beside ? round_up(s->I + s->I2, VW) + DENSE_APART : 0;
  job.hidden_row = round_up(s->H, VW) + DENSE_APART;
  job.y_row = round_up(s->O, VW) + DENSE_APART;
  const ast_status status = dense_pack(job.layers, 2);
  return status == AST_OK ? ast_parallel(job.tasks, mlp_task, &job) : status;
}

/* ---- backward ---- */

enum { MLP_SUMS = 6 };

typedef struct {
  const ast_mlp *s;
  const float *dout;
  ast_mlp_kept kept;
  ast_mlp_gradients g;
  dense_layer layers[5]; /* both layers; W2^T; W1^T to x and to beside */
  int64_t input_row, hidden_row, y_row;
  bool into_hidden; /* whether anything before the hidden units wants a gradient */
  dense_chunks chunks;
  dense_sum sums[MLP_SUMS]; /* dW1, dbias1, dW2, dbias2, dgamma, dbeta in the partial sums of a chunk */
  float *partials;
  int64_t size;
} mlp_backward_job;

/* dy of the rows from `first` on, in the place of y, or of n, which is read if it was kept; dgamma and dbeta are added to */
AST_INLINE void mlp_norm_backward(const mlp_backward_job *job, int64_t first, int64_t rows, float *y, const norm_columns *columns,
                                  const bool whole) {
  const ast_mlp *s = job->s;
  for (int64_t i = first; i < first + rows; i++, y += job->y_row) {
    const float *kept = job->kept.normalized ? job->kept.normalized + i * s->O : NULL;
    const float scale = kept ? job->kept.scale[i] : norm_centre(y, s->O, whole);
    norm_backward(s->O, whole, s->gamma, job->dout + i * s->dout_stride, NULL, scale, kept, y, columns);
  }
}

/* One block: its dx and dbeside, and its part of all sums, added to those of the chunk. Rows that do not end with a vector are copied. */
static void mlp_backward_rows(const mlp_backward_job *job, int64_t first, int64_t rows, float *input, float *hidden, float *y,
                              float *partials, bool add) {
  const ast_mlp *s = job->s;
  const dense_sum *sums = job->sums;
  gemm_a inputs = {input, job->input_row, 1}, units = {hidden, job->hidden_row, 1};
  if (s->beside || s->I % VW) mlp_copy_inputs(s, first, rows, input, job->input_row);
  else inputs = (gemm_a){s->x + first * s->x_stride, s->x_stride, 1};
  if (job->kept.hidden && s->H % VW == 0) {
    units = (gemm_a){job->kept.hidden + first * s->H, s->H, 1};
  } else if (job->kept.hidden) {
    dense_copy_rows(job->kept.hidden + first * s->H, s->H, rows, s->H, hidden, job->hidden_row);
  } else {
    const dense_end end = {.activation = AST_RELU, .out = hidden, .out_row = job->hidden_row};
    dense_rows(&job->layers[0], 0, dense_panels(&job->layers[0]), rows, inputs, end);
  }
  if (!s->gamma) {
    dense_copy_rows(job->dout + first * s->dout_stride, s->dout_stride, rows, s->O, y, job->y_row);
  } else {
    const dense_end end = {.out = y, .out_row = job->y_row};
    if (!job->kept.normalized) dense_rows(&job->layers[1], 0, dense_panels(&job->layers[1]), rows, units, end);
    float *of_block = y + DENSE_ROWS * job->y_row; /* sums of the block first, so that long sums stay accurate */
    const norm_columns columns = {of_block, of_block + sums[4].row, of_block + 2 * sums[4].row};
    memset(of_block, 0, 2 * (size_t)sums[4].row * sizeof *of_block);
    if (s->O % VW) mlp_norm_backward(job, first, rows, y, &columns, false);
    else mlp_norm_backward(job, first, rows, y, &columns, true);
    dense_add_rows(columns.dgamma, 0, 1, sums[4].row, partials + sums[4].at);
    dense_add_rows(columns.dbeta, 0, 1, sums[5].row, partials + sums[5].at);
  }
  if (sums[2].to) gemm(s->O, sums[2].row, rows, (gemm_a){y, 1, job->y_row}, units.data, units.row, partials + sums[2].at, sums[2].row, add);
  if (sums[3].to) dense_add_rows(y, job->y_row, rows, s->O, partials + sums[3].at);
  if (!job->into_hidden) return;
  const dense_end masked = {.out = hidden,
                            .out_row = job->hidden_row,
                            .hidden = units.data,
                            .hidden_row = units.row,
                            .next = {dense_rows_from(s->x, s->x_stride, s->I, first + rows, s->M),
                                     dense_rows_from(job->dout, s->dout_stride, s->O, first + rows, s->M)}};
  dense_rows(&job->layers[2], 0, dense_panels(&job->layers[2]), rows, (gemm_a){y, job->y_row, 1}, masked);
  if (sums[0].to)
    gemm(s->H, sums[0].row, rows, (gemm_a){hidden, 1, job->hidden_row}, inputs.data, inputs.row, partials + sums[0].at, sums[0].row, add);
  if (sums[1].to) dense_add_rows(hidden, job->hidden_row, rows, s->H, partials + sums[1].at);
  const gemm_a dz = {hidden, job->hidden_row, 1};
  if (job->g.x) {
    const dense_end end = {.out = job->g.x + first * s->I,
                           .out_row = s->I,
                           .next = {dense_rows_from(job->kept.hidden, s->H, s->H, first + rows, s->M),
                                    dense_rows_from(job->kept.normalized, s->O, s->O, first + rows, s->M)}};
    dense_rows(&job->layers[3], 0, dense_panels(&job->layers[3]), rows, dz, end);
  }
  if (job->g.beside) {
    const dense_end end = {.out = job->g.beside + first * s->I2, .out_row = s->I2};
    dense_rows(&job->layers[4], 0, dense_panels(&job->layers[4]), rows, dz, end);
  }
}

static ast_status mlp_backward_task(int64_t index, void *context) {
  const mlp_backward_job *job = context;
  const int64_t first = index * job->chunks.rows, last = min64(job->s->M, first + job->chunks.rows);
  const int64_t floats = DENSE_ROWS * (job->input_row + job->hidden_row + job->y_row) + 3 * job->sums[4].row;
  float *input = ast_scratch(floats * (int64_t)sizeof *input);
  if (!input) return AST_NO_MEMORY;
  float *hidden = input + DENSE_ROWS * job->input_row, *y = hidden + DENSE_ROWS * job->hidden_row;
  float *partials = job->partials + index * job->size;
  for (int k = 0; k < MLP_SUMS; k++) /* the matrices are stored by their first block */
    if (job->sums[k].rows == 1 || first >= last)
      memset(partials + job->sums[k].at, 0, (size_t)(job->sums[k].rows * job->sums[k].row) * sizeof *partials);
  for (int64_t i = first; i < last; i += job->chunks.step)
    mlp_backward_rows(job, i, min64(job->chunks.step, last - i), input, hidden, y, partials, i > first);
  return AST_OK;
}

/* Where each sum lies in the partial sums of a chunk. */
static void mlp_place_sums(mlp_backward_job *job) {
  const ast_mlp *s = job->s;
  const ast_mlp_gradients *g = &job->g;
  const dense_sum sums[MLP_SUMS] = {{.to = g->weight1, .rows = s->H, .n = s->I + s->I2},
                                    {.to = g->bias1, .rows = 1, .n = s->H},
                                    {.to = g->weight2, .rows = s->O, .n = s->H},
                                    {.to = g->bias2, .rows = 1, .n = s->O},
                                    {.to = g->gamma, .rows = 1, .n = s->O},
                                    {.to = g->beta, .rows = 1, .n = s->O}};
  for (int k = 0; k < MLP_SUMS; k++) {
    job->sums[k] = sums[k];
    job->sums[k].row = round_up(sums[k].n, VW);
    job->sums[k].at = job->size;
    job->size += sums[k].rows * job->sums[k].row;
  }
}

static ast_status mlp_backward(const ast_mlp *s, const float *restrict dout, ast_mlp_kept kept, ast_mlp_gradients g) {
  AST_SCRATCH_SCOPE;
  mlp_backward_job job = {.s = s, .dout = dout, .kept = kept, .g = g};
  const int64_t K = s->I + s->I2;
  job.into_hidden = g.x || g.beside || g.weight1 || g.bias1;
  job.layers[0] = mlp_layer(kept.hidden ? NULL : s->weight1, s->bias1, K, s->H);
  job.layers[1] = mlp_layer(kept.normalized || !s->gamma ? NULL : s->weight2, s->bias2, s->H, s->O);
  job.layers[2] = (dense_layer){.weight = job.into_hidden ? s->weight2 : NULL, .row = s->H, .column = 1, .K = s->O, .N = s->H};
  job.layers[3] = (dense_layer){.weight = g.x ? s->weight1 : NULL, .row = K, .column = 1, .K = s->H, .N = s->I};
  job.layers[4] = (dense_layer){.weight = g.beside ? s->weight1 + s->I : NULL, .row = K, .column = 1, .K = s->H, .N = s->I2};
  ast_status status = dense_pack(job.layers, 5);
  if (status != AST_OK) return status;
  job.input_row = round_up(s->I, VW) + round_up(s->I2, VW) + DENSE_APART;
  job.hidden_row = round_up(s->H, VW) + DENSE_APART;
  job.y_row = round_up(s->O, VW) + DENSE_APART;
  mlp_place_sums(&job);
  job.chunks = dense_cut(s->M, job.size);
  job.partials = ast_scratch(job.chunks.num * job.size * (int64_t)sizeof(float));
  if (!job.partials) return AST_NO_MEMORY;
  status = ast_parallel(job.chunks.num, mlp_backward_task, &job);
  if (status != AST_OK) return status;
  return dense_add_partials((dense_sum_job){job.partials, job.size, job.chunks.num, job.sums, MLP_SUMS});
}
