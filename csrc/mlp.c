/* Two dense layers with a LayerNorm behind them, and their gradients; hidden units live between the two only if the
 * caller keeps them.
 *
 *   h = max(0, [x, beside] W1^T + bias1),   y = h W2^T + bias2,   n = (y - mean(y)) / sqrt(var(y) + eps)
 *   out = gamma . n + beta + residual       (without norm: y + residual)
 *
 * Rows are taken in blocks that stay in the cache with all their intermediate values. Backward, with
 * r = 1 / sqrt(var(y) + eps),
 *
 *   dn = gamma . dout,   dy = r (dn - mean(dn) - n mean(dn . n)),   dz = [h > 0] . (dy W2)
 *   dW2 = dy^T h,        dW1 = dz^T [x, beside],                    d[x, beside] = dz W1
 *   dgamma, dbeta, dbias2, dbias1 = the sums of the rows of dout . n, dout, dy, dz
 *
 * where h, n and r of a block are computed again, or read if the caller kept them. Sums over rows go chunk by chunk
 * (weight_panels.h): they do not depend on the threads, and a row's results depend on that row alone.
 *
 * Cost: 2 M H (I + I2 + O) operations forward and 4 M H (I + I2 + O) backward, 2 M H (I + I2 + O) more if nothing was
 * kept.
 */
#include "weight_panels.h"
#include "norm.h"

/* Both layers, and for the gradients W2^T and W1^T, to x and to beside. */
enum { MLP_FIRST, MLP_SECOND, MLP_SECOND_BACK, MLP_FIRST_BACK, MLP_BESIDE_BACK, MLP_LAYERS };

/* [x, beside] of rows from `first` on, copied side by side; rows of the copy are padded with zeros to whole vectors */
static void mlp_copy_inputs(const ast_mlp *mlp, int64_t first, int64_t rows, float *to, int64_t row) {
  dense_copy_rows(mlp->x + first * mlp->x_stride, mlp->x_stride, rows, mlp->I, to, row);
  if (mlp->beside)
    dense_copy_rows(mlp->beside + first * mlp->beside_stride, mlp->beside_stride, rows, mlp->I2, to + mlp->I, row);
}

/* ---- forward ---- */

typedef struct {
  const ast_mlp *mlp;
  const float *residual;
  float *out;
  ast_mlp_kept kept;
  dense_layer layers[2];
  int64_t tasks, input_row, hidden_row, y_row; /* tasks; floats from row to row of a task's blocks */
} mlp_job;

enum { MLP_AHEAD = 6 }; /* rows */

/* out from y; `whole`, a constant, says that O is a multiple of VW, so that no vector asks for its tail */
AST_INLINE void mlp_norm_rows(const mlp_job *job, int64_t first, int64_t rows, float *y, const bool whole) {
  const ast_mlp *mlp = job->mlp;
  const int64_t O = mlp->O;
  for (int64_t i = first; i < first + rows; i++, y += job->y_row) {
    for (int64_t j = 0, later = min64(i + MLP_AHEAD, mlp->M - 1) * O; j < O;
         j += 16) { /* before a store has to wait for its line */
      __builtin_prefetch(job->out + later + j, 1);
      if (job->kept.normalized) __builtin_prefetch(job->kept.normalized + later + j, 1);
    }
    const float scale = norm_centre(y, O, whole);
    const float *residual = job->residual ? job->residual + i * mlp->residual_stride : NULL;
    float *out = job->out + i * O, *normalized = job->kept.normalized ? job->kept.normalized + i * O : NULL;
    if (job->kept.scale) job->kept.scale[i] = scale;
    for (int64_t j = 0; j < O; j += VW) {
      const int64_t lanes = whole ? VW : O - j;
      const vf n = scale * vload(y + j);
      vf value = norm_out(n, mlp->gamma, mlp->beta, j, lanes);
      if (residual) value += vload_upto(residual + j, lanes);
      vstore_upto(out + j, value, lanes);
      if (normalized) vstore_upto(normalized + j, n, lanes);
    }
  }
}

static ast_status mlp_task(int64_t index, void *context) {
  const mlp_job *job = context;
  const ast_mlp *mlp = job->mlp;
  const int64_t first_row = dense_begin(mlp->M, job->tasks, index), last = dense_begin(mlp->M, job->tasks, index + 1);
  float *input = ast_scratch(DENSE_ROWS * (job->input_row + job->hidden_row + job->y_row) * (int64_t)sizeof *input);
  if (!input) return AST_NO_MEMORY;
  float *block = input + DENSE_ROWS * job->input_row, *y = block + DENSE_ROWS * job->hidden_row;
  for (int64_t i = first_row; i < last; i += DENSE_ROWS) {
    const int64_t rows = min64(DENSE_ROWS, last - i), hidden_row = job->kept.hidden ? mlp->H : job->hidden_row;
    float *hidden = job->kept.hidden ? job->kept.hidden + i * mlp->H : block;
    gemm_a a = {mlp->x + i * mlp->x_stride, mlp->x_stride, 1};
    if (mlp->beside) {
      mlp_copy_inputs(mlp, i, rows, input, job->input_row);
      a = (gemm_a){input, job->input_row, 1};
    }
    const dense_end first = {
        .activation = AST_RELU,
        .out = hidden,
        .out_row = hidden_row,
        .next = {dense_rows_from(mlp->x, mlp->x_stride, mlp->I, i + DENSE_ROWS, mlp->M),
                 dense_rows_from(mlp->beside, mlp->beside_stride, mlp->I2, i + DENSE_ROWS, mlp->M)}};
    dense_all(&job->layers[MLP_FIRST], rows, a, first);
    a = (gemm_a){hidden, hidden_row, 1};
    if (mlp->gamma) {
      dense_all(&job->layers[MLP_SECOND], rows, a, (dense_end){.out = y, .out_row = job->y_row});
      if (mlp->O % VW) mlp_norm_rows(job, i, rows, y, false);
      else mlp_norm_rows(job, i, rows, y, true);
    } else {
      const dense_end second = {.out = job->out + i * mlp->O,
                                .out_row = mlp->O,
                                .residual = job->residual ? job->residual + i * mlp->residual_stride : NULL,
                                .residual_row = mlp->residual_stride};
      dense_all(&job->layers[MLP_SECOND], rows, a, second);
    }
  }
  return AST_OK;
}

static ast_status mlp(const ast_mlp *mlp, const float *restrict residual, float *restrict out, ast_mlp_kept kept) {
  AST_SCRATCH_SCOPE;
  mlp_job job = {.mlp = mlp, .residual = residual, .out = out, .kept = kept};
  job.layers[MLP_FIRST] = dense_forward(mlp->weight1, mlp->bias1, mlp->I + mlp->I2, mlp->H);
  job.layers[MLP_SECOND] = dense_forward(mlp->weight2, mlp->bias2, mlp->H, mlp->O);
  const int64_t rows = mlp->M >= 64 * DENSE_ROWS ? 4 * DENSE_ROWS : min64(DENSE_ROWS, max64(mlp->M / 8, 2 * GEMM_ROWS));
  job.tasks = min64(divide_up(mlp->M, GEMM_ROWS), round_up(divide_up(mlp->M, rows), 2));
  job.input_row = mlp->beside ? round_up(mlp->I + mlp->I2, VW) + DENSE_APART : 0;
  job.hidden_row = round_up(mlp->H, VW) + DENSE_APART;
  job.y_row = round_up(mlp->O, VW) + DENSE_APART;
  const ast_status status = dense_pack(job.layers, 2);
  return status == AST_OK ? ast_parallel(job.tasks, mlp_task, &job) : status;
}

/* ---- backward ---- */

/* The partial sums. */
enum { MLP_DWEIGHT1, MLP_DBIAS1, MLP_DWEIGHT2, MLP_DBIAS2, MLP_DGAMMA, MLP_DBETA, MLP_SUMS };

typedef struct {
  const ast_mlp *mlp;
  const float *dout;
  ast_mlp_kept kept;
  ast_mlp_gradients g;
  dense_layer layers[MLP_LAYERS]; /* both layers; W2^T; W1^T to x and to beside */
  int64_t input_row, hidden_row, y_row;
  bool into_hidden; /* whether anything before the hidden units wants a gradient */
  dense_chunks chunks;
  dense_partials partials;
} mlp_backward_job;

/* dy of the rows from `first` on, in the place of y, or of n, which is read if it was kept; dgamma and dbeta are added
 * to */
AST_INLINE void mlp_norm_backward(const mlp_backward_job *job, int64_t first, int64_t rows, float *y,
                                  const norm_columns *columns, const bool whole) {
  const ast_mlp *mlp = job->mlp;
  for (int64_t i = first; i < first + rows; i++, y += job->y_row) {
    const float *kept = job->kept.normalized ? job->kept.normalized + i * mlp->O : NULL;
    const float scale = kept ? job->kept.scale[i] : norm_centre(y, mlp->O, whole);
    norm_backward(i, mlp->O, whole, mlp->gamma, job->dout + i * mlp->dout_stride, NULL, scale, kept, y, columns);
  }
}

/* One block: its dx and dbeside, and its part of all sums, added to the sums of the chunk. Rows that do not end with a
 * vector are copied. */
static void mlp_backward_rows(const mlp_backward_job *job, int64_t first, int64_t rows, float *input, float *hidden,
                              float *y, float *partials, bool add) {
  const ast_mlp *mlp = job->mlp;
  const dense_sum *sums = job->partials.sums;
  gemm_a inputs = {input, job->input_row, 1}, units = {hidden, job->hidden_row, 1};
  if (mlp->beside || mlp->I % VW) mlp_copy_inputs(mlp, first, rows, input, job->input_row);
  else inputs = (gemm_a){mlp->x + first * mlp->x_stride, mlp->x_stride, 1};
  if (job->kept.hidden && mlp->H % VW == 0) {
    units = (gemm_a){job->kept.hidden + first * mlp->H, mlp->H, 1};
  } else if (job->kept.hidden) {
    dense_copy_rows(job->kept.hidden + first * mlp->H, mlp->H, rows, mlp->H, hidden, job->hidden_row);
  } else {
    const dense_end end = {.activation = AST_RELU, .out = hidden, .out_row = job->hidden_row};
    dense_all(&job->layers[MLP_FIRST], rows, inputs, end);
  }
  if (!mlp->gamma) {
    dense_copy_rows(job->dout + first * mlp->dout_stride, mlp->dout_stride, rows, mlp->O, y, job->y_row);
  } else {
    const dense_end end = {.out = y, .out_row = job->y_row};
    if (!job->kept.normalized) dense_all(&job->layers[MLP_SECOND], rows, units, end);
    /* sums of the block first, so that long sums stay accurate */
    const norm_columns columns = norm_new_columns(y + DENSE_ROWS * job->y_row, sums[MLP_DGAMMA].row);
    norm_clear_columns(&columns);
    if (mlp->O % VW) mlp_norm_backward(job, first, rows, y, &columns, false);
    else mlp_norm_backward(job, first, rows, y, &columns, true);
    dense_add_rows(columns.dgamma, columns.row, NORM_CHAINS, columns.row, partials + sums[MLP_DGAMMA].at);
    dense_add_rows(columns.dbeta, columns.row, NORM_CHAINS, columns.row, partials + sums[MLP_DBETA].at);
  }
  /* forward: y = h W2^T + bias2, so dW2 = dy^T h, dbias2 = dy and dh = dy W2 */
  if (sums[MLP_DWEIGHT2].to)
    gemm(mlp->O, sums[MLP_DWEIGHT2].row, rows, y, job->y_row, units.data, units.row, partials + sums[MLP_DWEIGHT2].at,
         sums[MLP_DWEIGHT2].row, add);
  if (sums[MLP_DBIAS2].to) dense_add_rows(y, job->y_row, rows, mlp->O, partials + sums[MLP_DBIAS2].at);
  if (!job->into_hidden) return;
  const dense_end masked = {.out = hidden,
                            .out_row = job->hidden_row,
                            .hidden = units.data,
                            .hidden_row = units.row,
                            .next = {dense_rows_from(mlp->x, mlp->x_stride, mlp->I, first + rows, mlp->M),
                                     dense_rows_from(job->dout, mlp->dout_stride, mlp->O, first + rows, mlp->M)}};
  dense_all(&job->layers[MLP_SECOND_BACK], rows, (gemm_a){y, job->y_row, 1}, masked);
  /* forward: h = max(0, [x, beside] W1^T + bias1), so dW1 = dz^T [x, beside], dbias1 = dz and d[x, beside] = dz W1 */
  if (sums[MLP_DWEIGHT1].to)
    gemm(mlp->H, sums[MLP_DWEIGHT1].row, rows, hidden, job->hidden_row, inputs.data, inputs.row,
         partials + sums[MLP_DWEIGHT1].at, sums[MLP_DWEIGHT1].row, add);
  if (sums[MLP_DBIAS1].to) dense_add_rows(hidden, job->hidden_row, rows, mlp->H, partials + sums[MLP_DBIAS1].at);
  const gemm_a dz = {hidden, job->hidden_row, 1};
  if (job->g.x) {
    const dense_end end = {.out = job->g.x + first * mlp->I,
                           .out_row = mlp->I,
                           .next = {dense_rows_from(job->kept.hidden, mlp->H, mlp->H, first + rows, mlp->M),
                                    dense_rows_from(job->kept.normalized, mlp->O, mlp->O, first + rows, mlp->M)}};
    dense_all(&job->layers[MLP_FIRST_BACK], rows, dz, end);
  }
  if (job->g.beside) {
    const dense_end end = {.out = job->g.beside + first * mlp->I2, .out_row = mlp->I2};
    dense_all(&job->layers[MLP_BESIDE_BACK], rows, dz, end);
  }
}

static ast_status mlp_backward_task(int64_t index, void *context) {
  const mlp_backward_job *job = context;
  const int64_t first = index * job->chunks.rows, last = min64(job->mlp->M, first + job->chunks.rows);
  const int64_t floats =
      DENSE_ROWS * (job->input_row + job->hidden_row + job->y_row) + NORM_COLUMNS * job->partials.sums[MLP_DGAMMA].row;
  float *input = ast_scratch(floats * (int64_t)sizeof *input);
  if (!input) return AST_NO_MEMORY;
  float *hidden = input + DENSE_ROWS * job->input_row, *y = hidden + DENSE_ROWS * job->hidden_row;
  float *partials = dense_start_chunk(&job->partials, index, first >= last);
  for (int64_t i = first, block = 0; i < last; i += job->chunks.step, block++) {
    const bool add = dense_begin_block(&job->partials, block, partials);
    mlp_backward_rows(job, i, min64(job->chunks.step, last - i), input, hidden, y, partials, add);
  }
  return AST_OK;
}

static ast_status mlp_backward(const ast_mlp *mlp, const float *restrict dout, ast_mlp_kept kept, ast_mlp_gradients g) {
  AST_SCRATCH_SCOPE;
  mlp_backward_job job = {.mlp = mlp, .dout = dout, .kept = kept, .g = g};
  const int64_t K = mlp->I + mlp->I2;
  job.into_hidden = g.x || g.beside || g.weight1 || g.bias1;
  job.layers[MLP_FIRST] = dense_forward(kept.hidden ? NULL : mlp->weight1, mlp->bias1, K, mlp->H);
  job.layers[MLP_SECOND] =
      dense_forward(kept.normalized || !mlp->gamma ? NULL : mlp->weight2, mlp->bias2, mlp->H, mlp->O);
  job.layers[MLP_SECOND_BACK] = dense_backward(job.into_hidden ? mlp->weight2 : NULL, mlp->H, mlp->O, mlp->H);
  job.layers[MLP_FIRST_BACK] = dense_backward(g.x ? mlp->weight1 : NULL, K, mlp->H, mlp->I);
  job.layers[MLP_BESIDE_BACK] = dense_backward(g.beside ? mlp->weight1 + mlp->I : NULL, K, mlp->H, mlp->I2);
  ast_status status = dense_pack(job.layers, MLP_LAYERS);
  if (status != AST_OK) return status;
  job.input_row = round_up(mlp->I, VW) + round_up(mlp->I2, VW) + DENSE_APART;
  job.hidden_row = round_up(mlp->H, VW) + DENSE_APART;
  job.y_row = round_up(mlp->O, VW) + DENSE_APART;
  dense_sum sums[] = {[MLP_DWEIGHT1] = {.to = g.weight1, .rows = mlp->H, .n = K},
                      [MLP_DBIAS1] = {.to = g.bias1, .rows = 1, .n = mlp->H},
                      [MLP_DWEIGHT2] = {.to = g.weight2, .rows = mlp->O, .n = mlp->H},
                      [MLP_DBIAS2] = {.to = g.bias2, .rows = 1, .n = mlp->O},
                      [MLP_DGAMMA] = {.to = g.gamma, .rows = 1, .n = mlp->O},
                      [MLP_DBETA] = {.to = g.beta, .rows = 1, .n = mlp->O}};
  job.partials = dense_place_sums(sums, MLP_SUMS);
  job.chunks = dense_cut(mlp->M, job.partials.size);
  if (!dense_new_partials(&job.partials, job.chunks.num, dense_blocks(job.chunks))) return AST_NO_MEMORY;
  status = ast_parallel(job.chunks.num, mlp_backward_task, &job);
  return status == AST_OK ? dense_add_partials(&job.partials) : status;
}
